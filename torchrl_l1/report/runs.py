"""Finding and reading runs for a report."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from torchrl_l1.algorithms.facts import MEASURING, WINDOW
from torchrl_l1.campaign.description import load_yaml
from torchrl_l1.experiment.errors import RunDirectoryError, message
from torchrl_l1.experiment.evaluate import table_checksums
from torchrl_l1.experiment.files import read_text
from torchrl_l1.experiment.matrix import disturbance_words
from torchrl_l1.experiment.run_directory import RunDirectory, run_directories
from torchrl_l1.report.identity import Identity, facts, identify
from torchrl_l1.report.reading import (
    AGAIN,
    L1_COLUMNS,
    SIGNALS,
    Evaluation,
    distinct_policies,
    read_evaluations,
    read_metrics,
    read_seconds,
    read_versions,
)

T = TypeVar("T")


@dataclass
class Run:
    """A run directory.

    Attributes:
        path: the directory.
        identity: what the run is a sample of.
        real_steps: real environment steps ``(T,)`` after each outer iteration.
        returns: mean return ``(T,)`` of the stochastic policy.
        deterministic: mean return ``(T,)`` with the policy's mean action; the same if there is
            only one way to act.
        signals: ``(T,)`` each: what L1 did, see ``SIGNALS``; NaN without L1.
        seconds: wall-clock time ``(T,)`` of each phase, see ``AlgorithmFacts.phases``; NaN
            if unknown.
        versions: versions that it ran with.
        evaluations: evaluations by name.
        stage: number ``(T,)`` of the stage of each outer iteration, from 1; ``None`` if the
            algorithm has only one.
        diverged: what is no longer finite in its training; empty if all is well.
        lost: whether its metrics are unusable; it then has no iterations.
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
    diverged: str = ""
    lost: bool = False

    @property
    def finished(self) -> bool:
        """Whether all outer iterations are done."""
        return len(self.returns) >= self.identity.outer_iterations

    @property
    def progress(self) -> str:
        """Its progress, such as ``7 of 33 iterations``, or why it has none."""
        if self.lost:
            return "diverged" if self.diverged else "cannot be read"
        return f"{len(self.returns)} of {self.identity.outer_iterations} iterations"

    @property
    def ending(self) -> np.ndarray:
        """Indices of the outer iterations over which the return is taken.

        They are the last three, as in the paper; with several stages, those of the last stage
        alone.
        """
        stages = facts(self.identity.algorithm).named_stages
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
        """The same for the deterministic return."""
        return float(self.deterministic[self.ending].mean())

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
        """Time ``(T,)`` of all phases except measuring returns; NaN if unknown."""
        phases = [seconds for phase, seconds in self.seconds.items() if phase != MEASURING]
        return np.sum(phases, axis=0)

    @property
    def milliseconds_per_step(self) -> float:
        """Training time per real step; NaN if unknown."""
        steps = self.real_steps[-1] if len(self.real_steps) else 0
        return float(1000 * self.training_seconds.sum() / steps) if steps else math.nan


def l1_means(
    runs: Sequence[Run], parts: Sequence[np.ndarray], columns: Sequence[str] = tuple(L1_COLUMNS)
) -> dict[str, float]:
    """What L1 did in some outer iterations of each run: means over runs where known.

    Args:
        runs: any number of runs.
        parts: indices of the outer iterations, run by run.
        columns: which of ``switches_per_1000``, ``u_a`` and ``saturation``.
    """
    means = {}
    for column in columns:
        signal, factor = L1_COLUMNS[column]
        values = [run.signals[signal][part].mean() for run, part in zip(runs, parts, strict=True)]
        means[column] = float(np.mean([factor * float(value) for value in values]))
    return {column: mean for column, mean in means.items() if np.isfinite(mean)}


@dataclass
class Findings:
    """The runs in some folders.

    Attributes:
        runs: readable runs, in alphabetical order of their paths.
        errors: problems with unreadable files; each names its file. If only an evaluation,
            ``timing.csv`` or ``versions.json`` of a run is unreadable, the rest is in ``runs``.
        lost: runs of which nothing but their identity can be read.
    """

    runs: list[Run] = field(default_factory=list)
    lost: list[Run] = field(default_factory=list)
    errors: list[RunDirectoryError] = field(default_factory=list)


def find_runs(folders: Sequence[Path]) -> list[Run]:
    """Every run directory in some folders and their subfolders, in alphabetical order.

    Raises:
        FileNotFoundError: if a folder does not exist, or none of them holds a run.
        RunDirectoryError: if a run's files cannot be read; the message names the file.
    """
    found = find_readable_runs(folders)
    if found.errors:
        raise found.errors[0]
    return found.runs


def find_readable_runs(folders: Sequence[Path]) -> Findings:
    """As :func:`find_runs`, but unreadable files are left out and listed.

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
                run = _read(RunDirectory(path), config, found.errors)
                (found.lost if run.lost else found.runs).append(run)
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


def _read_table(
    file: Path, iterations: int | None, errors: list[RunDirectoryError]
) -> list[Evaluation]:
    """Read an evaluation whose name is a word, as for campaigns: it goes into names and headings.

    One made before the run continued is of another policy than the run's last.

    Args:
        file: the table.
        iterations: the run's iterations; ``None`` for an unfinished run, whose tables are not used.
        errors: non-finite returns are appended to these; the other rows stay valid.
    """
    if not re.fullmatch(r"[A-Za-z0-9_.+-]{1,100}", file.stem):
        raise RunDirectoryError(f"cannot use {file}: its name is not a word of at most 100 letters")
    described, known, made_after, seed = file.with_suffix(".yaml"), None, iterations, None
    # If it gives no information, the table alone is used.
    with suppress(OSError, ValueError, LookupError, TypeError, AttributeError):
        if described.exists():
            content = load_yaml(described)
            made_after, known = content["iterations"], content.get("checksums")
            seed = content.get("seed")
    if isinstance(known, dict) and known != table_checksums(file):
        raise RunDirectoryError(
            f"{file} or the table of its episodes is not as it was written (see {described.name}); "
            "its campaign makes it again"
        )
    if isinstance(made_after, int) and iterations not in (None, made_after):
        raise RunDirectoryError(
            f"{file} was made after {made_after} iterations, but the run has {iterations}; its "
            "campaign makes it again"
        )
    tests = read_evaluations(file)
    for test in tests:
        if not math.isfinite(test.return_mean):
            condition = f"L1 {test.controller}, noise {test.noise}, {test.policy} policy"
            errors.append(
                RunDirectoryError(
                    f"{file}: the return is {test.return_mean} with {condition}, "
                    f"{disturbance_words(test.columns())}"
                )
            )
    return [replace(test, seed=seed) for test in tests if math.isfinite(test.return_mean)]


def _diverged(file: Path) -> str:
    try:
        return read_text(file, 10_000).strip() if file.exists() else ""
    except (OSError, ValueError) as error:
        raise RunDirectoryError(f"cannot read {file}: {error}") from error


def _read_columns(
    directory: RunDirectory, identity: Identity, stages: int, diverged: str
) -> dict[str, np.ndarray]:
    if problem := directory.metrics_problem():
        raise RunDirectoryError(problem)
    # It would diverge again: report where it diverged instead of a remedy.
    remedy = f"Its {diverged}" if diverged else AGAIN
    columns = read_metrics(directory.metrics_file, stages, remedy)
    iterations = len(columns["iteration"])
    if iterations > identity.outer_iterations:
        raise RunDirectoryError(
            f"{directory.metrics_file} has {iterations} iterations, but "
            f"{directory.config_file} says {identity.outer_iterations}"
        )
    return columns


def _read(directory: RunDirectory, config: dict[str, Any], errors: list[RunDirectoryError]) -> Run:
    try:
        identity = identify(config)
        algorithm = facts(identity.algorithm)
    # A damaged configuration may hold anything anywhere.
    except Exception as error:
        raise RunDirectoryError(f"cannot use {directory.config_file}: {message(error)}") from error

    def readable(read: Callable[[], T], otherwise: T) -> T:
        try:
            return read()
        except RunDirectoryError as error:
            errors.append(error)
            return otherwise

    path, stages = directory.path, len(algorithm.named_stages)
    diverged = readable(partial(_diverged, directory.diverged_file), "")
    versions: dict[str, str] = readable(partial(read_versions, path / "versions.json"), {})
    # As for a run that has only just begun.
    lost = read_metrics(path / "no metrics", stages)
    columns = readable(partial(_read_columns, directory, identity, stages, diverged), lost)
    iterations = len(columns["iteration"])
    tables = sorted((path / "evaluations").glob("*.csv"))
    whole = iterations if iterations == identity.outer_iterations else None
    evaluations: dict[str, list[Evaluation]] = {
        file.stem: readable(partial(_read_table, file, whole, errors), []) for file in tables
    }
    return Run(
        path,
        identity,
        columns["real_steps"],
        columns["return_mean"],
        columns["return_deterministic"],
        {name: columns[name] for name in SIGNALS},
        readable(
            partial(read_seconds, directory.timing_file, iterations, tuple(algorithm.phases)),
            {phase: np.full(iterations, np.nan) for phase in algorithm.phases},
        ),
        versions,
        {k: distinct_policies(tests, algorithm) for k, tests in evaluations.items() if tests},
        columns.get("stage"),
        diverged,
        columns is lost,
    )
