"""Results of training: the paper's Table 1, paired differences, comparisons, and times."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_l1.algorithms.facts import AlgorithmFacts
from torchrl_l1.report.curves import Grey, Panel, cell_line, curve_section, plot_panels
from torchrl_l1.report.identity import BASELINE, facts
from torchrl_l1.report.page import (
    Footnotes,
    Page,
    Row,
    code,
    difference_columns,
    interval_text,
    markdown,
    number,
    paper_text,
    spread_text,
)
from torchrl_l1.report.published import ReferenceCurves, published_cell
from torchrl_l1.report.runs import Run, l1_means
from torchrl_l1.report.stages import stage_sections
from torchrl_l1.report.statistics import (
    difference_summary,
    final_return,
    mean_summary,
    published_spread,
)
from torchrl_l1.report.study import Cell, Study, place_columns, with_baselines
from torchrl_l1.report.style import arm_label, looks, named, title

# More settings are listed in the text and in the table, not in headings and legends.
_MOST_KEYS, _LONGEST_LABEL = 6, 100


def training_sections(page: Page, study: Study, reference: ReferenceCurves | None) -> None:
    """The sections on the runs' own returns.

    Args:
        page: the page.
        study: the runs.
        reference: curves of the authors' logs; left out if they are of another algorithm.
    """
    if not study.facts.reference_logs:
        reference = None
    _training(page, study, reference)
    _pairs(page, study)
    curve_section(page, study, reference)
    if study.facts.named_stages:
        stage_sections(page, study)
    _comparisons(page, study, reference)
    _time(page, study)


def _training(page: Page, study: Study, reference: ReferenceCurves | None) -> None:
    rows = {cell: training_row(cell, runs, reference) for cell, runs in study.cells.items()}
    page.heading(
        "Training",
        "Return is the mean over seeds of the mean over the last three outer iterations"
        + " (fewer if the last stage has or counts fewer)" * bool(study.facts.named_stages)
        + ", of sampled actions as in the paper" * study.facts.samples
        + "; the spread is the paper's ± (standard deviation over "
        "seeds in each of these iterations, averaged), the interval that of the mean over seeds. "
        + _l1_did(study),
    )
    page.text(training_table([row for cell, row in rows.items() if not cell.variant]))
    page.text(_main_settings(study), _recipe_departures(study))
    page.csv("training", list(rows.values()))


def _l1_did(study: Study) -> str:
    if not study.facts.stages[-1].with_l1:
        return f"L1 acts in {study.facts.l1_words} only; see Stages for what it did."
    return (
        "Values of L1 (switches, mean norm of its input, share of actions cut by a bound) are "
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
                settings[f"{code(f'{key}={value}')}{where}"] = None
            for key, value in study.cells[cell][0].identity.departures.items():
                settings[f"{code(f'{key}={value}')} (L1 {cell.arm})"] = None
        if settings:
            lines.append(f"- {task}: {', '.join(settings)}")
    if not lines:
        return ""
    return "Runs with settings other than these have their own tables:\n\n" + "\n".join(lines)


def _recipe_departures(study: Study) -> str:
    lines = []
    for task in study.tasks():
        # Settings in which main cells differ are listed above.
        told = study.main_settings(task)
        main = next(cell for cell in study.cells if cell.task == task and not cell.variant)
        departures = study.cells[main][0].identity.recipe_departures
        shown = [code(f"{key}={value}") for key, value in departures.items() if key not in told]
        if shown:
            lines.append(f"- {task}: {', '.join(shown)}")
    if not lines:
        return ""
    return "In these settings all runs depart from their recipe:\n\n" + "\n".join(lines)


def run_rows(study: Study) -> list[dict[str, Any]]:
    """One row per run, unfinished ones included."""
    return [
        {
            **place_columns(cell),
            "seed": run.identity.seed,
            "iterations": len(run.returns),
            "of": run.identity.outer_iterations,
            "real_steps": int(run.real_steps[-1]) if len(run.real_steps) else 0,
            "return": run.final if run.finished else None,
            **_deterministic(run, study),
            **(l1_means([run], [run.ending]) if run.finished else {}),
            "path": str(run.path),
        }
        for cell, runs in study.cells.items()
        for run in runs
    ]


def training_row(
    cell: Cell, runs: Sequence[Run], reference: ReferenceCurves | None = None
) -> dict[str, Any]:
    """A cell: the returns of its finished runs, the paper's, and those in the authors' logs.

    The return is the mean over seeds of the mean over :attr:`Run.ending`.
    """
    done = [run for run in runs if run.finished]
    place = (cell.task, cell.noise, cell.arm)
    row: dict[str, Any] = {**place_columns(cell), "seeds": len(done)}
    if done:
        row |= mean_summary("return", [run.final for run in done])
        if len(done) > 1:
            row["published_spread"] = published_spread(
                np.array([run.returns[run.ending] for run in done])
            )
        if facts(runs[0].identity.algorithm).samples:
            row |= mean_summary("deterministic", [run.final_deterministic for run in done])
        row["real_steps"] = round(float(np.mean([run.real_steps[-1] for run in done])))
        row |= l1_means(done, [run.ending for run in done])
    row["unfinished"] = "; ".join(
        f"seed {run.identity.seed}: {run.progress}" for run in runs if not run.finished
    )
    what = runs[0].identity
    affine = what.model_form == "affine"
    # The paper prints no returns with control-affine models; their curves are in its Figure 2.
    published = None
    if what.as_published:
        published = published_cell(*place, *place[1:], what.algorithm)
    if published is not None:
        row |= published.columns()
    curves = None
    plain = cell.noise == "none" and cell.arm == BASELINE and what.usual_task
    if reference is not None and affine and plain:
        curves = reference.model_form(cell.task, "affine")
    elif reference is not None and published is not None:
        curves = reference.training(*place)
    if curves is not None:
        row |= {
            "authors_mean": float(final_return(curves.returns).mean()),
            "authors_spread": published_spread(curves.returns),
            "authors_seeds": len(curves.returns),
        }
        reached = curves.until(row["real_steps"]) if done else None
        if reached is not None:
            row["authors_then_mean"] = float(final_return(reached.returns).mean())
            row["authors_then_spread"] = published_spread(reached.returns)
    return row


def paired_rows(study: Study) -> list[dict[str, Any]]:
    """L1 less the baseline over the seeds that both have, for stochastic and mean actions.

    If there is only one way to act, a row has no ``policy``.
    """
    rows = []
    for cell, runs in study.cells.items():
        if cell.arm == BASELINE:
            continue
        pairs, single = with_baselines(study, runs)
        for policy in study.facts.kinds:
            finals = [
                (l1.final, off.final)
                if policy == "stochastic"
                else (l1.final_deterministic, off.final_deterministic)
                for l1, off in pairs
            ]
            differences = [ours - base for ours, base in finals]
            rows.append(
                {
                    **place_columns(cell),
                    **({"policy": policy} if study.facts.samples else {}),
                    "pairs": len(pairs),
                    "seeds": " ".join(str(run.identity.seed) for run, _ in pairs),
                    **difference_summary(differences),
                    "without_pair": " ".join(single),
                }
            )
    return rows


def _deterministic(run: Run, study: Study) -> dict[str, float | None]:
    """The return with mean actions, if it differs."""
    if not study.facts.samples:
        return {}
    return {"return_deterministic": run.final_deterministic if run.finished else None}


def training_table(rows: Sequence[Row]) -> str:
    """The paper's Table 1 beside the measured values, with footnotes to its cells."""
    notes = Footnotes()
    lines = [
        {
            "task": row["task"],
            "noise": row["noise"],
            "L1": row["l1"],
            "variant": row["variant"],
            "return ± spread": spread_text(row.get("return_mean"), row.get("published_spread")),
            "95 % interval": interval_text(row, "return"),
            "with the mean action": number(row.get("deterministic_mean")),
            "95 % interval of it": interval_text(row, "deterministic"),
            "seeds": str(row["seeds"]),
            "real steps": str(row.get("real_steps", "–")),
            "switches per 1000 steps": number(row.get("switches_per_1000")),
            "L1 input": number(row.get("u_a")),
            "saturation": number(row.get("saturation")),
            "paper": paper_text(row, notes),
            "authors' logs": spread_text(row.get("authors_mean"), row.get("authors_spread")),
            "after as many steps": spread_text(
                row.get("authors_then_mean"), row.get("authors_then_spread")
            ),
            "unfinished": row["unfinished"],
        }
        for row in rows
    ]
    return notes.below(markdown(lines))


def _pairs(page: Page, study: Study) -> None:
    rows = paired_rows(study)
    if not any(row["pairs"] for row in rows):
        return
    page.heading(
        "L1 less baseline",
        "Differences of the same return between runs of the same seed and settings with and "
        "without L1, with 95 % intervals; the interquartile mean needs five pairs, and fewer than "
        "three are shown as they are. With a handful of seeds, a single one may move an interval "
        "to either side of 0.",
    )
    page.text(paired_table(rows))
    page.csv("pairs", rows)


def paired_table(rows: Sequence[Row]) -> str:
    """Differences from the baseline of the same seed."""
    lines = [
        {
            "task": row["task"],
            "noise": row["noise"],
            "L1": row["l1"],
            "variant": row["variant"],
            "policy": row.get("policy", ""),
            "pairs": str(row["pairs"]),
            **difference_columns(row),
            "seeds without a pair": row["without_pair"],
        }
        for row in rows
    ]
    return markdown(lines)


def _comparisons(page: Page, study: Study, reference: ReferenceCurves | None) -> None:
    for keys in study.comparisons():
        cells = study.compared(keys)
        page.heading(
            f"By {_keys_text(keys)}",
            f"The settings are {', '.join(map(code, keys))}. "
            * (len(keys) > _MOST_KEYS)
            + "The same table for runs that depart from the main ones in these settings, and for "
            "the main ones of the same task and noise."
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
            shown = ", ".join(keys) if len(keys) <= _MOST_KEYS else _keys_text(keys)
            page.figure(figure, f"Learning curves by {shown}, {title(task)}")


def plot_comparison(
    study: Study,
    task: str,
    keys: Sequence[str],
    file: Path,
    reference: ReferenceCurves | None = None,
    name: str = "",
) -> Path | None:
    """The cells of a task that depart in some settings, and its main ones.

    If the settings include the form of the model, this is the paper's Figure 2.

    Returns:
        the file, or ``None`` if no run has finished an iteration.
    """
    cells = [cell for cell in study.compared(keys) if cell.task == task]
    rows = {cell: row for row, cell in enumerate(study.compared(keys), start=1)}
    names = {cell: _name(study, cell, keys, rows[cell]) for cell in cells}
    drawn_as = looks(dict.fromkeys(names.values()))
    panels = []
    for noise in dict.fromkeys(cell.noise for cell in cells):
        lines = [
            cell_line(study, cell, names[cell], drawn_as[names[cell]])
            for cell in cells
            if cell.noise == noise
        ]
        authors = []
        usual = any(run.identity.usual_task for line in lines for run in line.runs)
        if reference is not None and "model.form" in keys and noise == "none" and usual:
            for form, style in (("nonlinear", "-"), ("affine", ":")):
                curves = reference.model_form(task, form)
                if curves is not None:
                    authors.append(Grey(f"authors' logs, {form}", style, curves))
        panels.append(Panel(named(name, title(task, noise)), lines, authors))
    return plot_panels(panels, file)


def _name(study: Study, cell: Cell, keys: Sequence[str], row: int) -> str:
    """A legend label: the settings, or the row of the table if there are many."""
    settings = study.describe(cell, keys)
    if len(settings) > _LONGEST_LABEL:
        settings = f"{settings[:_LONGEST_LABEL]} ... (row {row} of the table)"
    return ", ".join(filter(None, (arm_label(cell.arm), settings)))


def _keys_text(keys: Sequence[str]) -> str:
    return " and ".join(map(code, keys)) if len(keys) <= _MOST_KEYS else f"{len(keys)} settings"


def _time(page: Page, study: Study) -> None:
    rows = time_rows(study)
    if not rows:
        return
    page.heading(
        "Where the time goes",
        "Wall-clock seconds of an outer iteration in each of its phases, medians over all "
        "iterations of the finished runs, and the mean training time per real step. The times "
        "depend on the machine and its other load.",
    )
    page.text(time_table(rows, study.facts))
    page.csv("time", rows)


def time_rows(study: Study) -> list[dict[str, Any]]:
    """Seconds per outer iteration in each phase, for each main cell whose times are known.

    The phases in the table are medians over all outer iterations of all finished runs, and
    ``ms_per_step`` is the training time per real step of whole runs, including random data but
    not ``evaluate``. If an algorithm has several stages, there is a row for each, of its
    iterations and real steps, and ``share`` is its share of the training time.
    """
    rows = []
    phases = tuple(study.facts.timed_phases)
    for cell, runs in study.cells.items():
        timed = [run for run in runs if run.finished and np.isfinite(run.milliseconds_per_step)]
        if cell.variant or not timed:
            continue
        place = {"task": cell.task, "noise": cell.noise, "l1": cell.arm}
        if not study.facts.named_stages:
            whole = [np.full(len(run.returns), True) for run in timed]
            rows.append({**place, "runs": len(timed), **_times(timed, whole, phases)})
        for position, stage in enumerate(study.facts.named_stages):
            during = [run.during(position) for run in timed]
            if any(part.any() for part in during):
                whose = {**place, "stage": stage.name, "runs": len(timed)}
                rows.append({**whose, **_times(timed, during, phases), **_share(timed, during)})
    return rows


def _times(
    runs: Sequence[Run], parts: Sequence[np.ndarray], phases: Sequence[str]
) -> dict[str, float]:
    """Medians over the outer iterations of these parts of the runs, and the time per real step."""
    found = {
        phase: [run.seconds[phase][part] for run, part in zip(runs, parts, strict=True)]
        for phase in phases
    }
    steps = [
        np.diff(run.real_steps, prepend=0)[part].sum()
        for run, part in zip(runs, parts, strict=True)
    ]
    seconds = [_seconds(run, part) for run, part in zip(runs, parts, strict=True)]
    per_step = [1000 * t / n if n else math.nan for t, n in zip(seconds, steps, strict=True)]
    return {
        **{phase: float(np.median(np.concatenate(times))) for phase, times in found.items()},
        "ms_per_step": float(np.mean(per_step)),
    }


def _share(runs: Sequence[Run], parts: Sequence[np.ndarray]) -> dict[str, float]:
    shares = [_seconds(run, part) / _seconds(run) for run, part in zip(runs, parts, strict=True)]
    return {"share": float(np.mean(shares))}


def _seconds(run: Run, part: np.ndarray | slice = slice(None)) -> float:
    return float(run.training_seconds[part].sum())


def time_table(rows: Sequence[Row], algorithm: AlgorithmFacts) -> str:
    """The rows of :func:`time_rows` as Markdown."""
    headings = algorithm.timed_phases
    return markdown(
        [
            {
                "task": row["task"],
                "noise": row["noise"],
                "L1": row["l1"],
                "stage": row.get("stage", ""),
                "runs": str(row["runs"]),
                **{f"{words}, s": number(row[phase]) for phase, words in headings.items()},
                "training, ms per real step": number(row["ms_per_step"]),
                "share of the training": f"{row['share']:.0%}" if "share" in row else "",
            }
            for row in rows
        ]
    )
