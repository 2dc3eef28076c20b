"""The paper's printed tables with errata, and its authors' curves."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

import numpy as np

from torchrl_l1.report.identity import BASELINE, facts
from torchrl_l1.report.reading import numeric_rows

# Controllers that the paper's "L1" stands for: its own and that of its released code.
_PUBLISHED_ARMS = ("paper", "reference")


CURVE_COLUMNS = ("arm", "setting", "seed", "iteration", "total_train_samples", "average_return")

_TASKS = {
    "Inverted_Pendulum": "inverted_pendulum",
    "Swimmer": "swimmer",
    "Hopper": "hopper",
    "Walker": "walker",
    "Halfcheetah": "half_cheetah",
}
_NOISES = {"": "none", "_Action_Noise": "action", "_Observation_Noise": "observation"}
_FORMS = {"_nl": "nonlinear", "_ca": "affine"}

# The authors hold out a third of the data from the fit and log the size of the rest.
_STEPS_PER_TRAINING_SAMPLE = 1.5


@dataclass(frozen=True)
class PublishedCell:
    """One printed cell.

    Attributes:
        mean: mean as printed.
        std: standard deviation as printed after the ``±``.
        source: paper and table.
        erratum: why not to trust it; empty if nothing is known.
    """

    mean: str
    std: str
    source: str
    erratum: str

    def columns(self) -> dict[str, str]:
        """The cell as columns of our tables."""
        return {f"paper_{key}": value for key, value in vars(self).items()}


@cache
def published_cells() -> dict[tuple[str, str, str, str, str], PublishedCell]:
    """All cells of Tables 1, 2, 4 and 5 of arXiv 2403.14860.

    Returns:
        cells by table (``"1"``), task, noise, L1 in training and L1 in testing (``on`` or
        ``off``). In Table 2 the noise is that of the test.

    Examples:
        >>> published_cells()["2", "inverted_pendulum", "action", "off", "off"].mean
        '30.2'
    """
    file = files("torchrl_l1.report") / "data" / "published_tables.csv"
    with file.open(encoding="utf-8") as handle:
        return {
            (row["table"], row["task"], row["noise"], row["l1_training"], row["l1_testing"]):
            PublishedCell(row["mean"], row["std"], row["source"], row["erratum"])
            for row in csv.DictReader(handle)
        }  # fmt: skip


def published_cell(
    task: str,
    training_noise: str,
    trained: str,
    testing_noise: str,
    tested: str,
    algorithm: str = "metrpo",
) -> PublishedCell | None:
    """The cell in the paper's tables for a training and a test; ``None`` if there is none.

    Args:
        task: the task.
        training_noise: noise of the training environment.
        trained: L1 setting of the training.
        testing_noise: noise of the test; that of the training for a run's own returns.
        tested: L1 setting of the test.
        algorithm: see :data:`~torchrl_l1.report.identity.ALGORITHMS`. For MBMF there are only the
            returns of the training.

    Examples:
        >>> published_cell("swimmer", "none", "off", "none", "off").mean
        '309.5'
        >>> published_cell("swimmer", "none", "off", "action", "paper").source
        'arXiv 2403.14860, Table 2'
        >>> published_cell("swimmer", "none", "paper", "none", "paper", "mbmf").mean
        '314.3'
    """
    switches = []
    for arm in (trained, tested):
        if arm != BASELINE and arm not in _PUBLISHED_ARMS:
            return None
        switches.append("off" if arm == BASELINE else "on")
    if training_noise == testing_noise and switches[0] == switches[1]:
        kind = "training"
    elif training_noise == testing_noise:
        kind = "ablation"
    else:
        kind = "sim_to_real" if training_noise == "none" else ""
    table = facts(algorithm).tables.get(kind, "")
    return published_cells().get((table, task, testing_noise, switches[0], switches[1]))


@dataclass(frozen=True)
class Curves:
    """Real steps and mean returns ``(seeds, T)`` of one setting."""

    real_steps: np.ndarray
    returns: np.ndarray

    def until(self, real_steps: float) -> Curves | None:
        """The iterations that end within so many real steps, give or take half an iteration.

        Args:
            real_steps: where to cut.

        Returns:
            the curves up to there, complete if they end earlier; ``None`` if none begins earlier.

        Example:
            >>> curves = Curves(np.array([[5.0, 10.0, 15.0]]), np.array([[-3.0, -2.0, -1.0]]))
            >>> curves.until(11.0).returns.tolist(), curves.until(2.0)
            ([[-3.0, -2.0]], None)
        """
        steps = self.real_steps.mean(0)
        half = (steps[-1] - steps[0]) / max(2 * (len(steps) - 1), 1)
        kept = int((steps <= real_steps + half).sum())
        return Curves(self.real_steps[:, :kept], self.returns[:, :kept]) if kept else None


class ReferenceCurves:
    """The authors' curves, in the layout of their parsed logs.

    The CSV has one row per outer iteration and run, with the columns ``arm`` (``L1_OFF``,
    ``L1_ON``, or ``nl_vs_ca`` for the comparison of nonlinear and control-affine models),
    ``setting`` (``Halfcheetah``, ``Halfcheetah_Action_Noise``, ``Halfcheetah_ca``, ...),
    ``seed``, ``iteration``, ``total_train_samples`` (two thirds of the real steps) and
    ``average_return``. Other columns are ignored.

    Args:
        path: the file, compressed if its name ends in ``.xz``.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if a column is missing, a value is empty or no number, a setting is unknown,
            the seeds of a setting differ in length, or their iterations are not in order.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise FileNotFoundError(f"no reference curves at {path}")
        runs: dict[tuple[str, str], dict[str, list[tuple[float, float]]]] = {}
        last: dict[tuple[str, str, str], float] = {}
        for row in numeric_rows(path, CURVE_COLUMNS[-3:], CURVE_COLUMNS[:-3]):
            seeds = runs.setdefault((row["arm"], row["setting"]), {})
            whose, iteration = (row["arm"], row["setting"], row["seed"]), row["iteration"]
            if iteration <= last.get(whose, -np.inf):
                raise ValueError(
                    f"{path}: iteration {iteration:g} of {' '.join(whose)} comes after "
                    f"{last[whose]:g}; sort the rows of each seed by iteration, without repetition"
                )
            last[whose] = iteration
            steps = row["total_train_samples"] * _STEPS_PER_TRAINING_SAMPLE
            seeds.setdefault(row["seed"], []).append((steps, row["average_return"]))
        self._curves: dict[tuple[str, str, bool, str], Curves] = {}
        for (arm, setting), seeds in runs.items():
            if len({len(points) for points in seeds.values()}) != 1:
                raise ValueError(f"{path}: the seeds of {arm} {setting} differ in length")
            data = np.array(list(seeds.values()))
            self._curves[_meaning(path, arm, setting)] = Curves(data[..., 0], data[..., 1])

    def training(self, task: str, noise: str, arm: str) -> Curves | None:
        """The curves of a task, noise and arm (anything but ``off`` is with L1)."""
        return self._curves.get((task, noise, arm != BASELINE, ""))

    def model_form(self, task: str, form: str) -> Curves | None:
        """The curves behind figure 2, ``nonlinear`` or ``affine``."""
        return self._curves.get((task, "none", False, form))


def _meaning(path: Path, arm: str, setting: str) -> tuple[str, str, bool, str]:
    for name, task in _TASKS.items():
        rest = setting.removeprefix(name)
        if setting.startswith(name) and arm in ("L1_OFF", "L1_ON") and rest in _NOISES:
            return task, _NOISES[rest], arm == "L1_ON", ""
        if setting.startswith(name) and arm == "nl_vs_ca" and rest in _FORMS:
            return task, "none", False, _FORMS[rest]
    raise ValueError(f"{path}: unknown arm and setting {arm!r}, {setting!r}")
