"""Return against real steps: the cells of a task, what sets some apart, and the algorithms."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from torchrl_l1.report.curve_panels import Band, Grey, Line, Panel, plot_panels
from torchrl_l1.report.identity import BASELINE
from torchrl_l1.report.reference_curves import ReferenceCurves
from torchrl_l1.report.study import Cell, Study
from torchrl_l1.report.style import (
    algorithm_color,
    algorithm_label,
    arm_label,
    arm_style,
    color,
    named,
    title,
)


def plot_task(
    study: Study,
    task: str,
    file: Path,
    reference: ReferenceCurves | None = None,
    name: str = "",
) -> Path | None:
    """The main cells of a task, a panel per noise.

    Args:
        study: the runs.
        task: the task.
        file: where to.
        reference: curves to draw behind.
        name: of the algorithm, where there are several.

    Returns:
        the file, or ``None`` if no run has finished an iteration.
    """
    panels = []
    for noise, lines in _main_lines(study, task):
        heading = named(name, title(task, noise))
        authors = _authors(reference, task, noise)
        earlier = len(study.facts.stages[:-1])
        panels.append(Panel(heading, lines, authors, _stages(study, lines)[:earlier]))
    return plot_panels(panels, file)


def plot_stages(study: Study, task: str, file: Path, name: str = "") -> Path | None:
    """The same cells with a panel for each noise and stage: the first stages are short.

    Returns:
        the file, or ``None`` if no run has finished an iteration.
    """
    panels = []
    for noise, lines in _main_lines(study, task):
        for position, band in enumerate(_stages(study, lines)):
            heading = f"{named(name, title(task, noise))}: {band.label}"
            panels.append(Panel(heading, lines, stage=position))
    return plot_panels(panels, file, same_scale=True)


def plot_comparison(
    study: Study,
    task: str,
    keys: Sequence[str],
    file: Path,
    reference: ReferenceCurves | None = None,
    name: str = "",
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
            _line(study, cell, names[cell], color(order.index(names[cell])))
            for cell in cells
            if cell.noise == noise
        ]
        authors = []
        if reference is not None and "model.form" in keys and noise == "none":
            for form, style in (("nonlinear", "-"), ("affine", ":")):
                curves = reference.model_form(task, form)
                if curves is not None:
                    authors.append(Grey(f"authors' logs, {form}", style, curves))
        panels.append(Panel(named(name, title(task, noise)), lines, authors))
    return plot_panels(panels, file)


def plot_algorithms(
    studies: Sequence[Study], task: str, noises: Sequence[str], file: Path
) -> Path | None:
    """The main cells of all algorithms on a task, a panel per noise.

    The colour is that of the algorithm, the style of a line that of the L1 setting.

    Returns:
        the file, or ``None`` if no run has finished an iteration.
    """
    arms = list(dict.fromkeys(cell.arm for study in studies for cell in study.cells))
    panels = []
    for noise in noises:
        lines = [
            Line(
                algorithm_label(study.facts.name, cell.arm),
                algorithm_color(study.algorithm),
                runs,
                style=arm_style(cell.arm, arms),
            )
            for study in studies
            for cell, runs in study.cells.items()
            if (cell.task, cell.noise, cell.variant) == (task, noise, ())
        ]
        panels.append(Panel(title(task, noise), lines))
    return plot_panels(panels, file)


def _line(study: Study, cell: Cell, label: str, shade: str) -> Line:
    return Line(label, shade, study.cells[cell], mean_action=study.facts.mean_action_stages)


def _main_lines(study: Study, task: str) -> Iterator[tuple[str, list[Line]]]:
    """A line for each main cell of a task, by noise."""
    cells = [cell for cell in study.cells if cell.task == task and not cell.variant]
    for noise in dict.fromkeys(cell.noise for cell in cells):
        chosen = [cell for cell in cells if cell.noise == noise]
        yield (
            noise,
            [
                _line(study, cell, arm_label(cell.arm), color(3 + i, cell.arm))
                for i, cell in enumerate(chosen)
            ],
        )


def _stages(study: Study, lines: Sequence[Line]) -> list[Band]:
    """Where the stages are, in the run that is furthest; none where there is one stage only."""
    furthest = max((run for line in lines for run in line.runs), key=lambda run: len(run.returns))
    bands: list[Band] = []
    for position, stage in enumerate(study.facts.stages):
        steps = furthest.real_steps[furthest.during(position)]
        if len(steps):
            bands.append(Band(stage.words, bands[-1].end if bands else 0.0, float(steps[-1])))
    return bands


def _name(study: Study, cell: Cell, keys: Sequence[str]) -> str:
    return ", ".join(filter(None, (arm_label(cell.arm), study.describe(cell, keys))))


def _authors(reference: ReferenceCurves | None, task: str, noise: str) -> list[Grey]:
    if reference is None:
        return []
    found = []
    for arm, label, style in ((BASELINE, "METRPO", "-"), ("paper", "L1-METRPO", ":")):
        curves = reference.training(task, noise, arm)
        if curves is not None:
            found.append(Grey(f"authors' logs, {label}", style, curves))
    return found
