"""Checkpoints: kept as requested, and read with every byte checked, or refused in one line."""

from __future__ import annotations

import math
import pickle
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from torchrl_l1.algorithms import Algorithm
from torchrl_l1.experiment.errors import RunDirectoryError
from torchrl_l1.experiment.files import copy_in_place

KEPT = "checkpoints"
"""Folder in a run directory for the checkpoints that a recipe keeps."""


@dataclass
class CheckpointSettings:
    """Checkpoints to keep besides the last two.

    Attributes:
        every: keep one every so many outer iterations; none if null.
        best: whether to keep that of the highest ``return_mean``.
    """

    every: int | None = None
    best: bool = False


@contextmanager
def single_precision() -> Iterator[None]:
    """Torch's default dtype as in runs, whatever it is before and after."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


_ENTRIES = {"algorithm": dict, "metrics": list, "timings": list}


def read_checkpoint(file: Path) -> dict[str, Any]:
    """A checkpoint as ``torch.load`` returns it, after comparing the checksums of all its parts.

    Only tensors and plain values are read: no code in the file is run.

    Raises:
        RunDirectoryError: naming the file and what is wrong with it.
    """
    try:
        if not file.is_file():
            raise ValueError("it is not a file")
        if file.stat().st_size == 0:
            raise ValueError("it is empty")
        if not zipfile.is_zipfile(file):
            raise ValueError("it is cut off, or not a checkpoint at all")
        # torch itself does not compare checksums on reading.
        with zipfile.ZipFile(file) as archive:
            broken = archive.testzip()
        if broken is not None:
            raise ValueError(f"{broken} in it is damaged")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            state = torch.load(file, weights_only=True, map_location="cpu")
        if not isinstance(state, dict):
            raise ValueError(f"it holds a {type(state).__name__}, not a checkpoint")
        for name, kind in _ENTRIES.items():
            if not isinstance(state.get(name), kind):
                raise ValueError(f"it has no {name}")
        if len(state["metrics"]) != len(state["timings"]) or not state["metrics"]:
            raise ValueError("its tables do not fit each other")
        if not all(isinstance(row, dict) for row in (*state["metrics"], *state["timings"])):
            raise ValueError("its tables hold no rows")
    except pickle.UnpicklingError as error:
        raise RunDirectoryError(
            f"{file} cannot be read: it holds more than tensors and values; that is not run"
        ) from error
    # Damage takes any form: the errors of zipfile, pickle and torch have no common class.
    except Exception as error:
        why = " ".join(str(error).split())[:200] or type(error).__name__
        raise RunDirectoryError(f"{file} cannot be read: {why}") from error
    return state


def checkpoint_of(
    state: dict[str, Any],
    rows: list[dict[str, Any]],
    timings: list[dict[str, Any]],
    settings: Mapping[str, Any],
) -> dict[str, Any]:
    """The contents of a checkpoint: the algorithm's state, tables, configuration and versions."""
    return {
        "algorithm": state,
        "metrics": rows,
        "timings": timings,
        "settings": dict(settings),
        "torch": str(torch.__version__),
    }


def load_state(algorithm: Algorithm, state: dict[str, Any], file: Path) -> None:
    """Continue from the state in a checkpoint.

    Raises:
        RunDirectoryError: if it is of another algorithm or of other sizes.
    """
    try:
        algorithm.load_state_dict(state)
    # In a foreign state anything may be missing.
    except Exception as error:
        why = " ".join(str(error).split())[:200]
        raise RunDirectoryError(f"{file} does not fit the run: {why}") from error


def keep_checkpoints(
    last: Path,
    settings: CheckpointSettings,
    rows: Sequence[Mapping[str, Any]],
    say: Callable[[str], object] = lambda line: None,
) -> None:
    """Keep the last checkpoint in the folder :data:`KEPT`, if the recipe says so.

    Args:
        last: the run's last checkpoint.
        settings: which checkpoints to keep.
        rows: rows of the metrics, as in that checkpoint.
        say: receives a line if the best checkpoint is gone because none was kept at its time.
    """
    names = []
    if settings.every is not None and rows and len(rows) % settings.every == 0:
        names.append(f"after_{len(rows)}.pt")
    returns = [float(row["return_mean"]) for row in rows]
    known = [value for value in returns if not math.isnan(value)]
    if settings.best and known and returns.index(max(known)) == len(rows) - 1:
        names.append("best.pt")
    elif settings.best and known and not (last.parent / KEPT / "best.pt").exists():
        best = returns.index(max(known))
        say(
            f"{last.parent}: checkpoint.best keeps nothing yet: iteration {best} was the best, and "
            "its checkpoint is gone"
        )
    for name in names:
        copy_in_place(last, last.parent / KEPT / name)


def kept_by(path: Path) -> Path | None:
    """The run directory of a kept checkpoint; ``None`` if the path is not one."""
    if path.suffix != ".pt" or path.parent.name != KEPT or path.is_dir():
        return None
    return path.parent.parent
