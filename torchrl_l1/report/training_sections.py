"""The sections about training: table, paired differences, learning curves, comparisons."""

from __future__ import annotations

from torchrl_l1.report.learning_curves import plot_comparison, plot_task
from torchrl_l1.report.page import Page
from torchrl_l1.report.reference_curves import ReferenceCurves
from torchrl_l1.report.rendering import paired_table, training_table
from torchrl_l1.report.stage_sections import stage_sections
from torchrl_l1.report.study import Study
from torchrl_l1.report.style import title
from torchrl_l1.report.time_tables import time_rows, time_table
from torchrl_l1.report.training_tables import paired_rows, training_row


def training_sections(page: Page, study: Study, reference: ReferenceCurves | None) -> None:
    """Everything that is known from the runs' own returns.

    Args:
        page: where to.
        study: the runs.
        reference: curves of the authors' logs; left out where they are of another algorithm.
    """
    if not study.facts.reference_logs:
        reference = None
    _training(page, study, reference)
    _pairs(page, study)
    _curves(page, study, reference)
    stage_sections(page, study)
    _comparisons(page, study, reference)
    _time(page, study)


def _training(page: Page, study: Study, reference: ReferenceCurves | None) -> None:
    rows = {cell: training_row(cell, runs, reference) for cell, runs in study.cells.items()}
    page.heading(
        "Training",
        "Return is the mean over seeds of the mean over the last three outer iterations"
        + " (fewer where the last stage has or counts fewer)" * bool(study.facts.stages)
        + ", of sampled actions as in the paper" * study.facts.samples
        + "; the spread is the paper's ± (standard deviation over "
        "seeds in each of these iterations, averaged), the interval that of the mean over seeds. "
        + _l1_did(study),
    )
    page.text(training_table([row for cell, row in rows.items() if not cell.variant]))
    page.text(_main_settings(study))
    page.csv("training", list(rows.values()))


def _l1_did(study: Study) -> str:
    if study.facts.stages:
        return f"L1 acts in {study.facts.stages[0].words} only; what it did is under Stages."
    return (
        "What L1 did (switches, mean norm of its input, share of actions that a bound cut) are "
        "means over the same iterations."
    )


def _main_settings(study: Study) -> str:
    lines = []
    for task in study.tasks():
        cells = [cell for cell in study.cells if cell.task == task and not cell.variant]
        settings: dict[str, None] = {}
        for cell in cells:
            shared = study.main_settings(task)
            for key, value in study.main_settings(task, cell.arm).items():
                where = "" if key in shared else f" (L1 {cell.arm})"
                settings[f"`{key}={value}`{where}"] = None
            for key, value in study.cells[cell][0].identity.departures.items():
                settings[f"`{key}={value}` (L1 {cell.arm})"] = None
        if settings:
            lines.append(f"- {task}: {', '.join(settings)}")
    if not lines:
        return ""
    return "Runs with other settings than these have tables of their own:\n\n" + "\n".join(lines)


def _pairs(page: Page, study: Study) -> None:
    rows = paired_rows(study)
    if not any(row["pairs"] for row in rows):
        return
    page.heading(
        "L1 less baseline",
        "Differences of the same return between runs of the same seed and settings with and "
        "without L1, with 95 % intervals; the interquartile mean takes five pairs, and fewer than "
        "three are shown as they are. With a handful of seeds a single one may move an interval "
        "to either side of 0.",
    )
    page.text(paired_table(rows))
    page.csv("pairs", rows)


def _curves(page: Page, study: Study, reference: ReferenceCurves | None) -> None:
    page.heading(
        "Learning curves",
        "Thin: single seeds; bold: their mean"
        + _dashed(study)
        + "; grey: mean of the authors' logs, where they were given, cut where ours end"
        * study.facts.reference_logs
        + _bands(study)
        + ".",
    )
    for task in study.tasks():
        file = page.file("learning_curves", task)
        figure = plot_task(study, task, file, reference, page.name)
        page.figure(figure, f"Learning curves, {title(task)}")


def _dashed(study: Study) -> str:
    places = study.facts.mean_action_stages
    words = [stage.words for place, stage in enumerate(study.facts.stages) if place in places]
    where = f" in {' and '.join(words)}" if words else ""
    return f"; dashed: mean of the return with the mean action{where}" if places else ""


def _bands(study: Study) -> str:
    words = [stage.words for stage in study.facts.stages]
    if not words:
        return ""
    return f"; shaded: the stages before {words[-1]}, {' and '.join(words[:-1])}"


def _comparisons(page: Page, study: Study, reference: ReferenceCurves | None) -> None:
    for keys in study.comparisons():
        cells = study.compared(keys)
        page.heading(
            f"By {' and '.join(f'`{key}`' for key in keys)}",
            "The same table for runs that depart from the main ones in these settings, and the "
            "main ones of the same task and noise."
            + " It is the comparison of the paper's Figure 2."
            * ("model.form" in keys and study.facts.compares_models),
        )
        rows = [
            training_row(cell, study.cells[cell], reference)
            | {"variant": study.describe(cell, keys)}
            for cell in cells
        ]
        page.text(training_table(rows))
        for task in dict.fromkeys(cell.task for cell in cells):
            file = page.file("by", *keys, task)
            figure = plot_comparison(study, task, keys, file, reference, page.name)
            page.figure(figure, f"Learning curves by {', '.join(keys)}, {title(task)}")


def _time(page: Page, study: Study) -> None:
    rows = time_rows(study)
    if not rows:
        return
    page.heading(
        "Where the time goes",
        "Wall-clock seconds of an outer iteration in each of its phases, medians over all "
        "iterations of the finished runs, and the mean training time per real step. The times are "
        "those of the machine, with whatever else it did.",
    )
    page.text(time_table(rows))
    page.csv("time", rows)
