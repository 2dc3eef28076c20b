"""The sections about evaluations of frozen policies."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from torchrl_l1.report.algorithms import AlgorithmFacts
from torchrl_l1.report.evaluation_figures import plot_ablation, plot_disturbances
from torchrl_l1.report.evaluation_tables import ablation_rows, evaluation_names, evaluation_rows
from torchrl_l1.report.identity import BASELINE
from torchrl_l1.report.page import Page
from torchrl_l1.report.rendering import ablation_table, evaluation_table, tuning_table
from torchrl_l1.report.study import Study
from torchrl_l1.report.style import arm_label, named, noise_words, title
from torchrl_l1.report.tuning_figures import plot_tuning, tuning_rows

Row = Mapping[str, Any]
Section = Callable[[Page, AlgorithmFacts, Sequence[Row]], None]

# Longer tables are left to their CSV.
_MOST_ROWS = 160


def evaluation_sections(page: Page, study: Study) -> None:
    """A section per evaluation: those of the paper first, then the user's own."""
    special: dict[str, Section] = {
        "sim_to_real": _sim_to_real,
        "ablation": _ablation,
        "disturbances": _disturbances,
    }
    for name in sorted(evaluation_names(study), key=lambda n: ([*special, n].index(n), n)):
        rows = evaluation_rows(study, name)
        if name == "ablation":
            rows = ablation_rows(rows)
        if rows:
            special.get(name, _other(name))(page, study.facts, rows)
            _tuning(page, study.facts, name, rows)
            page.csv(name, rows)


def _sim_to_real(page: Page, algorithm: AlgorithmFacts, rows: Sequence[Row]) -> None:
    page.heading(
        "Sim to real",
        "Policies and models trained without noise, frozen and tested with it, L1 off and on"
        + _published(algorithm, "sim_to_real")
        + ": mean ± standard deviation over training seeds, 95 % interval of "
        "the mean; differences are taken policy by policy.",
    )
    _evaluation_tables(page, algorithm, rows)


def _ablation(page: Page, algorithm: AlgorithmFacts, rows: Sequence[Row]) -> None:
    page.heading(
        "Ablation",
        "L1 in neither phase, in one of them, or in both"
        + _published(algorithm, "ablation", " and ablation figure")
        + ": bars are means, dots training seeds, lines 95 % intervals.",
    )
    for l1 in sorted({row["training_l1"] for row in rows} - {BASELINE}):
        mine = [row for row in rows if {row["training_l1"], row["l1"]} <= {BASELINE, l1}]
        for actions, chosen in _by_actions(algorithm, mine):
            page.text(f"{_listed(f'L1 {l1}', actions)}:", ablation_table(chosen))
        for variant, stage in dict.fromkeys((row["variant"], _stage(row)) for row in mine):
            chosen = [
                row
                for row in mine
                if (row["variant"], _stage(row), row["policy"]) == (variant, stage, "stochastic")
            ]
            if chosen:
                file = page.file("ablation", l1, variant, stage)
                caption = _listed(f"Ablation, L1 {l1}", variant, stage)
                page.figure(plot_ablation(chosen, file, page.name), caption)


def _disturbances(page: Page, algorithm: AlgorithmFacts, rows: Sequence[Row]) -> None:
    page.heading(
        "Disturbances",
        "Return of frozen policies against an actuator bias and an actuator gain that the model "
        "has never seen: mean over training seeds, with its 95 % interval as a band; below it, the "
        "difference to the same policies without L1 with the interval of its mean.",
    )
    for heading, words, chosen in _training_cells(rows):
        stage = _stage(chosen[0])
        heading += f", stage {stage}" * bool(stage)
        file = page.file("disturbances", *words)
        drawn = plot_disturbances(chosen, named(page.name, heading), file, algorithm)
        page.figure(drawn, heading)


def _tuning(page: Page, algorithm: AlgorithmFacts, name: str, rows: Sequence[Row]) -> None:
    """A figure per training cell, where the tests go through values of the controller."""
    explained = False
    for heading, words, chosen in _training_cells(rows):
        policy, swept = tuning_rows(chosen)
        acting = algorithm.acting(policy, _stage(chosen[0]))
        caption = f"{heading}; tested with {acting}" if acting else heading
        file = page.file("sweep", name, *words)
        drawn = plot_tuning(swept, named(page.name, caption), file)
        if drawn is not None and not explained:
            page.text(
                "Switches and returns against the values of the controller that the tests set: "
                "means over training seeds, lines 95 % intervals of the returns; dashed, the "
                "same policies without L1."
            )
            explained = True
        page.figure(drawn, caption)


def _training_cells(rows: Sequence[Row]) -> Iterator[tuple[str, tuple[str, ...], list[Row]]]:
    """The rows of each cell and stage of the training, with a heading and the words of a file."""

    def place(row: Row) -> tuple[str, ...]:
        keys = ("task", "training_noise", "training_l1", "variant")
        return (*(row[key] for key in keys), _stage(row))

    for cell in dict.fromkeys(map(place, rows)):
        task, noise, l1, variant, _ = cell
        heading = f"{title(task)}: trained with {noise_words(noise)} and {arm_label(l1)}"
        heading += f" ({variant})" * bool(variant)
        yield heading, cell, [row for row in rows if place(row) == cell]


def _other(name: str) -> Section:
    def section(page: Page, algorithm: AlgorithmFacts, rows: Sequence[Row]) -> None:
        page.heading(
            f"Evaluation `{name}`",
            "Frozen policies under its conditions: mean ± standard deviation over training "
            "seeds, 95 % interval of the mean; differences are taken policy by policy.",
        )
        _evaluation_tables(page, algorithm, rows)

    return section


def _evaluation_tables(page: Page, algorithm: AlgorithmFacts, rows: Sequence[Row]) -> None:
    """A table per L1 setting of the training and kind of policy."""
    for l1 in dict.fromkeys(row["training_l1"] for row in rows):
        mine = [row for row in rows if row["training_l1"] == l1]
        for actions, chosen in _by_actions(algorithm, mine):
            if len(chosen) <= _MOST_ROWS:
                words = _listed(f"Trained with {arm_label(l1)}", actions)
                swept = any("option" in row for row in chosen)
                table = tuning_table if swept else evaluation_table
                page.text(f"{words}:", table(chosen))


def _by_actions(algorithm: AlgorithmFacts, rows: Sequence[Row]) -> Iterator[tuple[str, list[Row]]]:
    """The rows by how the policies act, in words: those that have no choice first."""
    groups: dict[str, list[Row]] = {words: [] for words in ("", *algorithm.policies.values())}
    for row in rows:
        groups[algorithm.actions(row["policy"], _stage(row))].append(row)
    yield from ((words, found) for words, found in groups.items() if found)


def _published(algorithm: AlgorithmFacts, kind: str, more: str = "") -> str:
    table = algorithm.tables.get(kind)
    return f" (the paper's Table {table}{more})" if table else ""


def _stage(row: Row) -> str:
    return str(row.get("stage", ""))


def _listed(*words: str) -> str:
    return ", ".join(filter(None, words))
