"""Switches and returns of frozen policies against the tolerance and the filter's gain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator

from torchrl_l1.experiment.l1_options import controller_label
from torchrl_l1.report.identity import BASELINE
from torchrl_l1.report.study import noise_order
from torchrl_l1.report.style import arm_label, color, fit_scale, grid, legend_below, save

Row = Mapping[str, Any]

_WORDS = {
    "epsilon": "switching tolerance epsilon (raw state units)",
    "alpha": "filter gain alpha per step",
}
_CONDITION = ("noise", "bias", "gain")
# The first colour is that of the line without L1.
_COLORS = 6
_MARKERS = "osD^vP"


def tuning_rows(rows: Sequence[Row]) -> tuple[str, list[Row]]:
    """The kind of policy that a figure shows, and its rows: sampled actions where there are any.

    Training samples its actions, and the mean action alone hardly moves the operating point.

    Args:
        rows: of one cell of the training.
    """
    tuned = {row["policy"] for row in rows if "option" in row}
    policy = "deterministic" if tuned == {"deterministic"} else "stochastic"
    return policy, [row for row in rows if row["policy"] == policy]


def plot_tuning(rows: Sequence[Row], heading: str, file: Path) -> Path | None:
    """Switches per 1000 steps and returns against epsilon, one line per alpha.

    The panel of the switches is that of the first condition, the least disturbed one; then each
    condition has a panel with its returns: means over training seeds, their 95 % intervals as
    bars, and the return without L1 as a dashed line. If only alpha varies, it takes the place of
    epsilon.

    Args:
        rows: of :func:`tuning_rows`.
        heading: title of the figure.
        file: where to.

    Returns:
        the file, or ``None`` if neither epsilon nor alpha varies.
    """
    tuned = [row for row in rows if "option" in row]
    values = {key: {row[key] for row in tuned} - {None} for key in _WORDS}
    x, other = ("alpha", "epsilon") if len(values["epsilon"]) < 2 else ("epsilon", "alpha")
    if len(values[x]) < 2:
        return None
    tuned = [row for row in tuned if row[x] is not None]
    found = sorted(
        {tuple(row[key] for key in _CONDITION) for row in tuned},
        key=lambda cell: (noise_order(cell[0]), abs(cell[2] - 1), cell[2], abs(cell[1]), cell[1]),
    )
    lines = _lines(tuned, other)
    first = [row for row in tuned if _condition(row) == found[0]]
    with_switches = any("switches_per_1000_steps" in row for row in first)
    figure, axes = grid(len(found) + with_switches, columns=3, width=4.4, height=3.5)
    if with_switches:
        _draw(axes[0], first, lines, x, "switches_per_1000_steps")
        axes[0].set_ylabel("switches per 1000 steps")
        axes[0].set_title(f"switches, {_words(found[0])}", fontsize=10)
        top = max(1.0, axes[0].get_ylim()[1])
        axes[0].set_ylim(-0.03 * top, top)
    for axis, condition in zip(axes[with_switches:], found, strict=True):
        shown = [row for row in tuned if _condition(row) == condition]
        off = [r for r in rows if r["l1"] == BASELINE and _condition(r) == condition]
        _draw(axis, shown, lines, x, "return_mean")
        for row in off:
            axis.axhline(
                row["return_mean"], color=color(0, BASELINE), linestyle="--",
                label=arm_label(BASELINE),
            )  # fmt: skip
        # Of the means: intervals of a few seeds reach above the best return that there can be.
        fit_scale([axis], [[row["return_mean"] for row in [*shown, *off]]])
        axis.set_ylabel("return (sum of rewards)")
        axis.set_title(f"return, {_words(condition)}", fontsize=10)
    for axis in axes:
        axis.set_xscale("log")
        ticks = sorted(values[x])
        axis.set_xticks(ticks, [f"{value:g}" for value in ticks])
        axis.xaxis.set_minor_locator(NullLocator())
        axis.set_xlabel(_WORDS[x])
        axis.grid(alpha=0.3)
    figure.suptitle(heading, fontsize=11)
    legend_below(figure, axes, last=[arm_label(BASELINE)])
    return save(figure, file)


def _lines(rows: Sequence[Row], other: str) -> dict[tuple[str, float | None], str]:
    """Label of each line by option and the value that is not on the axis, in order."""
    keys = {(row["option"], row[other]) for row in rows}
    ordered = sorted(keys, key=lambda key: (key[0], key[1] is not None, key[1] or 0.0))
    return {
        (option, value): arm_label(controller_label(option, **{other: value}))
        for option, value in ordered
    }


def _draw(
    axis: Axes,
    rows: Sequence[Row],
    lines: Mapping[tuple[str, float | None], str],
    x: str,
    y: str,
) -> None:
    other = "alpha" if x == "epsilon" else "epsilon"
    ticks = np.unique([row[x] for row in rows])
    # Side by side, so that intervals do not hide each other; switches have none.
    widest = 0.25 * np.diff(np.log(ticks)).min(initial=1.0) / max(len(lines) - 1, 1)
    step = min(widest, 0.07) * (y == "return_mean")
    for index, (line, label) in enumerate(lines.items()):
        mine = [row for row in rows if (row["option"], row[other]) == line and y in row]
        mine.sort(key=lambda row: row[x])
        shade = color(1 + index % _COLORS)
        marker = _MARKERS[index % len(_MARKERS)]
        aside = np.exp(step * (index - (len(lines) - 1) / 2))
        axis.plot(
            [aside * row[x] for row in mine],
            [row[y] for row in mine],
            f"{marker}-",
            color=shade,
            ms=4,
            label=label,
        )
        limits = [row for row in mine if y == "return_mean" and "return_low" in row]
        axis.vlines(
            [aside * row[x] for row in limits],
            [row["return_low"] for row in limits],
            [row["return_high"] for row in limits],
            color=shade,
            alpha=0.6,
        )


def _condition(row: Row) -> tuple[Any, ...]:
    return tuple(row[key] for key in _CONDITION)


def _words(condition: tuple[Any, ...]) -> str:
    """A condition in the title of a panel.

    Examples:
        >>> _words(("none", 1.0, 1.0)), _words(("action", 0.0, 0.6)), _words(("none", 0.0, 1.0))
        ('bias 1', 'noise: action, gain 0.6', 'undisturbed')
    """
    noise, bias, gain = condition
    words = [f"noise: {noise}"] * (noise != "none")
    words += [f"bias {bias:g}"] * (bias != 0) + [f"gain {gain:g}"] * (gain != 1)
    return ", ".join(words) or "undisturbed"
