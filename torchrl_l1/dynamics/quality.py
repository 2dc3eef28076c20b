"""How good a fitted model is, in the units of the plant."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

_SHOWN = (10, 50)

MOST_GAIN_SPREAD = 0.3
"""Disagreement on the gain above which L1 proved useless, see ``docs/data.md``."""


@dataclass(frozen=True)
class FitQuality:
    """A model's errors on transitions that it was not trained on, per entry of the state.

    Attributes:
        names: names of the entries, n of them.
        units: units of the entries; empty where unknown.
        spread: standard deviation of the entry in the data, in its unit.
        change: standard deviation of its change in one step.
        rmse: root mean square error of the prediction of one step.
        explained: share of the variance of the change that the prediction explains: 1 is perfect, 0
            no better than the mean, NaN for an entry that never changes.
        open_loop: root mean square error after that many steps on the model's own predictions, with
            the recorded actions; NaN if no trajectory kept out of training is long enough, infinite
            if the model diverges.
        gain_spread: how much the members of the ensemble disagree on the effect of an action on the
            state: root mean square of their deviation from the mean gain, as a share of it; NaN for
            a single member. L1 relies on this gain.
        input_error: root mean square of the input that would explain the model's errors, per entry
            of the action, in its unit: how the model's errors and noise appear to L1.
        training: number of transitions trained on.
        validation: number of transitions kept out of training.
        dropped: number of rows that were not transitions.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    spread: tuple[float, ...]
    change: tuple[float, ...]
    rmse: tuple[float, ...]
    explained: tuple[float, ...]
    open_loop: dict[int, tuple[float, ...]]
    gain_spread: float
    input_error: tuple[float, ...]
    training: int
    validation: int
    dropped: int

    def __str__(self) -> str:
        """A table, one line per entry."""
        loops = {steps: self.open_loop[steps] for steps in _SHOWN if steps in self.open_loop}
        after = [f"after {steps} steps" for steps in loops]
        lines = [["entry", "unit", "spread", "change", "one step", "explained", *after]]
        for entry, name in enumerate(self.names):
            of_entry = (self.spread, self.change, self.rmse)
            errors = [_number(values[entry]) for values in (*of_entry, *loops.values())]
            explained = self.explained[entry]
            share = "constant" if math.isnan(explained) else f"{100 * explained:.2f} %"
            lines.append([name, self.units[entry] or "-", *errors[:3], share, *errors[3:]])
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        table = [
            "  ".join(
                cell.ljust(width) if column < 2 else cell.rjust(width)
                for column, (cell, width) in enumerate(zip(line, widths, strict=True))
            ).rstrip()
            for line in lines
        ]
        dropped = f", {self.dropped} dropped" if self.dropped else ""
        head = (
            f"{self.training} transitions trained on, {self.validation} kept out of training"
            f"{dropped}"
        )
        notes = [
            "spread, change: standard deviations of the entry and of its change in one step; "
            "others: root mean square errors"
        ]
        notes += [
            f"no trajectory kept out of training has {steps} steps"
            for steps, errors in loops.items()
            if all(map(math.isnan, errors))
        ]
        inputs = ", ".join(map(_number, self.input_error))
        share = f"members differ by {100 * self.gain_spread:.1f} % in what the action does; "
        agreement = "" if math.isnan(self.gain_spread) else share
        notes.append(f"{agreement}errors and noise look like an input of {inputs}")
        return "\n".join([head, *table, *notes, *([self.warning] if self.warning else [])])

    @property
    def warning(self) -> str:
        """Why the model is too poor for L1 to be useful; empty if nothing indicates that."""
        if not self.gain_spread > MOST_GAIN_SPREAD:
            return ""
        return (
            "the model is too poor for L1: its members differ by "
            f"{100 * self.gain_spread:.0f} % (more than {100 * MOST_GAIN_SPREAD:.0f} %) in what "
            "the action does; record more data, with actions that vary on their own and not only "
            "with the state"
        )


def entry_names(
    n: int, names: Sequence[str] | None, units: Sequence[str] | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names or units, one per entry.

    Raises:
        ValueError: if their number is wrong.
    """
    for option, given in (("names", names), ("units", units)):
        if given is not None and (isinstance(given, str) or len(given) != n):
            raise ValueError(
                f"{option} must hold one for each of the observation's {n} entries, got {given!r}"
            )
    plain = [f"x[{entry}]" for entry in range(n)]
    return tuple(names if names is not None else plain), tuple(units or [""] * n)


def _number(value: float) -> str:
    if math.isnan(value):
        return "-"
    return "diverges" if math.isinf(value) else f"{value:.3g}"
