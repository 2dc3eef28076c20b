"""Figures of evaluations: ablation, returns against disturbances, sweeps of controller values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator

from torchrl_l1.algorithms.facts import AlgorithmFacts
from torchrl_l1.envs import DISTURBANCES
from torchrl_l1.experiment.l1_options import controller_label
from torchrl_l1.experiment.matrix import disturbed
from torchrl_l1.report.identity import BASELINE
from torchrl_l1.report.page import Row
from torchrl_l1.report.recovery import panel_title, tested_place
from torchrl_l1.report.study import noise_order
from torchrl_l1.report.style import (
    Look,
    arm_label,
    color,
    fit_scale,
    grid,
    legend_below,
    looks,
    named,
    save,
    title,
)

L1_IN = ("neither", "training only", "testing only", "both")
"""Phases with L1 on, in the order of tables and figures."""

_AXES = {
    "epsilon": "switching tolerance epsilon (raw state units)",
    "alpha": "filter gain alpha per step",
}
# The first colour is for the line without L1.
_COLORS = 6
# Panels of disturbances side by side.
_MOST_ACROSS = 4
_MARKERS = "osD^vP"
# Lines are translucent, so that overlapping ones of equally good controllers show.
_OVER: Sequence[Any] = ("-", "-", (0, (4, 3)), (0, (1, 3)))


def plot_ablation(rows: Sequence[Row], file: Path, name: str = "") -> Path:
    """Bars of the return with L1 in neither phase, one of them, or both; one panel per task.

    Args:
        rows: rows of :func:`~torchrl_l1.report.evaluations.ablation_rows`, of one kind of policy,
            one kind of L1, one variant and one stage.
        file: the file to write.
        name: name of the algorithm, if there are several.
    """
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    figure, axes = grid(len(tasks), columns=2, width=6.2, height=3.6)
    for axis, task in zip(axes, tasks, strict=True):
        mine = [row for row in rows if row["task"] == task]
        noises = sorted({row["noise"] for row in mine}, key=noise_order)
        fit_scale([axis], [_values(row) for row in mine])
        for row in mine:
            index = L1_IN.index(row["phase"])
            x = noises.index(row["noise"]) + (index - 1.5) * 0.2
            _bar(axis, x, row, color(index))
        axis.axhline(0, color="black", linewidth=0.8)
        axis.set_xticks(range(len(noises)), [f"noise: {noise}" for noise in noises])
        axis.set_xlim(-0.6, len(noises) - 0.4)
        axis.set_ylabel("return (sum of rewards)")
        words = filter(None, (title(task), mine[0].get("stage", "")))
        axis.set_title(named(name, ", ".join(words)), fontsize=10)
        axis.grid(axis="y", alpha=0.3)
    legend_below(figure, axes)
    return save(figure, file)


def _bar(axis: Axes, x: float, row: Row, shade: str) -> None:
    name = row["phase"]
    label = f"L1 in {name if name != 'both' else 'both phases'}".replace("in neither", "off")
    axis.bar(x, row["return_mean"], 0.18, color=shade, alpha=0.75, label=label)
    values = _values(row)
    # Side by side, so that seeds with equal returns do not hide each other.
    spread = np.linspace(-0.05, 0.05, len(values)) if len(values) > 1 else np.zeros(1)
    axis.plot(x + spread, values, ".", color="black", markersize=3.5, alpha=0.7, zorder=3)
    if row.get("return_low") is not None:
        axis.vlines(x, row["return_low"], row["return_high"], color="black", linewidth=1.4)


@dataclass(frozen=True)
class Columns:
    """What a chart shows against a disturbance: columns of rows, as a line within a band.

    Attributes:
        line: column of the values.
        low: column of the lower limits of the band, where known.
        high: column of the upper limits.
        words: label of the axis.
    """

    line: str
    low: str
    high: str
    words: str


MEANS = Columns("return_mean", "return_low", "return_high", "return (sum of rewards)")
"""Means over training seeds with their 95 % intervals."""

DIFFERENCES = Columns(
    "difference_mean", "difference_low", "difference_high", "return, less that with L1 off"
)
"""Mean differences to the same policies without L1, with their 95 % intervals."""

RANGES = Columns("return_median", "return_lowest", "return_highest", "return (sum of rewards)")
"""Medians over training seeds, from the lowest to the highest."""


def plot_disturbances(
    rows: Sequence[Row],
    heading: str,
    file: Path,
    algorithm: AlgorithmFacts,
    shown: Sequence[Columns] = (MEANS, DIFFERENCES),
    always: bool = False,
) -> Path | None:
    """Return against each disturbance, one line per controller.

    There is a panel per stage, policy, noise and disturbance for each of ``shown``, one below the
    other, with its line and band. Returns differ more between training seeds than between L1 off
    and on, so by default the difference, policy by policy, is shown below each return. If there are
    many disturbances, only those tested at several magnitudes have panels.

    Args:
        rows: tests under several values of disturbances; in a report, of one cell and stage of
            the training.
        heading: title of the figure.
        file: the file to write.
        algorithm: the algorithm of the policies.
        shown: what the panels show, beginning with returns.
        always: whether to draw the first disturbance if none varies.

    Returns:
        the file, or ``None`` if there is nothing to draw.
    """
    found: list[tuple[str, str, list[Row]]] = []
    for stage, policy, noise in dict.fromkeys(map(tested_place, rows)):
        mine = [row for row in rows if tested_place(row) == (stage, policy, noise)]
        varied = _varied(mine)
        if len(varied) > _MOST_ACROSS:
            varied = {k: v for k, v in varied.items() if len({row[k] for row in v}) > 2}
        if not varied and always:
            varied = {next(iter(DISTURBANCES)): mine}
        name = panel_title(algorithm.acting(policy, stage), noise)
        found += [(name, what, chosen) for what, chosen in varied.items()]
    if not found:
        return None
    # Returns and differences alternate down the rows. A single disturbance with nothing below it
    # leaves room for two panels side by side.
    columns = min(max(len({what for _, what, _ in found}), 2 // len(shown)), _MOST_ACROSS)
    panels: list[tuple[str, str, list[Row], Columns] | None] = []
    for group in (found[i : i + columns] for i in range(0, len(found), columns)):
        for value in shown:
            drawn = [(*one, value) for one in group if any(value.line in row for row in one[2])]
            panels += [*drawn, *[None] * (columns - len(drawn))] if drawn else []
    while panels[-1] is None:
        panels.pop()
    figure, every = grid(len(panels), columns=columns, width=5.2, height=3.2)
    drawn_as = looks(dict.fromkeys(row["l1"] for row in rows))
    axes, returns = [], []
    scaled: list[Sequence[float]] = []
    for axis, panel in zip(every, panels, strict=True):
        if panel is None:
            axis.set_visible(False)
            continue
        name, what, chosen, value = panel
        limits = _draw_disturbance(axis, what, chosen, value, drawn_as)
        axis.set_title(name, fontsize=10)
        axes.append(axis)
        if value is shown[0]:
            returns.append(axis)
            scaled += limits
    fit_scale(returns, scaled)
    figure.suptitle(heading, fontsize=11)
    legend_below(figure, axes)
    return save(figure, file)


def _varied(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """For each disturbance that varies, the rows in which all others are neutral."""
    found = {}
    for what, entry in DISTURBANCES.items():
        chosen = [row for row in rows if disturbed(row).keys() <= {what}]
        # Tables older than a disturbance have no column for it.
        if len({row.get(what, entry.neutral) for row in chosen}) > 1:
            found[what] = chosen
    return found


def _draw_disturbance(
    axis: Axes, what: str, rows: Sequence[Row], value: Columns, drawn_as: Mapping[str, Look]
) -> list[Sequence[float]]:
    """Draw a panel of returns or differences; returns its values and lower limits."""
    shown: list[Sequence[float]] = []
    for index, tested in enumerate(dict.fromkeys(row["l1"] for row in rows)):
        mine = [row for row in rows if row["l1"] == tested and value.line in row]
        if not mine:
            continue
        line = sorted(mine, key=lambda row: row[what])
        shade, marker = drawn_as[tested].color, drawn_as[tested].marker
        values = [row[value.line] for row in line]
        axis.plot(
            [row[what] for row in line], values, color=shade, label=arm_label(tested),
            marker=marker, markersize=max(8 - 2 * index, 2), linestyle=_OVER[min(index, 3)],
        )  # fmt: skip
        shown.append(values)
        limits = [row for row in line if row.get(value.low) is not None]
        if limits:
            low, high = ([row[side] for row in limits] for side in (value.low, value.high))
            axis.fill_between(
                [row[what] for row in limits], low, high, color=shade, alpha=0.18, linewidth=0
            )
            # Not the upper limit: it may exceed the best possible return.
            shown.append(low)
    disturbance = DISTURBANCES[what]
    axis.set_xlabel(f"{disturbance.words} ({disturbance.units})")
    axis.set_ylabel(value.words)
    if value is DIFFERENCES:
        axis.axhline(0, color="black", linewidth=0.8)
    axis.grid(alpha=0.3)
    return shown


def _values(row: Row) -> list[float]:
    return [float(value) for value in str(row["return_values"]).split()]


def tuning_rows(rows: Sequence[Row]) -> tuple[str, list[Row]]:
    """The kind of policy that a figure shows, and its rows: sampled actions if there are any.

    Training samples its actions, and the mean action alone hardly moves the operating point.

    Args:
        rows: rows of one cell of the training.
    """
    tuned = {row["policy"] for row in rows if "option" in row}
    policy = "deterministic" if tuned == {"deterministic"} else "stochastic"
    return policy, [row for row in rows if row["policy"] == policy]


def plot_tuning(rows: Sequence[Row], heading: str, file: Path) -> Path | None:
    """Switches per 1000 steps and returns against epsilon, one line per alpha.

    The first panel shows the switches under the first, least disturbed condition; then each
    condition has a panel with its returns: means over training seeds, their 95 % intervals as
    bars, and the return without L1 as a dashed line. If only alpha varies, it replaces epsilon.

    Args:
        rows: rows of :func:`tuning_rows`.
        heading: title of the figure.
        file: the file to write.

    Returns:
        the file, or ``None`` if neither epsilon nor alpha varies.
    """
    tuned = [row for row in rows if "option" in row]
    values = {key: {row[key] for row in tuned} - {None} for key in _AXES}
    x, other = ("alpha", "epsilon") if len(values["epsilon"]) < 2 else ("epsilon", "alpha")
    if len(values[x]) < 2:
        return None
    tuned = [row for row in tuned if row[x] is not None]
    places = _along(values[x])
    found = sorted(
        set(map(_condition, tuned)), key=lambda cell: (noise_order(cell[0]), *_distance(cell[1:]))
    )
    lines = _lines(tuned, other)
    first = [row for row in tuned if _condition(row) == found[0]]
    with_switches = any("switches_per_1000_steps" in row for row in first)
    figure, axes = grid(len(found) + with_switches, columns=3, width=4.4, height=3.5)
    if with_switches:
        _draw(axes[0], first, lines, x, "switches_per_1000_steps", places)
        axes[0].set_ylabel("switches per 1000 steps")
        axes[0].set_title(f"switches, {_words(found[0])}", fontsize=10)
        top = max(1.0, axes[0].get_ylim()[1])
        axes[0].set_ylim(-0.03 * top, top)
    for axis, condition in zip(axes[with_switches:], found, strict=True):
        shown = [row for row in tuned if _condition(row) == condition]
        off = [r for r in rows if r["l1"] == BASELINE and _condition(r) == condition]
        _draw(axis, shown, lines, x, "return_mean", places)
        for row in off:
            axis.axhline(
                row["return_mean"], color=color(0, BASELINE), linestyle="--",
                label=arm_label(BASELINE),
            )  # fmt: skip
        # From the means: intervals of a few seeds may exceed the best possible return.
        fit_scale([axis], [[row["return_mean"] for row in [*shown, *off]]])
        axis.set_ylabel("return (sum of rewards)")
        axis.set_title(f"return, {_words(condition)}", fontsize=10)
    for axis in axes:
        axis.set_xscale("log")
        axis.set_xticks(list(places.values()), [f"{value:g}" for value in places])
        axis.xaxis.set_minor_locator(NullLocator())
        axis.set_xlabel(_AXES[x])
        axis.grid(alpha=0.3)
    figure.suptitle(heading, fontsize=11)
    legend_below(figure, axes, last=[arm_label(BASELINE)])
    return save(figure, file)


def _lines(rows: Sequence[Row], other: str) -> dict[tuple[str, float | None], str]:
    """Labels of the lines by option and the value that is not on the axis, in order."""
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
    places: Mapping[float, float],
) -> None:
    other = "alpha" if x == "epsilon" else "epsilon"
    ticks = [place for value, place in places.items() if any(row[x] == value for row in rows)]
    # Side by side, so that intervals do not hide each other; switches have none.
    widest = 0.25 * np.diff(np.log(ticks)).min(initial=1.0) / max(len(lines) - 1, 1)
    step = min(widest, 0.07) * (y == "return_mean")
    for index, (line, label) in enumerate(lines.items()):
        mine = [row for row in rows if (row["option"], row[other]) == line and y in row]
        mine.sort(key=lambda row: row[x])
        shade = color(1 + index % _COLORS)
        # Repeated colours have other markers.
        marker = _MARKERS[(index + index // _COLORS) % len(_MARKERS)]
        aside = np.exp(step * (index - (len(lines) - 1) / 2))
        axis.plot(
            [aside * places[row[x]] for row in mine],
            [row[y] for row in mine],
            f"{marker}-",
            color=shade,
            ms=4,
            label=label,
        )
        limits = [row for row in mine if y == "return_mean" and "return_low" in row]
        axis.vlines(
            [aside * places[row[x]] for row in limits],
            [row["return_low"] for row in limits],
            [row["return_high"] for row in limits],
            color=shade,
            alpha=0.6,
        )


def _along(values: Iterable[float]) -> dict[float, float]:
    """Positions of values on a logarithmic axis: 0 is one step below the least of the others.

    Examples:
        >>> _along([1.0, 0.0, 0.5])
        {0.0: 0.25, 0.5: 0.5, 1.0: 1.0}
    """
    ordered = sorted(set(values))
    least, following = [*(value for value in ordered if value > 0), math.inf][:2]
    step = following / least if math.isfinite(following) else 10.0
    return {value: value if value > 0 else least / step for value in ordered}


def _condition(row: Row) -> tuple[Any, ...]:
    return row["noise"], *(row.get(name, entry.neutral) for name, entry in DISTURBANCES.items())


def _distance(disturbances: Sequence[float]) -> tuple[float, ...]:
    """Sort key: distances of the disturbances from neutral, the last disturbance first."""
    pairs = zip(disturbances, DISTURBANCES.values(), strict=True)
    found = [(abs(value - entry.neutral), value) for value, entry in pairs]
    return tuple(number for pair in reversed(found) for number in pair)


def _words(condition: tuple[Any, ...]) -> str:
    """A condition in the title of a panel.

    Examples:
        >>> rows = [{"noise": "none"}, {"noise": "action", "gain": 0.6}]
        >>> [_words(_condition(row)) for row in rows]
        ['undisturbed', 'noise: action, gain 0.6']
    """
    noise, *values = condition
    words = [f"noise: {noise}"] * (noise != "none")
    words += [
        f"{name} {value:g}"
        for (name, entry), value in zip(DISTURBANCES.items(), values, strict=True)
        if value != entry.neutral
    ]
    return ", ".join(words) or "undisturbed"
