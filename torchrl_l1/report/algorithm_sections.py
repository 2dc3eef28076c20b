"""The section that compares the algorithms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torchrl_l1.report.algorithm_tables import (
    algorithm_pairs,
    algorithm_rows,
    compared_places,
    differing_settings,
)
from torchrl_l1.report.learning_curves import plot_algorithms
from torchrl_l1.report.page import Page
from torchrl_l1.report.rendering import algorithm_pairs_table, algorithm_table
from torchrl_l1.report.study import Study
from torchrl_l1.report.style import title


def algorithm_sections(page: Page, studies: Sequence[Study]) -> None:
    """Curves, returns and differences where several algorithms learned the same task and noise."""
    places = compared_places(studies)
    if not places:
        return
    page.heading(
        "Algorithms",
        "The main runs of the algorithms that learned the same task with the same noise: return by "
        "the same rule, each after the real steps of its own training. In the figures the colour "
        "is the algorithm's, a dashed line is without L1; thin: single seeds; bold: their mean.",
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
            f"`{key}` {_values(values)}"
            for key, values in differing_settings(studies, task).items()
        ]
        if differing:
            lines.append(f"- {task}: {'; '.join(differing)}")
    if not lines:
        return ""
    return "Settings that several have and that differ:\n\n" + "\n".join(lines)


def _values(by_algorithm: Mapping[str, str]) -> str:
    """Such as ``19 (METRPO), 15 (PETS, DETS)``."""
    names: dict[str, list[str]] = {}
    for name, value in by_algorithm.items():
        names.setdefault(value, []).append(name)
    return ", ".join(f"{value} ({', '.join(found)})" for value, found in names.items())
