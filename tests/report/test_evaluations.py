"""Evaluations of frozen policies: rows, tables, and the summary of the command."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchrl_l1.envs import DISTURBANCES
from torchrl_l1.experiment.matrix import Axis, Condition, axes
from torchrl_l1.report import report
from torchrl_l1.report.evaluation_summary import summarize, summary_tables
from torchrl_l1.report.evaluations import (
    ablation_rows,
    ablation_table,
    evaluation_rows,
    evaluation_table,
)
from torchrl_l1.report.reading import Evaluation, one_policy
from torchrl_l1.report.recovery import robustness_table
from torchrl_l1.report.runs import find_runs
from torchrl_l1.report.study import Study, studies
from torchrl_l1.report.training import training_row

WriteRun = Callable[..., Path]


def study(tmp_path: Path) -> Study:
    return Study(find_runs([tmp_path]))


def evaluated(value: float, *cells: tuple[str, str, str, float]) -> list[dict[str, Any]]:
    """Rows of an evaluation: L1, noise, policy, and what is added to the value."""
    row = {"bias": 0.0, "gain": 1.0, "episodes": 25}
    return [
        row | {"l1": l1, "noise": noise, "policy": policy, "return_mean": value + more}
        for l1, noise, policy, more in cells
    ]


@pytest.mark.parametrize("axis", axes(), ids=lambda axis: axis.name)
def test_tests_that_differ_in_whatever_an_evaluation_varies_are_not_pooled(
    axis: Axis, write_run: WriteRun, tmp_path: Path
) -> None:
    value = 0.25 if axis.kind is float else {"stage": "cloning"}.get(axis.name, "robust")
    value = "deterministic" if axis.name == "policy" else value
    given = {"l1": "paper", axis.name: value}
    varied = {n: given.pop(n) for n in set(given) & set(DISTURBANCES)}
    tests = [Condition("paper"), Condition(**given, disturbances=varied)]
    rows = [
        {**test.columns(), "return_mean": value, "episodes": 5}
        for test, value in zip(tests, (1.0, 2.0), strict=True)
    ]
    assert len(summarize(rows)) == 2
    write_run([1.0], "l1=off", seed=0, evaluations={"mine": rows})
    found = evaluation_rows(study(tmp_path), "mine")
    assert sorted(row["return_mean"] for row in found) == [1.0, 2.0]
    assert {row["training_seeds"] for row in found} == {1}


def test_a_table_says_over_how_many_seeds_each_controller_was_tested(
    write_run: WriteRun, tmp_path: Path
) -> None:
    for seed in range(3):
        tests = [("off", "none", "stochastic", 0.0), ("paper", "none", "stochastic", 1.0)]
        mine = evaluated(-1.0, *tests[: 1 + (seed < 2)])
        write_run([1.0], "l1=off", seed=seed, evaluations={"mine": mine, "ablation": mine})
    rows = evaluation_rows(study(tmp_path), "mine")
    assert [row["training_seeds"] for row in rows] == [3, 2]
    names = ("L1 off", "L1 paper")
    for text, (first, second) in (
        (evaluation_table(rows), names),
        (robustness_table(rows), names),
        (ablation_table(ablation_rows(rows)), ("neither", "testing only")),
    ):
        cells = [line.strip("| ").split(" | ") for line in text.splitlines()]
        seeds = dict(zip(cells[0], cells[2], strict=True))["training seeds"]
        assert seeds == f"3 ({first}), 2 ({second})"


def test_evaluations_over_training_seeds(write_run: WriteRun, tmp_path: Path) -> None:
    values = [-10.0, -20.0, -60.0]
    for seed, value in enumerate(values):
        tests = evaluated(
            value,
            ("paper", "action", "stochastic", 5.0 + seed),
            ("off", "action", "stochastic", 0.0),
            ("off", "action", "deterministic", 1.0),
        )
        write_run([1.0], "l1=off", seed=seed, evaluations={"sim_to_real": tests})
    unfinished = evaluated(1e6, ("off", "action", "stochastic", 0.0))
    write_run([1.0], seed=9, iterations=5, evaluations={"sim_to_real": unfinished})
    rows = evaluation_rows(study(tmp_path), "sim_to_real")
    assert [(row["policy"], row["l1"]) for row in rows] == [
        ("stochastic", "off"),
        ("stochastic", "paper"),
        ("deterministic", "off"),
    ]
    off, on, _ = rows
    assert off["return_mean"] == pytest.approx(-30)
    assert off["std"] == pytest.approx(np.std(values))
    assert (off["training_seeds"], off["paper_mean"], on["paper_mean"]) == (3, "30.2", "-0.0")
    assert on["difference_mean"] == pytest.approx(6.0)
    assert on["differences"] == "5 6 7"
    assert "difference_mean" not in off
    text = evaluation_table(rows[:2])
    assert "| 30.2 ± 45.1 †1 |" in text
    assert "- †1: impossible" in text


@pytest.mark.parametrize(("episodes", "drawn"), [(25, 0), (100, 0), (25, 1)])
def test_a_page_tells_where_policies_of_a_row_had_other_episodes(
    episodes: int, drawn: int, write_run: WriteRun, tmp_path: Path
) -> None:
    for seed, (number, start) in enumerate(((25, 0), (episodes, drawn))):
        tests = [
            test | {"episodes": number}
            for test in evaluated(0.0, ("off", "none", "stochastic", 0.0))
        ]
        run = write_run([1.0], "l1=off", seed=seed, evaluations={"mine": tests})
        (run / "evaluations/mine.yaml").write_text(f"{{iterations: 1, seed: {start}}}")
    page = report([tmp_path / "runs"])
    told = (
        "In 1 of 1 rows of the CSV, policies were tested over different episodes"
        in page.read_text()
    )
    assert told == ((episodes, drawn) != (25, 0))
    with (page.parent / "mine.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert set(row["episodes_per_seed"].split()) == {"25", str(episodes)}
    assert set(row["evaluation_seeds"].split()) == {"0", str(drawn)}


def test_ablation_takes_the_noise_of_the_training_and_one_l1(
    write_run: WriteRun, tmp_path: Path
) -> None:
    everything = [
        (l1, noise, "stochastic", 0.0)
        for l1 in ("off", "paper", "slow")
        for noise in ("none", "action")
    ]
    for arm, value in (("off", -1.0), ("paper", -2.0)):
        tests = evaluated(value, *everything)
        write_run([1.0], f"l1={arm}", "noise=action", evaluations={"ablation": tests})
    rows = ablation_rows(evaluation_rows(study(tmp_path), "ablation"))
    assert [(row["training_l1"], row["l1"], row["phase"]) for row in rows] == [
        ("off", "off", "neither"),
        ("paper", "off", "training only"),
        ("off", "paper", "testing only"),
        ("off", "slow", "testing only"),
        ("paper", "paper", "both"),
    ]
    assert {row["noise"] for row in rows} == {"action"}
    published = {row["phase"]: row.get("paper_mean") for row in rows if row["l1"] != "slow"}
    assert list(published.values()) == ["-105.2", "-3.52", "-49.72", "-0.0"]
    assert "paper, training only" in ablation_table(rows)


def test_ablation_leaves_disturbed_tests_out(write_run: WriteRun, tmp_path: Path) -> None:
    tests = [
        row | {"bias": bias, "gain": gain}
        for row in evaluated(-1.0, ("off", "none", "stochastic", 0.0))
        for bias, gain in ((0.0, 1.0), (1.0, 1.0), (0.0, 0.6))
    ]
    write_run([1.0], "l1=off", evaluations={"ablation": tests})
    (row,) = ablation_rows(evaluation_rows(study(tmp_path), "ablation"))
    assert (row["bias"], row["gain"]) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("overrides", "own", "expected"),
    [
        # Tables that are older than the column own_l1 were made with the options as shipped.
        (("l1=paper", "l1.epsilon=7"), None, ["paper", "slow"]),
        (("l1=paper", "l1.alpha=0.2"), None, ["paper (not as trained)", "slow"]),
        (("l1=paper", "l1.on_switch=reset"), None, ["paper (not as trained)", "slow"]),
        (("l1=slow",), None, ["paper (not as trained)", "paper"]),
        (("l1=paper", "l1.alpha=0.2"), "paper", ["paper", "slow"]),
        (("l1=slow",), "slow", ["paper (not as trained)", "paper"]),
        (("l1=off",), None, ["paper", "slow"]),
    ],
)
def test_both_means_the_controller_of_the_training(
    write_run: WriteRun,
    tmp_path: Path,
    overrides: tuple[str, ...],
    own: str | None,
    expected: list[str],
) -> None:
    tests = evaluated(-1.0, *((l1, "none", "stochastic", 0.0) for l1 in ("off", "paper", "slow")))
    if own is not None:
        tests = [row | {"own_l1": int(row["l1"] == own)} for row in tests]
    write_run([1.0], *overrides, evaluations={"ablation": tests})
    rows = evaluation_rows(study(tmp_path), "ablation")
    assert sorted(row["l1"] for row in rows) == sorted(["off", *expected])
    both = [row["l1"] for row in ablation_rows(rows) if row["phase"] == "both"]
    assert both == ["paper"] * (overrides != ("l1=off",) and "paper" in expected)


def test_set_values_make_controllers_of_their_own(write_run: WriteRun, tmp_path: Path) -> None:
    conditions = [("off", "none", "stochastic", 0.0), ("paper", "none", "stochastic", 0.0)]
    for seed in range(2):
        off, plain = (row | {"own_l1": 0} for row in evaluated(-1.0 - seed, *conditions))
        tests = [off, plain | {"own_l1": 1, "return_mean": -9.0, "l1/switch_rate": 0.25}]
        for epsilon, rate in ((10.0, 0.0), (3.0, 0.1 + seed)):
            swept = {"epsilon": epsilon, "alpha": 0.1, "l1/switch_rate": rate}
            tests.append(plain | swept | {"return_mean": -seed, "own_l1": int(epsilon == 3)})
        tests.append(plain | {"epsilon": 1.0, "alpha": ""})
        columns = {**tests[2], **dict.fromkeys(tests[2], "")}
        tests = [columns | test for test in tests]
        write_run([1.0], "l1=paper", seed=seed, evaluations={"ablation": tests})
    rows = evaluation_rows(study(tmp_path), "ablation")
    # By the values; set values are named where they are those of the training, too.
    assert [row["l1"] for row in rows] == [
        "off",
        "paper",
        "paper epsilon=1",
        "paper epsilon=3 alpha=0.1",
        "paper epsilon=10 alpha=0.1",
    ]
    off, own, only_epsilon, three, ten = rows
    assert "option" not in off and "option" not in own
    assert (three["option"], three["epsilon"], three["alpha"]) == ("paper", 3.0, 0.1)
    assert only_epsilon["alpha"] is None
    assert (three["training_seeds"], three["differences"]) == (2, "1 1")
    rates = [row.get("switches_per_1000_steps") for row in (off, own, three, ten)]
    assert rates == [None, pytest.approx(250), pytest.approx(600), 0]
    assert "switches_per_1000_steps" not in only_epsilon
    assert "paper_mean" in off and "paper_mean" in own and "paper_mean" not in three
    assert "| L1 paper epsilon=3 alpha=0.1 less off |" in evaluation_table(rows)
    assert [row["phase"] for row in ablation_rows(rows)] == ["training only", "both"]


def test_control_affine_runs_have_no_published_cell(write_run: WriteRun, tmp_path: Path) -> None:
    tests = evaluated(-1.0, ("off", "action", "stochastic", 0.0))
    write_run([1.0], "l1=off", "model=affine", evaluations={"sim_to_real": tests})
    found = study(tmp_path)
    ((cell, runs),) = found.cells.items()
    assert "paper_mean" not in training_row(cell, runs)
    assert "paper_mean" not in evaluation_rows(found, "sim_to_real")[0]


def test_the_papers_cells_stand_beside_its_controller_only(
    write_run: WriteRun, tmp_path: Path
) -> None:
    tests = evaluated(-1.0, ("off", "action", "stochastic", 0.0))
    mine = {"evaluations": {"ablation": tests}}
    write_run([1.0], "l1=slow", "noise=action", **mine)
    (slow,) = (training_row(cell, runs) for cell, runs in study(tmp_path).cells.items())
    assert (slow["l1"], slow["variant"]) == ("paper", "") and "paper_mean" not in slow
    assert "paper_mean" not in evaluation_rows(study(tmp_path), "ablation")[0]
    write_run([1.0], "l1=paper", "noise=action", seed=1, **mine)
    rows = [training_row(cell, runs) for cell, runs in study(tmp_path).cells.items()]
    shown = {row["variant"]: row.get("paper_mean") for row in rows}
    assert shown == {"": "-0.0", "l1.alpha=0.1": None}


def test_summary_is_the_median_over_training_seeds() -> None:
    cell = {"policy": "stochastic", "noise": "none", "bias": 0.0, "gain": 1.0, "episodes": 5}
    rows = [
        {**cell, "l1": "off", "return_mean": value, "training_seed": seed}
        for seed, value in enumerate([-3.0, -1.0, -100.0])
    ]
    (entry,) = summarize(rows)
    assert (entry["return_median"], entry["return_lowest"]) == (-3.0, -100.0)
    assert "3 training seeds" in summary_tables([entry])


def test_each_panel_counts_its_own_seeds() -> None:
    cell = {"noise": "none", "bias": 0.0, "gain": 1.0, "episodes": 5, "l1": "off"}
    rows = [
        {**cell, "policy": policy, "return_mean": -1.0}
        for policy in ("stochastic", "stochastic", "deterministic")
    ]
    both, _, one, _ = summary_tables(summarize(rows)).split("\n\n")
    assert "stochastic" in both and "of 2 training seeds" in both
    assert "deterministic" in one and one.endswith("of 1 training seed")


def test_summary_reads_as_a_table_in_a_terminal_and_a_page() -> None:
    cell = {"policy": "stochastic", "noise": "none", "gain": 1.0, "episodes": 5}
    rows = [
        cell | {"l1": l1, "bias": bias, "return_mean": -value * 10 ** (2 * bias)}
        for l1, value in (("off", 1.5), ("paper", 0.25))
        for bias in (0.0, 0.5)
    ]
    # Tables may be older than a disturbance, and the gain is neutral throughout.
    _, table = summary_tables(summarize(rows)).split("\n\n")
    assert table.splitlines() == [
        "| bias |            L1 off |             L1 paper |",
        "| ---- | ----------------- | -------------------- |",
        "|    0 | -1.5 [-1.5, -1.5] | -0.25 [-0.25, -0.25] |",
        "|  0.5 |    -15 [-15, -15] |    -2.5 [-2.5, -2.5] |",
    ]


def test_tests_of_one_way_to_act_count_once_however_named(
    write_run: WriteRun, tmp_path: Path
) -> None:
    def disturbed(*policies: str) -> list[dict[str, Any]]:
        conditions = [(l1, "none", policy, 0.0) for policy in policies for l1 in ("off", "paper")]
        rows = evaluated(0.0, *conditions)
        return [row | {"bias": b, "return_mean": -1 - 9 * b} for row in rows for b in (0.0, 1.0)]

    both = disturbed("deterministic", "stochastic")
    for row in both:
        row["return_mean"] -= 100 * (row["policy"] == "deterministic")
    alone = disturbed("deterministic")
    write_run(
        [1], "l1=off", recipe="pets/inverted_pendulum", evaluations={"both": both, "alone": alone}
    )
    (study,) = studies(find_runs([tmp_path]))
    for name in ("both", "alone"):
        rows = evaluation_rows(study, name)
        assert {row["policy"] for row in rows} == {"stochastic"}
        assert [row["training_seeds"] for row in rows] == [1] * 4
        assert [row["return_mean"] for row in rows] == [-1, -1, -10, -10]


def test_other_algorithms_keep_both_policies_and_repetitions_merge() -> None:
    first = Evaluation(l1="off", policy="deterministic", return_mean=-1.0, episodes=10)
    second = replace(first, policy="stochastic", return_mean=-2.0)
    other = replace(first, disturbances={"bias": 1.0}, return_mean=-3.0)
    found = one_policy([first, second, other])
    assert [(test.policy, test.return_mean) for test in found] == [
        ("stochastic", -2.0),
        ("stochastic", -3.0),
    ]
