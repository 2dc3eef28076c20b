"""Panels of returns against real steps: single seeds, means, and the authors' behind them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from torchrl_l1.report.reference_curves import Curves
from torchrl_l1.report.runs import Run
from torchrl_l1.report.style import fit_scale, grid, legend_below, save

__all__ = ["Grey", "Line", "Panel", "plot_panels"]

# Trainings that differ more in length are drawn over a logarithmic axis.
_MOST_TIMES = 5


@dataclass(frozen=True)
class Line:
    """One cell in a panel.

    Attributes:
        label: in the legend.
        color: of its curves.
        runs: its runs.
        mean_action: whether the return with the mean action is a curve of its own.
        style: of its curves, as matplotlib takes it.
    """

    label: str
    color: str
    runs: Sequence[Run]
    mean_action: bool
    style: Any = "-"


@dataclass(frozen=True)
class Grey:
    """Curves of the authors in a panel."""

    label: str
    style: str
    curves: Curves


@dataclass(frozen=True)
class Panel:
    """What is drawn in the same axes."""

    heading: str
    lines: Sequence[Line]
    authors: Sequence[Grey] = ()

    def begun(self) -> Panel:
        """The panel with those lines only that have something to draw."""
        lines = [line for line in self.lines if any(len(run.returns) for run in line.runs)]
        return Panel(self.heading, lines, self.authors)


def plot_panels(panels: Sequence[Panel], file: Path) -> Path | None:
    """A figure of some panels with one legend.

    Returns:
        the file, or ``None`` if no run has finished an iteration.
    """
    begun = [panel for panel in (panel.begun() for panel in panels) if panel.lines]
    if not begun:
        return None
    figure, axes = grid(len(begun), columns=3, width=4.6, height=3.9)
    shown: list[np.ndarray] = []
    for axis, panel in zip(axes, begun, strict=True):
        shown += _draw(axis, panel)
        axis.set_title(panel.heading, fontsize=10)
    fit_scale(axes, shown)
    legend_below(figure, axes, last=("mean action", "unfinished", "authors"))
    return save(figure, file)


def _draw(axis: Axes, panel: Panel) -> list[np.ndarray]:
    """Draw a panel; returns the values that are in sight."""
    shown = []
    ends = [
        max(run.real_steps[-1] for run in line.runs if len(run.returns)) for line in panel.lines
    ]
    end = max(ends)
    for grey in panel.authors:
        steps, values = grey.curves.real_steps.mean(axis=0), grey.curves.returns.mean(axis=0)
        _line(axis, steps, values, grey.style, "0.55", 1.8, label=grey.label)
        shown.append(values[steps <= end])
    for line in panel.lines:
        for run in line.runs:
            style = line.style if run.finished else ":"
            _line(axis, run.real_steps, run.returns, style, line.color, 0.8, alpha=0.5)
            shown.append(run.returns)
            if not run.finished:
                axis.plot([], [], ":", color="0.2", linewidth=0.8, label="unfinished run")
        done = [run for run in line.runs if run.finished]
        if done:
            steps = np.mean([run.real_steps for run in done], axis=0)
            means = np.mean([run.returns for run in done], axis=0)
            _line(axis, steps, means, line.style, line.color, 2.2, label=line.label)
            if line.mean_action:
                means = np.mean([run.deterministic for run in done], axis=0)
                _line(axis, steps, means, "--", line.color, 1.4)
                axis.plot([], [], "--", color="0.2", linewidth=1.4, label="mean action")
                shown.append(means)
    if end > _MOST_TIMES * min(ends):
        axis.set_xscale("log")
        axis.xaxis.set_major_formatter("{x:g}")
        axis.set_xlim(right=end / 1000 * 1.05)
    else:
        axis.set_xlim(0, end / 1000 * 1.02)
    axis.set_xlabel("real environment steps (thousands)")
    axis.set_ylabel("return (sum of rewards)")
    axis.grid(alpha=0.3)
    return shown


def _line(
    axis: Axes,
    steps: np.ndarray,
    values: np.ndarray,
    style: Any,
    shade: str,
    width: float,
    **options: Any,
) -> None:
    axis.plot(steps / 1000, values, linestyle=style, color=shade, linewidth=width, **options)
