"""Timing of rival implementations in turns, so that a busy moment of the machine meets them all."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Hashable, Mapping
from typing import TypeVar

import torch

Row = dict[str, str | int | float]

Case = TypeVar("Case", bound=Hashable)


def interleave(
    cases: Mapping[Case, Callable[[], object]],
    repetitions: int,
    *,
    shortest: float = 0.02,
    warmup: int = 2,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[Case, list[float]]:
    """Seconds per call of each case.

    Args:
        cases: what to call, by name.
        repetitions: measurements of each case; the cases take turns.
        shortest: a measurement repeats its call until it takes about this many seconds.
        warmup: unmeasured calls of each case before the first measurement.
        clock: seconds so far, on the wall by default.

    Returns:
        ``repetitions`` values for each case, in the order in which they were measured.
    """
    calls = {}
    for name, case in cases.items():
        for _ in range(warmup):
            case()
        calls[name] = max(1, round(shortest / max(_seconds(case, 1, clock), 1e-9)))
    measured: dict[Case, list[float]] = {name: [] for name in cases}
    for _ in range(repetitions):
        for name, case in cases.items():
            measured[name].append(_seconds(case, calls[name], clock))
    return measured


def undisturbed_clock() -> Callable[[], float]:
    """Of the process with one thread; with more of them, which also wait, that on the wall."""
    return time.process_time if torch.get_num_threads() == 1 else time.perf_counter


def _seconds(case: Callable[[], object], calls: int, clock: Callable[[], float]) -> float:
    start = clock()
    for _ in range(calls):
        case()
    return (clock() - start) / calls


def spread(name: str, values: list[float]) -> Row:
    """Median, lowest and highest value as the columns ``name``, ``name_low``, ``name_high``."""
    return {
        name: statistics.median(values),
        f"{name}_low": min(values),
        f"{name}_high": max(values),
    }


def ratio(name: str, numerator: list[float], denominator: list[float]) -> Row:
    """:func:`spread` of the ratios of measurements that were neighbours in time."""
    return spread(name, [a / b for a, b in zip(numerator, denominator, strict=True)])
