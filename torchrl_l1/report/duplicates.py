"""Runs that are there more than once."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace

import numpy as np

from torchrl_l1.report.reading import Evaluation
from torchrl_l1.report.runs import Run


def distinct(runs: Sequence[Run], same: Callable[[Run], Hashable]) -> tuple[list[Run], list[Run]]:
    """One run of each kind, the one that is furthest, and the others.

    An evaluation that the one lacks comes from another that is as far. Of an evaluation that
    both have, the conditions that are missing come from it too where the returns of the
    trainings are equal: then they are evaluations of the same policy.

    Args:
        runs: the runs, in order of preference.
        same: equal for runs of one kind.
    """
    groups: dict[Hashable, list[Run]] = {}
    for run in runs:
        groups.setdefault(same(run), []).append(run)
    chosen, others = [], []
    for group in groups.values():
        best = max(group, key=lambda run: len(run.returns))
        rest = [run for run in group if run is not best]
        chosen.append(replace(best, evaluations=_evaluations(best, rest)))
        others += rest
    return chosen, others


def _evaluations(best: Run, others: Sequence[Run]) -> dict[str, list[Evaluation]]:
    merged = {name: list(tests) for name, tests in best.evaluations.items()}
    for other in others:
        if len(other.returns) != len(best.returns):
            continue
        for name, tests in other.evaluations.items():
            if name not in merged:
                merged[name] = list(tests)
            elif np.array_equal(other.returns, best.returns):
                known = {test.condition for test in merged[name]}
                merged[name] += [test for test in tests if test.condition not in known]
    return merged
