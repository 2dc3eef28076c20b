"""Learning curves of other runs, read from a CSV that the user has."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchrl_l1.report.identity import BASELINE
from torchrl_l1.report.numeric_csv import numeric_rows

COLUMNS = ("arm", "setting", "seed", "iteration", "total_train_samples", "average_return")

_TASKS = {
    "Inverted_Pendulum": "inverted_pendulum",
    "Swimmer": "swimmer",
    "Hopper": "hopper",
    "Walker": "walker",
    "Halfcheetah": "half_cheetah",
}
_NOISES = {"": "none", "_Action_Noise": "action", "_Observation_Noise": "observation"}
_FORMS = {"_nl": "nonlinear", "_ca": "affine"}

# The authors hold a third of the data out of the fit and log the size of the rest.
_STEPS_PER_TRAINING_SAMPLE = 1.5


@dataclass(frozen=True)
class Curves:
    """Real steps and mean returns ``(seeds, T)`` of one setting."""

    real_steps: np.ndarray
    returns: np.ndarray


class ReferenceCurves:
    """The authors' curves, in the layout of their parsed logs.

    The CSV has one row per outer iteration and run, with the columns ``arm`` (``L1_OFF``,
    ``L1_ON``, or ``nl_vs_ca`` for the comparison of nonlinear and control-affine models),
    ``setting`` (``Halfcheetah``, ``Halfcheetah_Action_Noise``, ``Halfcheetah_ca``, ...),
    ``seed``, ``iteration``, ``total_train_samples`` (two thirds of the real steps) and
    ``average_return``. Other columns are left alone.

    Args:
        path: the file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if a column is missing, a value is empty or no number, a setting is unknown,
            or the seeds of a setting differ in length.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise FileNotFoundError(f"no reference curves at {path}")
        runs: dict[tuple[str, str], dict[str, list[tuple[float, float]]]] = {}
        for row in numeric_rows(path, COLUMNS[-2:], COLUMNS[:-2]):
            seeds = runs.setdefault((row["arm"], row["setting"]), {})
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
