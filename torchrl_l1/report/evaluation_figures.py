"""Ablation bars and disturbance charts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from torchrl_l1.report.algorithms import AlgorithmFacts
from torchrl_l1.report.evaluation_tables import PHASES
from torchrl_l1.report.study import noise_order
from torchrl_l1.report.style import (
    arm_label,
    color,
    fit_scale,
    grid,
    legend_below,
    named,
    save,
    title,
)

Row = Mapping[str, Any]


def plot_ablation(rows: Sequence[Row], file: Path, name: str = "") -> Path:
    """Bars of return with L1 in neither phase, one of them, or both; a panel per task.

    Args:
        rows: of :func:`~torchrl_l1.report.evaluation_tables.ablation_rows`, of one kind of policy,
            one kind of L1, one variant and one stage.
        file: where to.
        name: of the algorithm, where there are several.
    """
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    figure, axes = grid(len(tasks), columns=2, width=6.2, height=3.6)
    for axis, task in zip(axes, tasks, strict=True):
        mine = [row for row in rows if row["task"] == task]
        noises = sorted({row["noise"] for row in mine}, key=noise_order)
        fit_scale([axis], [_values(row) for row in mine])
        for row in mine:
            index = PHASES.index(row["phase"])
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


def plot_disturbances(
    rows: Sequence[Row], heading: str, file: Path, algorithm: AlgorithmFacts
) -> Path | None:
    """Return against actuator bias and against actuator gain, and what L1 adds to it.

    The band of a return is the 95 % interval of the mean over training seeds. These differ more
    from each other than L1 off from L1 on, so below each return stands the difference, policy by
    policy, with the interval of its own mean.

    Args:
        rows: of one cell and stage of the training, tested under several biases and gains.
        heading: title of the figure.
        file: where to.
        algorithm: what the policies are of.

    Returns:
        the file, or ``None`` if neither bias nor gain varies.
    """
    found: list[tuple[str, str, list[Row]]] = []
    stage = rows[0].get("stage", "")
    for policy, noise in dict.fromkeys((row["policy"], row["noise"]) for row in rows):
        mine = [row for row in rows if (row["policy"], row["noise"]) == (policy, noise)]
        for what, other, neutral in (("bias", "gain", 1.0), ("gain", "bias", 0.0)):
            chosen = [row for row in mine if row[other] == neutral]
            if len({row[what] for row in chosen}) > 1:
                name = _panel_title(algorithm.acting(policy, stage), noise)
                found.append((name, what, chosen))
    if not found:
        return None
    # All panels of a column vary the same; returns and differences take turns down the rows.
    columns = len({what for _, what, _ in found})
    groups = [found[i : i + columns] for i in range(0, len(found), columns)]
    panels = [
        (name, what, chosen, value)
        for group in groups
        for value in ("return", "difference")
        for name, what, chosen in group
        if any(f"{value}_mean" in row for row in chosen)
    ]
    figure, axes = grid(len(panels), columns=columns, width=5.2, height=3.2)
    shown: list[Sequence[float]] = []
    for axis, (name, what, chosen, value) in zip(axes, panels, strict=True):
        drawn = _draw_disturbance(axis, what, chosen, value)
        axis.set_title(name, fontsize=10)
        if value == "return":
            shown += drawn
    returns = [axis for axis, panel in zip(axes, panels, strict=True) if panel[-1] == "return"]
    fit_scale(returns, shown)
    figure.suptitle(heading, fontsize=11)
    legend_below(figure, axes)
    return save(figure, file)


def _panel_title(actions: str, noise: str) -> str:
    noises = "" if noise == "none" else f"noise: {noise}"
    return ", ".join(filter(None, (actions, noises)))


def _draw_disturbance(
    axis: Axes, what: str, rows: Sequence[Row], value: str
) -> list[Sequence[float]]:
    """Draw a panel of returns or differences; returns its values and lower limits."""
    shown: list[Sequence[float]] = []
    for index, tested in enumerate(dict.fromkeys(row["l1"] for row in rows)):
        mine = [row for row in rows if row["l1"] == tested and f"{value}_mean" in row]
        if not mine:
            continue
        line = sorted(mine, key=lambda row: row[what])
        shade = color(3 + index, tested)
        means = [row[f"{value}_mean"] for row in line]
        axis.plot(
            [row[what] for row in line], means, "o-", color=shade, markersize=4,
            label=arm_label(tested),
        )  # fmt: skip
        shown.append(means)
        limits = [row for row in line if row.get(f"{value}_low") is not None]
        if limits:
            low, high = ([row[f"{value}_{side}"] for row in limits] for side in ("low", "high"))
            axis.fill_between(
                [row[what] for row in limits], low, high, color=shade, alpha=0.18, linewidth=0
            )
            # Not the upper limit: it may lie beyond what a return can be.
            shown.append(low)
    axis.set_xlabel(f"actuator {what} ({'action units' if what == 'bias' else 'factor'})")
    if value == "return":
        axis.set_ylabel("return (sum of rewards)")
    else:
        axis.set_ylabel("return, less that with L1 off")
        axis.axhline(0, color="black", linewidth=0.8)
    axis.grid(alpha=0.3)
    return shown


def _values(row: Row) -> list[float]:
    return [float(value) for value in str(row["return_values"]).split()]
