"""Grouping runs that are samples of the same thing, and what distinguishes the others."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torchrl_l1.algorithms.facts import AlgorithmFacts
from torchrl_l1.envs import TASKS
from torchrl_l1.report.identity import ALGORITHMS, BASELINE, NOISES, clean, default_text, facts
from torchrl_l1.report.reading import Evaluation
from torchrl_l1.report.runs import Run

Deviations = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Cell:
    """Runs that differ only in their seed.

    Attributes:
        task: the task.
        noise: noise of the training.
        arm: ``off`` or the L1 setting of the training.
        variant: settings in which it departs from the main cells of the task, with values.
    """

    task: str
    noise: str
    arm: str
    variant: Deviations = ()


def variant_text(variant: Deviations) -> str:
    """A variant in words, such as ``label=nominal``; empty for the main one."""
    return ", ".join(f"{key}={value}" for key, value in variant)


class Study:
    """The runs of an algorithm by cell.

    The settings with which most of a task's combinations of noise and arm were run are its main
    ones; runs that depart from them are variants and are never pooled with them. Settings of
    the controller are compared among the runs of one arm.

    Args:
        runs: the runs, in any order. Of those with equal settings and seed, the one that has got
            furthest is kept, with the evaluations of all that are equally far, and the others go to
            :attr:`duplicates`.

    Raises:
        ValueError: if there are no runs, or several algorithms; see :func:`studies` for these.
    """

    def __init__(self, runs: Sequence[Run]) -> None:
        algorithms = {run.identity.algorithm for run in runs}
        if len(algorithms) != 1:
            raise ValueError(
                f"a study is of one algorithm, got {', '.join(sorted(algorithms)) or 'no runs'}"
            )
        (self.algorithm,) = algorithms
        self.runs, self.duplicates = _distinct(
            runs, lambda run: (*_pairing_key(run), run.identity.arm, _frozen(run.identity.l1))
        )
        self._main: dict[tuple[str, str], dict[str, str]] = {}
        for task in {run.identity.task for run in self.runs}:
            members = [run for run in self.runs if run.identity.task == task]
            main = self._main[task, ""] = _main_settings(members, _shared)
            for arm in {run.identity.arm for run in members}:
                same = [run for run in members if run.identity.arm == arm]
                # Chosen from all, they might occur in no run together, leaving no main cell.
                usual = [run for run in same if main == _values(_shared(run), main)]
                self._main[task, arm] = _main_settings(same, lambda run: run.identity.l1, usual)
        self.cells: dict[Cell, list[Run]] = {}
        for run in sorted(self.runs, key=lambda run: run.identity.seed):
            self.cells.setdefault(self.cell(run), []).append(run)
        self.cells = dict(sorted(self.cells.items(), key=lambda item: _order(item[0])))

    @property
    def facts(self) -> AlgorithmFacts:
        """The facts of the algorithm."""
        return facts(self.algorithm)

    def cell(self, run: Run) -> Cell:
        """The cell of a run."""
        what = run.identity
        settings = {**what.shared, **what.l1}
        main = self.main_settings(what.task, what.arm)
        departing = tuple((k, v) for k, v in _values(settings, main).items() if v != main[k])
        return Cell(what.task, what.noise, what.arm, departing)

    def main_settings(self, task: str, arm: str = BASELINE) -> dict[str, str]:
        """Values in the main cells of the settings that differ between runs."""
        return {**self._main[task, ""], **self._main.get((task, arm), {})}

    def tasks(self) -> list[str]:
        """Tasks in the paper's order."""
        return list(dict.fromkeys(cell.task for cell in self.cells))

    def comparisons(self) -> list[tuple[str, ...]]:
        """Sets of settings in which cells depart, none a subset of another, to compare by."""
        sets = {frozenset(key for key, _ in cell.variant) for cell in self.cells if cell.variant}
        largest = [one for one in sets if not any(one < other for other in sets)]
        return sorted(tuple(sorted(one)) for one in largest)

    def compared(self, keys: Sequence[str]) -> list[Cell]:
        """Cells that depart in these settings alone, and the main cells to compare with."""

        def departs(cell: Cell) -> bool:
            return bool(cell.variant) and {key for key, _ in cell.variant} <= set(keys)

        places = {(cell.task, cell.noise) for cell in self.cells if departs(cell)}
        return [
            cell
            for cell in self.cells
            if departs(cell) or (not cell.variant and (cell.task, cell.noise) in places)
        ]

    def describe(self, cell: Cell, keys: Sequence[str]) -> str:
        """Values of some settings in a cell: those of the main cells unless it departs."""
        values = {**self.main_settings(cell.task, cell.arm), **dict(cell.variant)}
        return variant_text(tuple((key, values[key]) for key in keys if key in values))

    def baseline_of(self, run: Run) -> Run | None:
        """The run without L1 of the same task, noise, seed and settings."""
        for other in self.runs:
            if other.identity.arm == BASELINE and _pairing_key(other) == _pairing_key(run):
                return other
        return None


def studies(runs: Sequence[Run]) -> list[Study]:
    """A study for each algorithm, in the order of :data:`ALGORITHMS`.

    Runs of different algorithms are samples of different things and differ in more than settings:
    they are neither pooled nor treated as variants of each other.
    """
    groups: dict[str, list[Run]] = {}
    for run in _with_changed_files(runs):
        groups.setdefault(run.identity.algorithm, []).append(run)
    return [Study(groups[name]) for name in ALGORITHMS if name in groups]


def _with_changed_files(runs: Sequence[Run]) -> list[Run]:
    """The runs, with digests of the user's files among their settings if some differ.

    Runs older than these digests have none.
    """
    digests = [{k: v for k, v in run.versions.items() if v.startswith("sha256 ")} for run in runs]
    found: dict[str, set[str]] = {}
    for file, digest in (item for one in digests for item in one.items()):
        found.setdefault(file, set()).add(digest)
    changed = [
        {clean(file): clean(digest) for file, digest in one.items() if len(found[file]) > 1}
        for one in digests
    ]
    return [
        replace(run, identity=replace(run.identity, shared={**run.identity.shared, **own}))
        for run, own in zip(runs, changed, strict=True)
    ]


def with_baselines(study: Study, runs: Sequence[Run]) -> tuple[list[tuple[Run, Run]], list[str]]:
    """Each finished run of a cell with its finished baseline, and the seeds without a pair."""
    pairs = []
    for run in runs:
        baseline = study.baseline_of(run)
        if run.finished and baseline is not None and baseline.finished:
            pairs.append((run, baseline))
    seeds = {
        run.identity.seed
        for run in study.runs
        if run.identity.arm == BASELINE and _place_key(run) == _place_key(runs[0])
    }
    seeds |= {run.identity.seed for run in runs}
    single = sorted(seeds - {run.identity.seed for run, _ in pairs})
    return pairs, [str(seed) for seed in single]


def place_columns(cell: Cell) -> dict[str, Any]:
    """The columns that locate a cell, first in a table."""
    return {
        "task": cell.task,
        "noise": cell.noise,
        "l1": cell.arm,
        "variant": variant_text(cell.variant),
    }


def _distinct(runs: Sequence[Run], same: Callable[[Run], Hashable]) -> tuple[list[Run], list[Run]]:
    """One run of each kind, the one that has got furthest, and the others.

    An evaluation that it lacks comes from another run that is equally far. If both have an
    evaluation, missing conditions also come from the other, provided that the returns of the
    trainings and the seed and number of the episodes are equal: then they are of the same policy,
    from the same resets.

    Args:
        runs: the runs, in order of preference.
        same: key that is equal for runs of one kind.
    """
    groups: dict[Hashable, list[Run]] = {}
    for run in runs:
        groups.setdefault(same(run), []).append(run)
    chosen, others = [], []
    for group in groups.values():
        best = max(group, key=lambda run: len(run.returns))
        rest = [run for run in group if run is not best]
        chosen.append(replace(best, evaluations=_merged_evaluations(best, rest)))
        others += rest
    return chosen, others


def _merged_evaluations(best: Run, others: Sequence[Run]) -> dict[str, list[Evaluation]]:
    merged = {name: list(tests) for name, tests in best.evaluations.items()}
    for other in others:
        if len(other.returns) != len(best.returns):
            continue
        for name, tests in other.evaluations.items():
            if name not in merged:
                merged[name] = list(tests)
            elif np.array_equal(other.returns, best.returns):
                known = {test.condition for test in merged[name]}
                drawn = [(test.seed, test.episodes) for test in merged[name]]
                merged[name] += [
                    test
                    for test in tests
                    if test.condition not in known and (test.seed, test.episodes) in drawn
                ]
    return merged


def _place_key(run: Run) -> tuple[object, ...]:
    what = run.identity
    return what.task, what.noise, _frozen(what.shared)


def _pairing_key(run: Run) -> tuple[object, ...]:
    return *_place_key(run), run.identity.seed


def _frozen(settings: Mapping[str, str]) -> frozenset[tuple[str, str]]:
    return frozenset(settings.items())


def _shared(run: Run) -> Mapping[str, str]:
    return run.identity.shared


def _values(settings: Mapping[str, str], keys: Iterable[str]) -> dict[str, str]:
    return {key: settings.get(key, "(absent)") for key in keys}


def _main_settings(
    runs: Sequence[Run],
    settings: Callable[[Run], Mapping[str, str]],
    candidates: Sequence[Run] = (),
) -> dict[str, str]:
    """The combination of differing settings that covers most of a task.

    Only combinations of the candidates count, or of all runs if there are none.
    """
    every = dict.fromkeys(key for run in runs for key in settings(run))
    keys = [key for key in every if len({settings(run).get(key) for run in runs}) > 1]
    chosen = candidates or runs
    combinations = [tuple(_values(settings(run), keys).values()) for run in chosen]
    numbers = Counter(combinations)
    places = Counter(
        combination
        for combination, _, _ in {
            (combination, run.identity.noise, run.identity.arm)
            for combination, run in zip(combinations, chosen, strict=True)
        }
    )

    algorithm = runs[0].identity.algorithm

    def rank(combination: tuple[str, ...]) -> tuple[object, ...]:
        values = zip(keys, combination, strict=True)
        defaults = sum(default_text(key, algorithm) == value for key, value in values)
        return -places[combination], -numbers[combination], -defaults, combination

    best = min(numbers, key=rank)
    return dict(zip(keys, best, strict=True))


def noise_order(noise: str) -> tuple[object, ...]:
    """Sort key: the paper's order, then noise of other strengths, by kind and strength.

    Examples:
        >>> sorted(["action 0.3, observation 1", "action 1e-05", "action 0.3", "both"],
        ...        key=noise_order)
        ['both', 'action 1e-05', 'action 0.3', 'action 0.3, observation 1']
    """
    index, name = _place(list(NOISES), noise)
    parts = [re.fullmatch(r"(\w+) (\S+)", part) for part in noise.split(", ")]
    kinds = tuple(part[1] for part in parts if part)
    levels = tuple(_number_first(part[2]) for part in parts if part)
    return index, len(kinds), kinds, levels, name


def _order(cell: Cell) -> tuple[object, ...]:
    task, noise = _place(list(TASKS), cell.task), noise_order(cell.noise)
    variant = tuple((key, _number_first(value)) for key, value in cell.variant)
    return task, noise, cell.arm != BASELINE, cell.arm, len(variant), variant


def _number_first(value: str) -> tuple[bool, float, str]:
    try:
        return False, float(value), value
    except ValueError:
        return True, 0.0, value


def _place(names: Sequence[str], name: str) -> tuple[int, str]:
    return (names.index(name) if name in names else len(names), name)
