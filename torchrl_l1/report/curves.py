"""Return against real steps: learning curves of a task, and the panels of all such figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from torchrl_l1.report.identity import BASELINE, facts
from torchrl_l1.report.page import Page
from torchrl_l1.report.published import Curves, ReferenceCurves
from torchrl_l1.report.runs import Run
from torchrl_l1.report.study import Cell, Study, place_columns
from torchrl_l1.report.style import (
    Look,
    arm_label,
    fit_scale,
    grid,
    legend_below,
    looks,
    named,
    save,
    title,
)

# Trainings whose lengths differ more are drawn over a logarithmic axis.
_MOST_TIMES = 5

_SHADES = ("0.82", "0.91")


def curve_section(page: Page, study: Study, reference: ReferenceCurves | None) -> None:
    """Add a section with a figure per task.

    Args:
        page: the page.
        study: the runs.
        reference: curves to draw in the background.
    """
    page.heading(
        "Learning curves",
        "Thin: single seeds; bold: their mean"
        + _dashed(study)
        + "; grey: mean of the authors' logs, if given, cut at the end of ours"
        * study.facts.reference_logs
        + _bands(study)
        + ".",
    )
    for task in study.tasks():
        file = page.file("learning_curves", task)
        figure = plot_task(study, task, file, reference, page.name)
        page.figure(figure, f"Learning curves, {title(task)}")
    page.csv("learning_curves", curve_rows(study))


def curve_rows(study: Study) -> list[dict[str, Any]]:
    """The data of the figures: one row per run and outer iteration, including unfinished runs."""
    rows = []
    for cell, runs in study.cells.items():
        for run in runs:
            for at, steps in enumerate(run.real_steps):
                row = {**place_columns(cell), "seed": run.identity.seed}
                if run.stage is not None:
                    row["stage"] = int(run.stage[at])
                row |= {
                    "iteration": at,
                    "real_steps": int(steps),
                    "return": _digits(run.returns[at]),
                }
                if study.facts.samples:
                    row["return_deterministic"] = _digits(run.deterministic[at])
                rows.append(row)
    return rows


def _digits(value: float) -> float:
    """Round to the significant digits of a sum of 32-bit rewards."""
    return float(f"{value:.8g}")


def _dashed(study: Study) -> str:
    places = study.facts.mean_action_stages
    words = [stage.words for place, stage in enumerate(study.facts.named_stages) if place in places]
    where = f" in {' and '.join(words)}" if words else ""
    return f"; dashed: mean of the return with the mean action{where}" if places else ""


def _bands(study: Study) -> str:
    words = [stage.words for stage in study.facts.named_stages]
    if not words:
        return ""
    return f"; shaded: the stages before {words[-1]}, {' and '.join(words[:-1])}"


def plot_task(
    study: Study,
    task: str,
    file: Path,
    reference: ReferenceCurves | None = None,
    name: str = "",
) -> Path | None:
    """The main cells of a task, one panel per noise.

    Args:
        study: the runs.
        task: the task.
        file: the file to write.
        reference: curves to draw in the background.
        name: name of the algorithm, if there are several.

    Returns:
        the file, or ``None`` if no run has finished an iteration.
    """
    panels = []
    for noise, lines in main_lines(study, task):
        heading = named(name, title(task, noise))
        usual = lines[0].runs[0].identity.usual_task
        authors = _authors(reference, task, noise) if usual else []
        earlier = len(study.facts.named_stages[:-1])
        panels.append(Panel(heading, lines, authors, stage_bands(study, lines)[:earlier]))
    return plot_panels(panels, file)


def _authors(reference: ReferenceCurves | None, task: str, noise: str) -> list[Grey]:
    if reference is None:
        return []
    found = []
    for arm, label, style in ((BASELINE, "METRPO", "-"), ("paper", "L1-METRPO", ":")):
        curves = reference.training(task, noise, arm)
        if curves is not None:
            found.append(Grey(f"authors' logs, {label}", style, curves))
    return found


def main_lines(study: Study, task: str) -> Iterator[tuple[str, list[Line]]]:
    """Lines of the main cells of a task, by noise."""
    cells = [cell for cell in study.cells if cell.task == task and not cell.variant]
    for noise in dict.fromkeys(cell.noise for cell in cells):
        chosen = [cell for cell in cells if cell.noise == noise]
        drawn_as = looks([cell.arm for cell in chosen])
        yield (
            noise,
            [cell_line(study, cell, arm_label(cell.arm), drawn_as[cell.arm]) for cell in chosen],
        )


def cell_line(study: Study, cell: Cell, label: str, look: Look) -> Line:
    """The curves of a cell."""
    mean_action = study.facts.mean_action_stages
    return Line(label, look.color, study.cells[cell], mean_action, look.style)


def stage_bands(study: Study, lines: Sequence[Line]) -> list[Band]:
    """The stages of the run that has got furthest; none if there is only one stage."""
    furthest = max((run for line in lines for run in line.runs), key=lambda run: len(run.returns))
    bands: list[Band] = []
    for position, stage in enumerate(study.facts.named_stages):
        steps = furthest.real_steps[furthest.during(position)]
        if len(steps):
            bands.append(Band(stage.words, bands[-1].end if bands else 0.0, float(steps[-1])))
    return bands


@dataclass(frozen=True)
class Line:
    """One cell in a panel.

    Attributes:
        label: its label in the legend.
        color: colour of its curves.
        runs: its runs.
        mean_action: positions of the stages, see :meth:`Run.during`, in which the return with the
            mean action has its own curve.
        style: matplotlib line style of its curves.
    """

    label: str
    color: str
    runs: Sequence[Run]
    mean_action: Sequence[int] = ()
    style: Any = "-"

    def own(self, run: Run) -> np.ndarray:
        """Outer iterations ``(T,)`` in which the return with the mean action is drawn."""
        never = np.full(len(run.returns), False)
        return np.logical_or.reduce([never, *(run.during(place) for place in self.mean_action)])


@dataclass(frozen=True)
class Grey:
    """The authors' curves in a panel."""

    label: str
    style: str
    curves: Curves


@dataclass(frozen=True)
class Band:
    """A part of the training in a panel, from one number of real steps to another."""

    label: str
    start: float
    end: float


@dataclass(frozen=True)
class Panel:
    """The contents of one set of axes.

    Attributes:
        heading: title of the panel.
        lines: our curves.
        authors: curves behind them.
        bands: parts of the training to shade.
        stage: position of the stage to draw, see :meth:`Run.during`; all stages if ``None``.
    """

    heading: str
    lines: Sequence[Line]
    authors: Sequence[Grey] = ()
    bands: Sequence[Band] = ()
    stage: int | None = None

    def begun(self) -> Panel:
        """The panel with only those lines that have something to draw."""
        lines = [line for line in self.lines if any(len(run.returns) for run in line.runs)]
        return replace(self, lines=lines)

    @property
    def offline(self) -> bool:
        """Whether all its algorithms learn from fixed data."""
        return all(
            facts(run.identity.algorithm).offline for line in self.lines for run in line.runs
        )

    def along(self, run: Run) -> np.ndarray:
        """Abscissa `(T,)` of a run: thousands of real steps, or outer iterations."""
        return np.arange(len(run.returns)) + 1.0 if self.offline else run.real_steps / 1000

    def part(self, run: Run) -> np.ndarray:
        """Which outer iterations ``(T,)`` of a run are drawn."""
        every = np.full(len(run.returns), True)
        return every if self.stage is None else run.during(self.stage)


def plot_panels(panels: Sequence[Panel], file: Path, same_scale: bool = False) -> Path | None:
    """A figure of several panels with one legend.

    Args:
        panels: the panels.
        file: the file to write.
        same_scale: whether all show the same range of returns.

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
    if same_scale:
        low, high = zip(*(axis.get_ylim() for axis in axes), strict=True)
        for axis in axes:
            axis.set_ylim(min(low), max(high))
    fit_scale(axes, shown)
    bands = dict.fromkeys(band.label for panel in begun for band in panel.bands)
    legend_below(figure, axes, last=("mean action", "unfinished", "authors", *bands))
    return save(figure, file)


def _draw(axis: Axes, panel: Panel) -> list[np.ndarray]:
    """Draw a panel; returns the visible values."""
    shown = []
    ends = [
        max(panel.along(run)[-1] for run in line.runs if len(run.returns)) for line in panel.lines
    ]
    end = max(ends)
    # Runs that are short only because they have just begun do not change the axis.
    whole = [
        own
        for own, line in zip(ends, panel.lines, strict=True)
        if any(run.finished for run in line.runs)
    ]
    for grey in panel.authors:
        steps, values = grey.curves.real_steps.mean(axis=0) / 1000, grey.curves.returns.mean(axis=0)
        _line(axis, steps, values, grey.style, "0.55", 1.8, label=grey.label)
        shown.append(values[steps <= end])
    for line in panel.lines:
        for run in line.runs:
            style, part = line.style if run.finished else ":", panel.part(run)
            steps, values = panel.along(run)[part], run.returns[part]
            _line(axis, steps, values, style, line.color, 0.8, alpha=0.5, marker=_dots(steps))
            shown.append(values)
            if not run.finished:
                axis.plot([], [], ":", color="0.2", linewidth=0.8, label="unfinished run")
        done = [run for run in line.runs if run.finished]
        if not done:  # there is no mean, whose legend entry would explain the colour
            _line(axis, steps[:0], values[:0], line.style, line.color, 2.2, label=line.label)
        if done:
            steps, means = np.mean(
                [[values[panel.part(r)] for values in (panel.along(r), r.returns)] for r in done],
                axis=0,
            )
            dots = _dots(steps)
            _line(axis, steps, means, line.style, line.color, 2.2, label=line.label, marker=dots)
            steps, mean_action = np.mean(
                [
                    [
                        values[line.own(r) & panel.part(r)]
                        for values in (panel.along(r), r.deterministic)
                    ]
                    for r in done
                ],
                axis=0,
            )
            if len(steps):
                _line(axis, steps, mean_action, "--", line.color, 1.4, marker=_dots(steps))
                axis.plot([], [], "--", color="0.2", linewidth=1.4, label="mean action")
                shown.append(mean_action)
    for band, shade in zip(panel.bands, _SHADES, strict=False):
        axis.axvspan(
            band.start / 1000, band.end / 1000, color=shade, linewidth=0, zorder=0, label=band.label
        )
    if panel.stage is not None:
        axis.margins(x=0.03)
    elif end > _MOST_TIMES * min(whole, default=end):
        axis.set_xscale("log")
        axis.set_xlim(right=end * 1.05)
    else:
        axis.set_xlim(0, end * 1.02)
    axis.set_xlabel("outer iterations" if panel.offline else "real environment steps (thousands)")
    axis.set_ylabel("return (sum of rewards)")
    axis.grid(alpha=0.3)
    return shown


def _dots(steps: np.ndarray) -> str:
    """A marker for a single point, which makes no line."""
    return "o" if len(steps) == 1 else ""


def _line(
    axis: Axes,
    steps: np.ndarray,
    values: np.ndarray,
    style: Any,
    shade: str,
    width: float,
    **options: Any,
) -> None:
    axis.plot(steps, values, linestyle=style, color=shade, linewidth=width, **options)
