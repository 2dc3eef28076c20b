"""The sections on evaluations of frozen policies: rows, tables and text."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from torchrl_l1.algorithms.collection import ORACLE
from torchrl_l1.algorithms.facts import AlgorithmFacts
from torchrl_l1.envs import DISTURBANCES
from torchrl_l1.experiment.matrix import TUNING, undisturbed
from torchrl_l1.report.evaluation_figures import (
    L1_IN,
    plot_ablation,
    plot_disturbances,
    plot_tuning,
    tuning_rows,
)
from torchrl_l1.report.identity import BASELINE, facts
from torchrl_l1.report.page import (
    Footnotes,
    Page,
    Row,
    difference_text,
    grouped,
    markdown,
    number,
    paper_text,
    return_text,
    values_text,
)
from torchrl_l1.report.published import published_cell
from torchrl_l1.report.reading import Evaluation, condition_columns
from torchrl_l1.report.recovery import (
    controllers,
    disturbance_cells,
    is_about_robustness,
    recovered_text,
    recovery_columns,
    recovery_section,
    training_cells,
    training_seeds,
    varied,
)
from torchrl_l1.report.runs import Run
from torchrl_l1.report.statistics import difference_summary, mean_summary
from torchrl_l1.report.study import Study, noise_order, variant_text
from torchrl_l1.report.style import arm_label, named

Key = tuple[Any, ...]
Section = Callable[[Page, AlgorithmFacts, Sequence[Row]], None]

# Longer tables are only in the CSV.
_MOST_ROWS = 160

# Columns of measurements, with the field of an evaluation that each shows and a factor.
_MEANS = {"steps_mean": ("steps_mean", 1), "switches_per_1000_steps": ("switch_rate", 1000)}


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
            robust = is_about_robustness(rows)
            other = _robustness(name) if robust else _other(name)
            special.get(name, other)(page, study.facts, rows)
            if robust and name in special and name != "ablation":
                recovery_section(page, study.facts, name, rows)
            _tuning(page, study.facts, name, rows)
            page.text(_drawn_apart(rows))
            page.csv(name, rows)


def _drawn_apart(rows: Sequence[Row]) -> str:
    """A note if the settings of an evaluation changed before all runs were evaluated."""
    columns = ("episodes_per_seed", "evaluation_seeds")
    mixed = [row for row in rows if any(" " in row[column] for column in columns)]
    if not mixed:
        return ""
    return (
        f"In {len(mixed)} of {len(rows)} rows of the CSV, policies were tested over different "
        "episodes: `episodes_per_seed` has their numbers, `evaluation_seeds` their seeds."
    )


def _sim_to_real(page: Page, algorithm: AlgorithmFacts, rows: Sequence[Row]) -> None:
    page.heading(
        "Sim to real",
        "Policies and models trained without noise, frozen and tested with it, L1 off and on"
        + _papers_table(algorithm, "sim_to_real")
        + ": mean ± standard deviation over training seeds, 95 % interval of "
        "the mean; differences are taken policy by policy.",
    )
    _evaluation_tables(page, algorithm, rows)


def _ablation(page: Page, algorithm: AlgorithmFacts, rows: Sequence[Row]) -> None:
    page.heading(
        "Ablation",
        "L1 in neither phase, in one of them, or in both"
        + _papers_table(algorithm, "ablation", " and ablation figure")
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
        f"Return of frozen policies against {_disturbances_in_words(rows)} that the model "
        "has never seen: mean over training seeds, with its 95 % interval as a band; below it, the "
        "difference from the same policies without L1, with the interval of its mean.",
    )
    _against_magnitudes(page, algorithm, "disturbances", rows)


def _against_magnitudes(
    page: Page, algorithm: AlgorithmFacts, name: str, rows: Sequence[Row]
) -> None:
    for heading, words, chosen in training_cells(rows):
        stage = _stage(chosen[0])
        heading += f", stage {stage}" * bool(stage)
        file = page.file(name, *words)
        drawn = plot_disturbances(chosen, named(page.name, heading), file, algorithm)
        page.figure(drawn, heading)


def _robustness(name: str) -> Section:
    def section(page: Page, algorithm: AlgorithmFacts, rows: Sequence[Row]) -> None:
        page.heading(
            "Robustness" if name == "robustness" else f"Evaluation `{name}`",
            "Frozen policies under one disturbance at a time, which neither they nor their models "
            "have seen: mean ± standard deviation over training seeds.",
        )
        recovery_section(page, algorithm, name, rows)
        page.text(
            "Against the magnitude, if there are several: means over training seeds with their "
            "95 % intervals as bands; below, the differences from the same policies without L1."
        )
        _against_magnitudes(page, algorithm, name, rows)

    return section


def _disturbances_in_words(rows: Sequence[Row]) -> str:
    """The disturbances that vary in a table, in words.

    Examples:
        >>> _disturbances_in_words([{"bias": 0.5, "gain": 1.0}, {"bias": 0.0, "gain": 0.6}])
        'an actuator bias and an actuator gain'
    """
    words = [DISTURBANCES[name].words for name in varied(rows)] or ["disturbance"]
    *rest, last = (f"a{'n' * (text[0] in 'aeiou')} {text}" for text in words)
    return " and ".join(filter(None, (", ".join(rest), last)))


def _tuning(page: Page, algorithm: AlgorithmFacts, name: str, rows: Sequence[Row]) -> None:
    """A figure per training cell, if the tests vary values of the controller."""
    explained = False
    for heading, words, chosen in training_cells(rows):
        policy, swept = tuning_rows(chosen)
        acting = algorithm.acting(policy, _stage(chosen[0]))
        caption = f"{heading}; tested with {acting}" if acting else heading
        file = page.file("sweep", name, *words)
        drawn = plot_tuning(swept, named(page.name, caption), file)
        if drawn is not None and not explained:
            page.text(
                "Switches and returns against the values of the controller that the tests set: "
                "means over training seeds, lines 95 % intervals of the returns; dashed: the "
                "same policies without L1."
            )
            explained = True
        page.figure(drawn, caption)


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
    """The rows by how the policies act, in words: first those with only one way to act."""
    groups: dict[str, list[Row]] = {words: [] for words in ("", *algorithm.kinds.values())}
    for row in rows:
        groups[algorithm.actions(row["policy"], _stage(row))].append(row)
    yield from ((words, found) for words, found in groups.items() if found)


def _papers_table(algorithm: AlgorithmFacts, kind: str, more: str = "") -> str:
    table = algorithm.tables.get(kind)
    return f" (the paper's Table {table}{more})" if table else ""


def _stage(row: Row) -> str:
    return str(row.get("stage", ""))


def _listed(*words: str) -> str:
    return ", ".join(filter(None, words))


def evaluation_names(study: Study) -> list[str]:
    """Names of the evaluations."""
    return sorted({name for run in study.runs for name in run.evaluations})


def evaluation_rows(study: Study, name: str) -> list[dict[str, Any]]:
    """One row per cell of the training and condition of the test.

    ``return_values`` holds the mean returns of the single training seeds, ``std`` is their
    population standard deviation (as in the paper's tables), and the differences are from the same
    policies tested without L1. Unfinished runs are left out. If ``l1`` equals ``training_l1``, the
    policy was tested with the controller of its training; another controller of that name is
    marked. If the test has set values of the controller, ``l1`` names them, and ``option``,
    ``epsilon`` and ``alpha`` hold them. There is a ``stage`` if a test names it, and
    :func:`~torchrl_l1.report.recovery.recovery_columns` if an oracle was also tested and the
    returns of single episodes are known.
    """
    rows = []
    for cell, runs in study.cells.items():
        done = [run for run in runs if run.finished and name in run.evaluations]
        tests: dict[Key, list[tuple[Run, Evaluation]]] = {}
        for run in done:
            for test in run.evaluations[name]:
                key = (_tested(run, test), *test.condition[1:])
                tests.setdefault(key, []).append((run, test))
        names = condition_columns()
        places = {key: study.facts.position(key[-1]) for key in tests}
        for key in sorted(tests, key=lambda key: (places[key], _order(key, tests[key][0][1]))):
            rows.append(
                {
                    "task": cell.task,
                    "training_noise": cell.noise,
                    "training_l1": cell.arm,
                    "variant": variant_text(cell.variant),
                    **dict(zip(names, key, strict=True)),
                    **_set_values(tests[key][0][1]),
                    **_summary(tests[key]),
                    **_against_baseline(key, tests),
                    **_against_oracle(key, tests),
                    **_published(runs[0], key),
                }
            )
    if not any(row["stage"] for row in rows):
        for row in rows:
            del row["stage"]
    return rows


def ablation_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The rows of an evaluation that make up the ablation, with the ``phase`` of L1.

    The test has the noise of the training and no disturbance, and L1 is on in both phases, in
    one, or in neither. If L1 is on in both, it is the same L1. The oracle does not count as L1.
    """
    chosen = []
    for row in rows:
        trained, tested = row["training_l1"], row["l1"]
        on = {trained, tested} - {BASELINE}
        same = undisturbed(row) and row["training_noise"] == row["noise"]
        if same and len(on) < 2 and tested != ORACLE:
            chosen.append({**row, "phase": _l1_in(trained, tested)})
    return sorted(chosen, key=lambda row: L1_IN.index(row["phase"]))


def _l1_in(trained: str, tested: str) -> str:
    """Phase with L1 on: ``neither``, ``training only``, ``testing only`` or ``both``."""
    if trained == BASELINE:
        return "neither" if tested == BASELINE else "testing only"
    return "training only" if tested == BASELINE else "both"


def _tested(run: Run, test: Evaluation) -> str:
    """The controller of a test; the training's L1 setting if it is the training's controller."""
    what = run.identity
    if test.tuned or BASELINE in (what.arm, test.l1):
        return test.controller
    # Older tables were made with the shipped options.
    own = test.l1 == what.shipped if test.own_l1 is None else test.own_l1
    if own:
        return what.arm
    return f"{test.l1} (not as trained)" if test.l1 == what.arm else test.l1


def _set_values(test: Evaluation) -> dict[str, Any]:
    return {"option": test.l1, **test.tuning} if test.tuned else {}


def _summary(tests: Sequence[tuple[Run, Evaluation]]) -> dict[str, Any]:
    values = [test.return_mean for _, test in tests]
    mean = mean_summary("return", values)
    result: dict[str, Any] = {
        "training_seeds": len(values),
        "episodes_per_seed": " ".join(sorted({str(test.episodes) for _, test in tests})),
        "evaluation_seeds": " ".join(
            sorted({str(test.seed) for _, test in tests if test.seed is not None})
        ),
        "return_mean": mean.pop("return_mean"),
        "std": float(np.std(values)),
        "return_values": " ".join(f"{value:.6g}" for value in values),
        **mean,
    }
    for column, (field, factor) in _MEANS.items():
        value = factor * float(np.mean([getattr(test, field) for _, test in tests]))
        if np.isfinite(value):
            result[column] = value
    return result


def _against_baseline(
    key: Key, tests: Mapping[Key, Sequence[tuple[Run, Evaluation]]]
) -> dict[str, Any]:
    if key[0] == BASELINE:
        return {}
    without = {run.path: test.return_mean for run, test in tests.get((BASELINE, *key[1:]), ())}
    return difference_summary(
        [test.return_mean - without[run.path] for run, test in tests[key] if run.path in without]
    )


def _against_oracle(
    key: Key, tests: Mapping[Key, Sequence[tuple[Run, Evaluation]]]
) -> dict[str, Any]:
    if key[0] in (BASELINE, ORACLE):
        return {}

    def returns(l1: str) -> dict[Hashable, Sequence[float]]:
        return {run.path: test.returns for run, test in tests.get((l1, *key[1:]), ())}

    return recovery_columns(returns(BASELINE), returns(key[0]), returns(ORACLE))


def _published(run: Run, key: Key) -> dict[str, str]:
    row = dict(zip(condition_columns(), key, strict=True))
    what = run.identity
    usual = undisturbed(row) and row["policy"] == "stochastic"
    if not (usual and what.as_published and "sim_to_real" in facts(what.algorithm).tables):
        return {}
    cell = published_cell(what.task, what.noise, what.arm, row["noise"], row["l1"])
    return {} if cell is None else cell.columns()


def _order(key: Key, test: Evaluation) -> Key:
    l1, noise, *disturbances, policy, _ = key
    # By value: sorted as text, 10 would precede 3.
    option = test.l1 if test.tuned else l1
    controller = (option, *(value or 0.0 for value in test.tuning.values()))
    place = (policy != "stochastic", noise_order(noise), *disturbances)
    return *place, (l1 != BASELINE) + (l1 == ORACLE), controller


def evaluation_table(rows: Sequence[Row]) -> str:
    """Frozen policies under other conditions than in training, a column per L1.

    Args:
        rows: rows of one kind of policy and one L1 setting of the training.
    """
    notes = Footnotes()
    tested = controllers(rows)
    names = varied(rows)
    keys = ("task", "training_noise", "variant", "stage", "noise", *DISTURBANCES)
    lines = []
    for _, found in grouped(rows, keys, "l1"):
        first = next(iter(found.values()))
        line = _place(first, names) | {"training seeds": training_seeds(found)}
        line |= {arm_label(l1): return_text(found.get(l1)) for l1 in tested}
        on = [l1 for l1 in tested if l1 != BASELINE]
        line |= {f"{arm_label(l1)} less off": difference_text(found.get(l1, {})) for l1 in on}
        line |= {f"{arm_label(l1)} recovered": recovered_text(found.get(l1, {})) for l1 in on}
        line |= {f"paper, L1 {l1}": paper_text(found.get(l1, {}), notes) for l1 in tested}
        lines.append(line)
    return notes.below(markdown(lines))


def tuning_table(rows: Sequence[Row]) -> str:
    """The same if tests set values of the controller: a line per controller.

    Args:
        rows: rows of one kind of policy and one L1 setting of the training.
    """
    names = varied(rows)
    lines = [
        {
            **_place(row, names),
            "L1": row.get("option", row["l1"]),
            **{name: number(row.get(name)) for name in TUNING},
            "training seeds": str(row["training_seeds"]),
            "return": return_text(row),
            "less off": difference_text(row),
            "recovered": recovered_text(row),
            "switches per 1000 steps": number(row.get("switches_per_1000_steps")),
        }
        for row in rows
    ]
    return markdown(lines)


def _place(row: Row, disturbances: Sequence[str]) -> dict[str, str]:
    """The columns that locate a test; neutral ones are left empty.

    Args:
        row: row of the table.
        disturbances: names of the disturbances that vary in the table.
    """
    return {
        "task": row["task"],
        "training noise": "" if row["training_noise"] == "none" else row["training_noise"],
        "variant": row["variant"],
        "stage": _stage(row),
        "noise": row["noise"],
        **disturbance_cells(row, disturbances),
    }


def ablation_table(rows: Sequence[Row]) -> str:
    """L1 in neither phase, in one or in both, side by side.

    Args:
        rows: rows of one kind of policy and one kind of L1.
    """
    notes = Footnotes()
    lines = []
    keys = ("task", "noise", "variant", "stage")
    for cell, found in grouped(rows, keys, "phase"):
        line = dict(zip(keys, cell, strict=True))
        line |= {where: return_text(found.get(where)) for where in L1_IN}
        line["training seeds"] = values_text(
            {where: str(row["training_seeds"]) for where, row in found.items()}
        )
        line |= {f"paper, {where}": paper_text(found.get(where, {}), notes) for where in L1_IN}
        lines.append(line)
    return notes.below(markdown(lines))
