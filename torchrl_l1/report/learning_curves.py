"""Return against real steps: single seeds, means, and the authors' curves behind them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from torchrl_l1.report.reference_curves import Curves, ReferenceCurves
from torchrl_l1.report.runs import Run
from torchrl_l1.report.settings import BASELINE
from torchrl_l1.report.style import arm_label, color, fit_scale, grid, legend_below, save, title
from torchrl_l1.report.variants import Cell, Study

__all__ = ["plot_comparison", "plot_task"]


@dataclass(frozen=True)
class _Line:
    """One cell in a panel."""

    label: str
    color: str
    runs: Sequence[Run]


@dataclass(frozen=True)
class _Grey:
    """Curves of the authors in a panel."""

    label: str
    style: str
    curves: Curves


def plot_task(
    study: Study, task: str, file: Path, reference: ReferenceCurves | None = None
) -> Path | None:
    """The main cells of a task, a panel per noise.

    Returns:
        the file, or ``None`` if no run has finished an iteration.
    """
    cells = [cell for cell in study.cells if cell.task == task and not cell.variant]
    panels = []
    for noise in dict.fromkeys(cell.noise for cell in cells):
        chosen = [cell for cell in cells if cell.noise == noise]
        lines = [
            _Line(arm_label(cell.arm), color(3 + i, cell.arm), study.cells[cell])
            for i, cell in enumerate(chosen)
        ]
        panels.append((title(task, noise), lines, _authors(reference, task, noise)))
    return _plot(panels, file)


def plot_comparison(
    study: Study,
    task: str,
    keys: Sequence[str],
    file: Path,
    reference: ReferenceCurves | None = None,
) -> Path | None:
    """The cells of a task that depart in some settings, and its main ones.

    Where the settings include the form of the model this is the paper's Figure 2.

    Returns:
        the file, or ``None`` if no run has finished an iteration.
    """
    cells = [cell for cell in study.compared(keys) if cell.task == task]
    names = {cell: _name(study, cell, keys) for cell in cells}
    order = list(dict.fromkeys(names.values()))
    panels = []
    for noise in dict.fromkeys(cell.noise for cell in cells):
        lines = [
            _Line(names[cell], color(order.index(names[cell])), study.cells[cell])
            for cell in cells
            if cell.noise == noise
        ]
        authors = []
        if reference is not None and "model.form" in keys and noise == "none":
            for form, style in (("nonlinear", "-"), ("affine", ":")):
                curves = reference.model_form(task, form)
                if curves is not None:
                    authors.append(_Grey(f"authors' logs, {form}", style, curves))
        panels.append((title(task, noise), lines, authors))
    return _plot(panels, file)


def _name(study: Study, cell: Cell, keys: Sequence[str]) -> str:
    return ", ".join(filter(None, (arm_label(cell.arm), study.describe(cell, keys))))


def _authors(reference: ReferenceCurves | None, task: str, noise: str) -> list[_Grey]:
    if reference is None:
        return []
    found = []
    for arm, label, style in ((BASELINE, "METRPO", "-"), ("paper", "L1-METRPO", ":")):
        curves = reference.training(task, noise, arm)
        if curves is not None:
            found.append(_Grey(f"authors' logs, {label}", style, curves))
    return found


def _plot(
    panels: Sequence[tuple[str, Sequence[_Line], Sequence[_Grey]]], file: Path
) -> Path | None:
    begun = [
        (heading, [line for line in lines if any(len(r.returns) for r in line.runs)], authors)
        for heading, lines, authors in panels
    ]
    begun = [panel for panel in begun if panel[1]]
    if not begun:
        return None
    figure, axes = grid(len(begun), columns=3, width=4.6, height=3.9)
    shown: list[np.ndarray] = []
    for axis, (heading, lines, authors) in zip(axes, begun, strict=True):
        shown += _draw(axis, lines, authors)
        axis.set_title(heading, fontsize=10)
    fit_scale(axes, shown)
    legend_below(figure, axes, last=("mean action", "unfinished", "authors"))
    return save(figure, file)


def _draw(axis: Axes, lines: Sequence[_Line], authors: Sequence[_Grey]) -> list[np.ndarray]:
    """Draw a panel; returns the values that are in sight."""
    shown = []
    end = max(run.real_steps[-1] for line in lines for run in line.runs if len(run.returns))
    for grey in authors:
        steps, values = grey.curves.real_steps.mean(axis=0), grey.curves.returns.mean(axis=0)
        _line(axis, steps, values, grey.style, "0.55", 1.8, label=grey.label)
        shown.append(values[steps <= end])
    for line in lines:
        for run in line.runs:
            style = "-" if run.finished else ":"
            _line(axis, run.real_steps, run.returns, style, line.color, 0.8, alpha=0.5)
            shown.append(run.returns)
            if not run.finished:
                axis.plot([], [], ":", color="0.2", linewidth=0.8, label="unfinished run")
        done = [run for run in line.runs if run.finished]
        if done:
            steps = np.mean([run.real_steps for run in done], axis=0)
            means = np.mean([run.returns for run in done], axis=0)
            _line(axis, steps, means, "-", line.color, 2.2, label=line.label)
            means = np.mean([run.deterministic for run in done], axis=0)
            _line(axis, steps, means, "--", line.color, 1.4)
            axis.plot([], [], "--", color="0.2", linewidth=1.4, label="mean action")
            shown.append(means)
    axis.set_xlim(0, end / 1000 * 1.02)
    axis.set_xlabel("real environment steps (thousands)")
    axis.set_ylabel("return (sum of rewards)")
    axis.grid(alpha=0.3)
    return shown


def _line(
    axis: Axes,
    steps: np.ndarray,
    values: np.ndarray,
    style: str,
    shade: str,
    width: float,
    **options: Any,
) -> None:
    axis.plot(steps / 1000, values, style, color=shade, linewidth=width, **options)
