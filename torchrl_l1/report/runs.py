"""Finding run directories and reading what is in them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_l1.experiment.run_directory import RunDirectory, RunDirectoryError
from torchrl_l1.report.reading import (
    Evaluation,
    read_config,
    read_evaluations,
    read_metrics,
    read_versions,
)
from torchrl_l1.report.settings import Identity, identify
from torchrl_l1.report.statistics import final_return

__all__ = ["Evaluation", "Run", "find_runs"]


@dataclass
class Run:
    """A run directory.

    Attributes:
        path: the directory.
        identity: what the run is one sample of.
        real_steps: real environment steps ``(T,)`` after each outer iteration.
        returns: mean return ``(T,)`` of the stochastic policy.
        deterministic: mean return ``(T,)`` with the policy's mean action.
        versions: what it ran with.
        evaluations: by name of the evaluation.
    """

    path: Path
    identity: Identity
    real_steps: np.ndarray
    returns: np.ndarray
    deterministic: np.ndarray
    versions: dict[str, str] = field(default_factory=dict)
    evaluations: dict[str, list[Evaluation]] = field(default_factory=dict)

    @property
    def finished(self) -> bool:
        """Whether all outer iterations are there."""
        return len(self.returns) >= self.identity.outer_iterations

    @property
    def progress(self) -> str:
        """How far it is, such as ``7 of 33``."""
        return f"{len(self.returns)} of {self.identity.outer_iterations}"

    @property
    def final(self) -> float:
        """Return by the paper's rule: the mean over the last three outer iterations."""
        return float(final_return(self.returns))

    @property
    def final_deterministic(self) -> float:
        """The same of the deterministic return."""
        return float(final_return(self.deterministic))


def find_runs(folders: Sequence[Path]) -> list[Run]:
    """Every run directory in or below some folders, in alphabetical order of their paths.

    Raises:
        FileNotFoundError: if a folder does not exist, or none of them holds a run.
        RunDirectoryError: if a run's files cannot be read; the message names the file.
    """
    found: dict[Path, Run] = {}
    for folder in folders:
        if not folder.is_dir():
            raise FileNotFoundError(f"there is no folder {folder}")
        for path, config in _run_directories(folder):
            if path.resolve() not in found:
                found[path.resolve()] = _read(path, config)
    if not found:
        raise FileNotFoundError(
            f"no run in {', '.join(map(str, folders))}: a run directory holds a config.yaml "
            "and, after its first iteration, a metrics.csv"
        )
    return list(found.values())


def _run_directories(folder: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    for path, below, files in os.walk(folder):
        below[:] = sorted(name for name in below if not name.startswith("."))
        if "config.yaml" not in files:
            continue
        config = read_config(Path(path) / "config.yaml")
        # Any tool may keep a config.yaml; a run's says which task and which seed.
        if "task" in config and "seed" in config:
            below.clear()
            yield Path(path), config


def _read(path: Path, config: dict[str, Any]) -> Run:
    directory = RunDirectory(path)
    try:
        identity = identify(config)
    except (KeyError, TypeError, ValueError) as error:
        raise RunDirectoryError(f"cannot use {directory.config_file}: {error}") from error
    columns = read_metrics(directory.metrics_file)
    tables = sorted((path / "evaluations").glob("*.csv"))
    if len(columns["iteration"]) > identity.outer_iterations:
        raise RunDirectoryError(
            f"{directory.metrics_file} has {len(columns['iteration'])} iterations, but "
            f"{directory.config_file} says {identity.outer_iterations}"
        )
    return Run(
        path,
        identity,
        columns["real_steps"],
        columns["return_mean"],
        columns["return_deterministic"],
        read_versions(path / "versions.json"),
        {file.stem: read_evaluations(file) for file in tables},
    )
