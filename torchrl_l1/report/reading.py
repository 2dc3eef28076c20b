"""Reading the files of a run directory; whatever is wrong with one names it."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml  # type: ignore[import-untyped]
from omegaconf import OmegaConf

from torchrl_l1.experiment.run_directory import RunDirectoryError

__all__ = ["Evaluation", "read_config", "read_evaluations", "read_metrics", "read_versions"]

_METRICS = ("iteration", "real_steps", "return_mean", "return_deterministic")
_NUMBERS = ("bias", "gain", "return_mean", "episodes")


@dataclass(frozen=True)
class Evaluation:
    """Returns of a run's frozen policy under one condition, see ``torchrl-l1 evaluate``."""

    l1: str
    noise: str
    bias: float
    gain: float
    policy: str
    return_mean: float
    episodes: int


def read_config(file: Path) -> dict[str, Any]:
    """A configuration; empty if the file holds something else than keys and values."""
    try:
        config = OmegaConf.to_container(OmegaConf.load(file))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise RunDirectoryError(f"cannot read {file}: {error}") from error
    return {str(k): v for k, v in config.items()} if isinstance(config, dict) else {}


def read_metrics(file: Path) -> dict[str, np.ndarray]:
    """Columns of a metrics table; empty ones for a run that has only just begun."""
    if not file.exists():
        return {name: np.empty(0) for name in _METRICS}
    rows = list(_numeric_rows(file, _METRICS))
    columns = {name: np.array([row[name] for row in rows]) for name in _METRICS}
    if not np.array_equal(columns["iteration"], np.arange(len(rows))):
        raise RunDirectoryError(f"{file}: the iterations are not 0, 1, 2, ... without a gap")
    return columns


def read_evaluations(file: Path) -> list[Evaluation]:
    """The rows of an evaluation."""
    return [
        Evaluation(
            row["l1"], row["noise"], row["bias"], row["gain"], row["policy"],
            row["return_mean"], int(row["episodes"]),
        )
        for row in _numeric_rows(file, _NUMBERS, ("l1", "noise", "policy"))
    ]  # fmt: skip


def _numeric_rows(
    file: Path, numbers: Sequence[str], words: Sequence[str] = ()
) -> Iterator[dict[str, Any]]:
    try:
        with file.open(newline="", encoding="utf-8") as handle:
            reader = csv.DictReader(handle, strict=True)
            missing = [k for k in (*numbers, *words) if k not in (reader.fieldnames or ())]
            if missing:
                raise RunDirectoryError(f"{file} has no column {', '.join(missing)}")
            rows = list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise RunDirectoryError(f"cannot read {file}: {error}") from error
    for line, row in enumerate(rows, start=2):
        for key in words:
            if not row[key]:
                raise RunDirectoryError(f"{file}, line {line}: {key} is empty")
        values: dict[str, Any] = {key: row[key] for key in words}
        for key in numbers:
            try:
                values[key] = float(row[key])
            except (TypeError, ValueError):
                values[key] = math.nan
            if not math.isfinite(values[key]):
                raise RunDirectoryError(
                    f"{file}, line {line}: {key} is {row[key]!r}, not a finite number. Move the "
                    "run directory away, or run it again"
                )
        yield values


def read_versions(file: Path) -> dict[str, str]:
    """Versions by package; none where there is no such file."""
    if not file.exists():
        return {}
    try:
        versions = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RunDirectoryError(f"cannot read {file}: {error}") from error
    return {str(key): str(value) for key, value in versions.items()}
