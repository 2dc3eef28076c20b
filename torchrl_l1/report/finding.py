"""Finding run directories and reading what is in them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from torchrl_l1.experiment.run_directory import RunDirectory, RunDirectoryError, run_directories
from torchrl_l1.report.algorithms import facts
from torchrl_l1.report.identity import identify
from torchrl_l1.report.reading import (
    SIGNALS,
    distinct_policies,
    read_evaluations,
    read_metrics,
    read_seconds,
    read_versions,
)
from torchrl_l1.report.runs import Evaluation, Run

T = TypeVar("T")


@dataclass
class Findings:
    """What there is in some folders.

    Attributes:
        runs: those that can be read, in alphabetical order of their paths.
        errors: what is wrong with the files that cannot be read; each names its file. Of a run
            with such an evaluation, ``timing.csv`` or ``versions.json`` the rest is in ``runs``.
    """

    runs: list[Run] = field(default_factory=list)
    errors: list[RunDirectoryError] = field(default_factory=list)


def find_runs(folders: Sequence[Path]) -> list[Run]:
    """Every run directory in or below some folders, in alphabetical order of their paths.

    Raises:
        FileNotFoundError: if a folder does not exist, or none of them holds a run.
        RunDirectoryError: if a run's files cannot be read; the message names the file.
    """
    found = find_readable_runs(folders)
    if found.errors:
        raise found.errors[0]
    return found.runs


def find_readable_runs(folders: Sequence[Path]) -> Findings:
    """As :func:`find_runs`, but files that cannot be read are left out and listed.

    Raises:
        FileNotFoundError: if a folder does not exist, or none of them holds a run.
        RunDirectoryError: if there are runs, and none of them can be read.
    """
    found = Findings()
    seen: set[Path] = set()
    for folder in folders:
        if not folder.is_dir():
            raise FileNotFoundError(f"there is no folder {folder}")
        for path, config in run_directories(folder):
            if path.resolve() in seen:
                continue
            seen.add(path.resolve())
            try:
                if isinstance(config, RunDirectoryError):
                    raise config
                found.runs.append(_read(RunDirectory(path), config, found.errors))
            except RunDirectoryError as error:
                found.errors.append(error)
    if not found.runs:
        if found.errors:
            raise found.errors[0]
        raise FileNotFoundError(
            f"no run in {', '.join(map(str, folders))}: a run directory holds a config.yaml "
            "and, after its first iteration, a metrics.csv"
        )
    return found


def _read(directory: RunDirectory, config: dict[str, Any], errors: list[RunDirectoryError]) -> Run:
    try:
        identity = identify(config)
        algorithm = facts(identity.algorithm)
    except (KeyError, TypeError, ValueError) as error:
        raise RunDirectoryError(f"cannot use {directory.config_file}: {error}") from error
    columns = read_metrics(directory.metrics_file, len(algorithm.stages))
    iterations = len(columns["iteration"])
    if iterations > identity.outer_iterations:
        raise RunDirectoryError(
            f"{directory.metrics_file} has {iterations} iterations, but "
            f"{directory.config_file} says {identity.outer_iterations}"
        )

    def readable(read: Callable[[], T], otherwise: T) -> T:
        try:
            return read()
        except RunDirectoryError as error:
            errors.append(error)
            return otherwise

    path = directory.path
    tables = sorted((path / "evaluations").glob("*.csv"))
    evaluations: dict[str, list[Evaluation]] = {
        file.stem: readable(partial(read_evaluations, file), []) for file in tables
    }
    return Run(
        path,
        identity,
        columns["real_steps"],
        columns["return_mean"],
        columns["return_deterministic"],
        {name: columns[name] for name in SIGNALS},
        readable(
            partial(read_seconds, directory.timing_file, iterations, algorithm.phases),
            {phase: np.full(iterations, np.nan) for phase in algorithm.phases},
        ),
        readable(partial(read_versions, path / "versions.json"), {}),
        {k: distinct_policies(tests, algorithm) for k, tests in evaluations.items() if tests},
        columns.get("stage"),
    )
