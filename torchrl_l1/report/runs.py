"""A run as a report sees it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from torchrl_l1.report.algorithms import MEASURING, facts
from torchrl_l1.report.identity import Identity
from torchrl_l1.report.reading import Evaluation
from torchrl_l1.report.statistics import WINDOW


@dataclass
class Run:
    """A run directory.

    Attributes:
        path: the directory.
        identity: what the run is one sample of.
        real_steps: real environment steps ``(T,)`` after each outer iteration.
        returns: mean return ``(T,)`` of the stochastic policy.
        deterministic: mean return ``(T,)`` with the policy's mean action; the same where there is
            one way to act only.
        signals: ``(T,)`` each: what L1 did, see ``SIGNALS``; NaN without L1.
        seconds: wall-clock time ``(T,)`` of each phase, see ``AlgorithmFacts.phases``; NaN
            if unknown.
        versions: what it ran with.
        evaluations: by name of the evaluation.
        stage: number ``(T,)`` of the stage that each outer iteration belongs to, from 1; ``None``
            where the algorithm has one only.
    """

    path: Path
    identity: Identity
    real_steps: np.ndarray
    returns: np.ndarray
    deterministic: np.ndarray
    signals: Mapping[str, np.ndarray]
    seconds: Mapping[str, np.ndarray]
    versions: dict[str, str] = field(default_factory=dict)
    evaluations: dict[str, list[Evaluation]] = field(default_factory=dict)
    stage: np.ndarray | None = None

    @property
    def finished(self) -> bool:
        """Whether all outer iterations are there."""
        return len(self.returns) >= self.identity.outer_iterations

    @property
    def progress(self) -> str:
        """How far it is, such as ``7 of 33``."""
        return f"{len(self.returns)} of {self.identity.outer_iterations}"

    @property
    def ending(self) -> np.ndarray:
        """Indices of the outer iterations that the return is of.

        They are the last three, as in the paper; with several stages, those that the return of
        the last one is of: no other stage is mixed in.
        """
        stages = facts(self.identity.algorithm).stages
        if self.stage is None or not len(self.stage):
            return self.end_of(0, WINDOW)
        last = int(self.stage[-1]) - 1
        return self.end_of(last, stages[last].window)

    @property
    def final(self) -> float:
        """Return by the paper's rule: the mean over :attr:`ending`."""
        return float(self.returns[self.ending].mean())

    @property
    def final_deterministic(self) -> float:
        """The same of the deterministic return."""
        return float(self.deterministic[self.ending].mean())

    def final_signal(self, name: str) -> float:
        """Mean of a signal of L1 over the same outer iterations; NaN without L1."""
        return float(self.signals[name][self.ending].mean())

    def during(self, position: int) -> np.ndarray:
        """Which outer iterations ``(T,)`` belong to a stage, the first being 0."""
        if self.stage is None:
            return np.full(len(self.returns), position == 0)
        return self.stage == position + 1

    def end_of(self, position: int, window: int) -> np.ndarray:
        """Indices of the last outer iterations of a stage, at most ``window`` of them."""
        return np.flatnonzero(self.during(position))[-window:]

    @property
    def training_seconds(self) -> np.ndarray:
        """Time ``(T,)`` of all phases but the measuring of returns; NaN if unknown."""
        phases = [seconds for phase, seconds in self.seconds.items() if phase != MEASURING]
        return np.sum(phases, axis=0)

    @property
    def milliseconds_per_step(self) -> float:
        """Training time per real step; NaN if unknown."""
        steps = self.real_steps[-1] if len(self.real_steps) else 0
        return float(1000 * self.training_seconds.sum() / steps) if steps else math.nan
