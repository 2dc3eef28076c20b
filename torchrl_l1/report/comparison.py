"""Comparison of algorithms that learned the same task with the same noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_l1.report.curves import Line, Panel, plot_panels
from torchrl_l1.report.identity import BASELINE
from torchrl_l1.report.page import (
    Page,
    Row,
    difference_columns,
    interval_text,
    markdown,
    spread_text,
    values_text,
)
from torchrl_l1.report.runs import Run
from torchrl_l1.report.statistics import difference_summary
from torchrl_l1.report.study import Cell, Study, noise_order
from torchrl_l1.report.style import algorithm_label, arm_style, title
from torchrl_l1.report.training import training_row

# The columns of a training row that can be compared.
_KEYS = (
    "seeds",
    "return_mean",
    "return_low",
    "return_high",
    "published_spread",
    "real_steps",
    "unfinished",
)


def algorithm_sections(page: Page, studies: Sequence[Study]) -> None:
    """Curves, returns and differences of algorithms that learned the same task and noise."""
    places = compared_places(studies)
    if not places:
        return
    page.heading(
        "Algorithms",
        "The main runs of the algorithms that learned the same task with the same noise: return by "
        "the same rule, each after the real steps of its own training. In the figures, colours "
        "mark the algorithm; dashed lines: without L1; thin: single seeds; bold: their mean.",
    )
    rows = algorithm_rows(studies)
    page.text(algorithm_table(rows))
    page.csv("algorithms", rows)
    page.text(_settings(studies, list(places)))
    for task, noises in places.items():
        figure = plot_algorithms(studies, task, noises, page.file("algorithms", task))
        page.figure(figure, f"Learning curves of the algorithms, {title(task)}")
    pairs = [row for row in algorithm_pairs(studies) if row["pairs"]]
    if pairs:
        page.text(
            "Differences of the same return between runs of the same seed, with 95 % intervals:",
            algorithm_pairs_table(pairs),
        )
        page.csv("algorithm_pairs", pairs)


def _settings(studies: Sequence[Study], tasks: Sequence[str]) -> str:
    lines = []
    for task in tasks:
        differing = [
            f"`{key}` {values_text(values)}"
            for key, values in differing_settings(studies, task).items()
        ]
        if differing:
            lines.append(f"- {task}: {'; '.join(differing)}")
    if not lines:
        return ""
    return "Settings that several of them have and that differ:\n\n" + "\n".join(lines)


def compared_places(studies: Sequence[Study]) -> dict[str, list[str]]:
    """Noises by task for which several algorithms have main cells."""
    found: dict[tuple[str, str], set[str]] = {}
    for study in studies:
        for cell in study.cells:
            if not cell.variant:
                found.setdefault((cell.task, cell.noise), set()).add(study.algorithm)
    places: dict[str, list[str]] = {}
    for (task, noise), algorithms in found.items():
        if len(algorithms) > 1:
            places.setdefault(task, []).append(noise)
    return {task: sorted(noises, key=noise_order) for task, noises in places.items()}


def algorithm_rows(studies: Sequence[Study]) -> list[dict[str, Any]]:
    """The return of each algorithm with each L1 setting, as in the tables of the training."""
    rows = []
    for task, noise in _places(studies):
        for study, cell, runs in _cells(studies, task, noise):
            whole = training_row(cell, runs)
            rows.append(
                {
                    "task": task,
                    "noise": noise,
                    "algorithm": study.facts.name,
                    "l1": cell.arm,
                    **{key: whole[key] for key in _KEYS if key in whole},
                }
            )
    return rows


def algorithm_pairs(studies: Sequence[Study]) -> list[dict[str, Any]]:
    """The return of an algorithm less that of an earlier one, over the seeds that both have.

    Each L1 setting is compared with the other algorithm without L1 and with the same setting.
    """
    rows = []
    for task, noise in _places(studies):
        cells = list(_cells(studies, task, noise))
        for study, cell, runs in cells:
            for other, base, against in cells:
                if studies.index(other) < studies.index(study) and base.arm in (BASELINE, cell.arm):
                    rows.append(
                        {
                            "task": task,
                            "noise": noise,
                            "of": algorithm_label(study.facts.name, cell.arm),
                            "less": algorithm_label(other.facts.name, base.arm),
                            **_differences(runs, against),
                        }
                    )
    return rows


def differing_settings(studies: Sequence[Study], task: str) -> dict[str, dict[str, str]]:
    """Settings that several algorithms share but that differ: their values by algorithm.

    Settings of the controller are compared between cells of the same L1 setting.
    """
    found: dict[tuple[str, str], dict[str, str]] = {}
    for study in studies:
        for cell, runs in study.cells.items():
            if cell.task != task or cell.variant:
                continue
            what = runs[0].identity
            label = algorithm_label(study.facts.name, cell.arm)
            for key, value in what.shared.items():
                found.setdefault(("", key), {})[study.facts.name] = value
            for key, value in what.l1.items():
                found.setdefault((cell.arm, key), {})[label] = value
    differing: dict[str, dict[str, str]] = {}
    for (_, key), values in found.items():
        # The name of the algorithm is not a setting.
        if key not in ("algorithm", "recipe") and len(set(values.values())) > 1:
            differing.setdefault(key, {}).update(values)
    return differing


def _places(studies: Sequence[Study]) -> list[tuple[str, str]]:
    return [(task, noise) for task, noises in compared_places(studies).items() for noise in noises]


def _cells(
    studies: Sequence[Study], task: str, noise: str
) -> Iterator[tuple[Study, Cell, Sequence[Run]]]:
    for study in studies:
        for cell, runs in study.cells.items():
            if (cell.task, cell.noise, cell.variant) == (task, noise, ()):
                yield study, cell, runs


def _differences(runs: Sequence[Run], against: Sequence[Run]) -> Mapping[str, Any]:
    ours, theirs = (
        {run.identity.seed: run.final for run in cell if run.finished} for cell in (runs, against)
    )
    seeds = [seed for seed in ours if seed in theirs]
    every = {run.identity.seed for run in (*runs, *against)}
    return {
        "pairs": len(seeds),
        "seeds": " ".join(map(str, seeds)),
        **difference_summary([ours[seed] - theirs[seed] for seed in seeds]),
        "without_pair": " ".join(map(str, sorted(every - set(seeds)))),
    }


def algorithm_table(rows: Sequence[Row]) -> str:
    """The algorithms with each L1 setting, task by task."""
    lines = [
        {
            "task": row["task"],
            "noise": row["noise"],
            "algorithm": row["algorithm"],
            "L1": row["l1"],
            "return ± spread": spread_text(row.get("return_mean"), row.get("published_spread")),
            "95 % interval": interval_text(row, "return"),
            "seeds": str(row["seeds"]),
            "real steps": str(row.get("real_steps", "–")),
            "unfinished": row["unfinished"],
        }
        for row in rows
    ]
    return markdown(lines)


def algorithm_pairs_table(rows: Sequence[Row]) -> str:
    """Differences between algorithms."""
    lines = [
        {
            "task": row["task"],
            "noise": row["noise"],
            "difference": f"{row['of']} less {row['less']}",
            "pairs": str(row["pairs"]),
            **difference_columns(row),
            "seeds without a pair": row["without_pair"],
        }
        for row in rows
    ]
    return markdown(lines)


def plot_algorithms(
    studies: Sequence[Study], task: str, noises: Sequence[str], file: Path
) -> Path | None:
    """The main cells of all algorithms on a task, one panel per noise.

    Colours mark the algorithm, line styles the L1 setting.

    Returns:
        the file, or ``None`` if no run has finished an iteration.
    """
    arms = list(dict.fromkeys(cell.arm for study in studies for cell in study.cells))
    panels = []
    for noise in noises:
        lines = [
            Line(
                algorithm_label(study.facts.name, cell.arm),
                study.facts.color,
                runs,
                style=arm_style(cell.arm, arms),
            )
            for study, cell, runs in _cells(studies, task, noise)
        ]
        panels.append(Panel(title(task, noise), lines))
    return plot_panels(panels, file)
