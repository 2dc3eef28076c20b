"""Reading the files of a run directory; whatever is wrong with one names it."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_l1.experiment.l1_options import controller_label
from torchrl_l1.experiment.run_directory import RunDirectoryError
from torchrl_l1.report.algorithms import AlgorithmFacts
from torchrl_l1.report.numeric_csv import numeric_rows

_SWITCH_RATE = "l1/switch_rate"

SIGNALS = (_SWITCH_RATE, "l1/u_a", "l1/saturation")
"""Columns of a metrics table that only runs with L1 have."""

_METRICS = ("iteration", "real_steps", "return_mean", "return_deterministic")
_NUMBERS = ("bias", "gain", "return_mean", "episodes")


@dataclass(frozen=True)
class Evaluation:
    """Returns of a run's frozen policy under one condition, see ``torchrl-l1 evaluate``.

    Attributes:
        l1: option of the ``l1`` group.
        noise: option of the ``noise`` group.
        bias: actuator bias, action units.
        gain: actuator gain.
        policy: ``stochastic`` or ``deterministic``.
        return_mean: mean return over the episodes.
        episodes: their number.
        own_l1: whether the controller was the one of the training; ``None`` in tables that are
            older than this column.
        epsilon: tolerance of the switching law that the test has set; ``None`` if it has not.
        alpha: gain of the filter that the test has set; ``None`` if it has not.
        switch_rate: switches per step; NaN if unknown or without L1.
        stage: whose policy it is, of an algorithm with several stages.
    """

    l1: str
    noise: str
    bias: float
    gain: float
    policy: str
    return_mean: float
    episodes: int
    own_l1: bool | None = None
    epsilon: float | None = None
    alpha: float | None = None
    switch_rate: float = math.nan
    stage: str = ""

    @property
    def condition(self) -> tuple[Any, ...]:
        """What was tested: equal for repetitions."""
        return self.controller, self.noise, self.bias, self.gain, self.policy, self.stage

    @property
    def controller(self) -> str:
        """The option with the values that the test has set."""
        return controller_label(self.l1, self.epsilon, self.alpha)

    @property
    def tuned(self) -> bool:
        """Whether the test has set any."""
        return self.epsilon is not None or self.alpha is not None


def read_metrics(file: Path, stages: int = 0) -> dict[str, np.ndarray]:
    """Columns of a metrics table; empty ones for a run that has only just begun.

    Those of :data:`SIGNALS` are NaN where the run has none.

    Args:
        file: the table.
        stages: of the algorithm; with any, there is a column ``stage``.
    """
    numbers = (*_METRICS, "stage") if stages else _METRICS
    rows = _rows(file, numbers, optional=SIGNALS) if file.exists() else []
    columns = {name: np.array([row[name] for row in rows]) for name in (*numbers, *SIGNALS)}
    if not np.array_equal(columns["iteration"], np.arange(len(rows))):
        raise RunDirectoryError(f"{file}: the iterations are not 0, 1, 2, ... without a gap")
    if stages and not _in_turn(columns["stage"], stages):
        raise RunDirectoryError(f"{file}: the stages are not 1 to {stages} in turn")
    return columns


def _in_turn(stage: np.ndarray, stages: int) -> bool:
    found = list(dict.fromkeys(stage.tolist()))
    return found == list(range(1, stages + 1))[: len(found)] and bool((np.diff(stage) >= 0).all())


def read_seconds(file: Path, iterations: int, phases: Sequence[str]) -> dict[str, np.ndarray]:
    """Seconds of each of the phases in each iteration; NaN where not known."""
    rows = _rows(file, ("iteration",), optional=phases) if file.exists() else []
    found = {int(row["iteration"]): row for row in rows}
    return {
        phase: np.array([found.get(i, {}).get(phase, np.nan) for i in range(iterations)])
        for phase in phases
    }


def read_evaluations(file: Path) -> list[Evaluation]:
    """The rows of an evaluation."""
    optional = ("own_l1", "epsilon", "alpha", _SWITCH_RATE)
    return [
        Evaluation(
            row["l1"], row["noise"], row["bias"], row["gain"], row["policy"],
            row["return_mean"], int(row["episodes"]),
            None if math.isnan(row["own_l1"]) else bool(row["own_l1"]),
            _known(row["epsilon"]), _known(row["alpha"]), row[_SWITCH_RATE], row["stage"],
        )
        for row in _rows(file, _NUMBERS, ("l1", "noise", "policy"), optional, ("stage",))
    ]  # fmt: skip


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
    single = [test for test in tests if algorithm.acts_in_one_way(test.stage)]
    both = [test for test in tests if not algorithm.acts_in_one_way(test.stage)]
    return [*one_policy(single), *both]


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _rows(
    file: Path,
    numbers: Sequence[str],
    words: Sequence[str] = (),
    optional: Sequence[str] = (),
    optional_words: Sequence[str] = (),
) -> list[dict[str, Any]]:
    try:
        return numeric_rows(file, numbers, words, optional, optional_words)
    except ValueError as error:
        raise RunDirectoryError(f"{error}. Move the run directory away, or run it again") from error


def read_versions(file: Path) -> dict[str, str]:
    """Versions by package; none where there is no such file."""
    if not file.exists():
        return {}
    try:
        versions = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RunDirectoryError(f"cannot read {file}: {error}") from error
    return {str(key): str(value) for key, value in versions.items()}
