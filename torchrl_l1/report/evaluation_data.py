"""Tests of frozen policies, from the tables that ``torchrl-l1 evaluate`` and campaigns write."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torchrl_l1.algorithms.facts import AlgorithmFacts
from torchrl_l1.envs import DISTURBANCES
from torchrl_l1.experiment.matrix import Condition
from torchrl_l1.report.reading import SWITCH_RATE, checked_rows

# Every table has the columns of these; that of another disturbance may be absent.
_FIRST_DISTURBANCES = ("bias", "gain")


@dataclass(frozen=True, kw_only=True)
class Evaluation(Condition):
    """A condition with the returns of a run's frozen policy under it.

    Attributes:
        return_mean: mean return over the episodes.
        episodes: their number.
        own_l1: whether the controller was the one of the training; ``None`` in tables that are
            older than this column.
        switch_rate: switches per step; NaN if unknown or without L1.
    """

    return_mean: float
    episodes: int
    own_l1: bool | None = None
    switch_rate: float = math.nan

    @property
    def condition(self) -> tuple[Any, ...]:
        """What was tested: equal for repetitions. See :func:`condition_columns`."""
        place = (self.noise, *self.disturbances.values(), self.policy, self.stage or "")
        return self.controller, *place

    @property
    def tuned(self) -> bool:
        """Whether the test has set values of the controller."""
        return self.epsilon is not None or self.alpha is not None


def condition_columns() -> tuple[str, ...]:
    """Names of the values of :attr:`Evaluation.condition`."""
    return "l1", "noise", *DISTURBANCES, "policy", "stage"


def read_evaluations(file: Path) -> list[Evaluation]:
    """The rows of an evaluation; disturbances that it has no column of are neutral."""
    later = [name for name in DISTURBANCES if name not in _FIRST_DISTURBANCES]
    there = checked_rows(file, (), optional_words=later) if later else []
    found = [*_FIRST_DISTURBANCES, *(n for n in later if any(row[n] for row in there))]
    rows = checked_rows(
        file,
        (*found, "return_mean", "episodes"),
        ("l1", "noise", "policy"),
        ("own_l1", "epsilon", "alpha", SWITCH_RATE),
        ("stage",),
    )
    return [
        Evaluation(
            l1=row["l1"],
            noise=row["noise"],
            disturbances={name: row[name] for name in found},
            policy=row["policy"],
            epsilon=_known(row["epsilon"]),
            alpha=_known(row["alpha"]),
            stage=row["stage"] or None,
            return_mean=row["return_mean"],
            episodes=int(row["episodes"]),
            own_l1=None if math.isnan(row["own_l1"]) else bool(row["own_l1"]),
            switch_rate=row[SWITCH_RATE],
        )
        for row in rows
    ]


def one_policy(tests: Sequence[Evaluation]) -> list[Evaluation]:
    """The tests of what acts in one way only: each once, as ``stochastic``, however named."""
    first = sorted(tests, key=lambda test: test.policy != "stochastic")
    found = [replace(test, policy="stochastic") for test in first]
    chosen: dict[Any, Evaluation] = {}
    for test in found:
        chosen.setdefault((test.condition, test.own_l1), test)
    return list(chosen.values())


def distinct_policies(tests: Sequence[Evaluation], algorithm: AlgorithmFacts) -> list[Evaluation]:
    """The tests, each once where an algorithm acts in one way only, in all stages or in some."""
    single = [test for test in tests if algorithm.acts_in_one_way(test.stage or "")]
    both = [test for test in tests if not algorithm.acts_in_one_way(test.stage or "")]
    return [*one_policy(single), *both]


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value
