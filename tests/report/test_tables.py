from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats
from scipy.stats import trim_mean

from torchrl_l1.experiment.run_directory import write_table
from torchrl_l1.report.evaluation_tables import ablation_rows, evaluation_rows
from torchrl_l1.report.page import markdown
from torchrl_l1.report.rendering import (
    ablation_table,
    evaluation_table,
    paired_table,
    training_table,
)
from torchrl_l1.report.runs import find_runs
from torchrl_l1.report.study import Study
from torchrl_l1.report.training import paired_rows, run_rows, time_rows, time_table, training_row

WriteRun = Callable[..., Path]
RNG = np.random.default_rng(0)


def study(tmp_path: Path) -> Study:
    return Study(find_runs([tmp_path]))


def test_training_row_against_numpy(write_run: WriteRun, tmp_path: Path) -> None:
    returns = RNG.normal(-50, 10, (4, 6))
    for seed, values in enumerate(returns):
        write_run(values, "l1=off", "noise=action", seed=seed, deterministic=values / 2)
    ((cell, runs),) = study(tmp_path).cells.items()
    row = training_row(cell, runs)
    per_seed = returns[:, 3:].mean(axis=1)
    assert row["return_mean"] == pytest.approx(per_seed.mean())
    assert row["deterministic_mean"] == pytest.approx(per_seed.mean() / 2)
    assert row["published_spread"] == pytest.approx(returns[:, 3:].std(axis=0).mean())
    expected = scipy.stats.ttest_1samp(per_seed, 0.0).confidence_interval(0.95)
    assert (row["return_low"], row["return_high"]) == pytest.approx((expected.low, expected.high))
    assert (row["seeds"], row["real_steps"], row["unfinished"]) == (4, 7 * 2500, "")
    assert (row["paper_mean"], row["paper_std"]) == ("-105.2", "81.6")


def test_unfinished_runs_are_listed_and_not_counted(write_run: WriteRun, tmp_path: Path) -> None:
    write_run([0, 0, 6], "l1=off", seed=0)
    write_run([1e6, 1e6], "l1=off", seed=1, iterations=3)
    write_run([], "l1=off", seed=2, iterations=3)
    found = study(tmp_path)
    ((cell, runs),) = found.cells.items()
    row = training_row(cell, runs)
    assert (row["seeds"], row["return_mean"]) == (1, 2.0)
    assert "published_spread" not in row and "return_low" not in row
    assert row["unfinished"] == "seed 1: 2 of 3 iterations; seed 2: 0 of 3 iterations"
    assert [r["return"] for r in run_rows(found)] == [2.0, None, None]
    assert [r["iterations"] for r in run_rows(found)] == [3, 2, 0]


def test_paired_differences_of_the_seeds_that_both_have(
    write_run: WriteRun, tmp_path: Path
) -> None:
    off, on = RNG.normal(-50, 10, (2, 8, 3))
    for seed in range(8):
        if seed != 6:
            write_run(off[seed], "l1=off", seed=seed)
        if seed != 7:
            write_run(on[seed], "l1=paper", seed=seed, iterations=4 if seed == 0 else 3)
    # Seed 0 of the L1 arm has other settings (4 iterations): no pair for it.
    stochastic = [
        row
        for row in paired_rows(study(tmp_path))
        if row["policy"] == "stochastic" and not row["variant"]
    ]
    (row,) = stochastic
    differences = on[1:6].mean(axis=1) - off[1:6].mean(axis=1)
    assert (row["pairs"], row["seeds"], row["without_pair"]) == (5, "1 2 3 4 5", "6")
    assert row["difference_mean"] == pytest.approx(differences.mean())
    assert row["iqm"] == pytest.approx(trim_mean(differences, 0.25))
    assert [float(v) for v in row["differences"].split()] == pytest.approx(
        differences.tolist(), rel=1e-5
    )
    assert row["difference_low"] < row["difference_mean"] < row["difference_high"]
    assert differences.min() <= row["iqm_low"] <= row["iqm_high"] <= differences.max()


def test_four_pairs_have_no_interquartile_mean(write_run: WriteRun, tmp_path: Path) -> None:
    for seed, value in enumerate([10.0, 300.0, 350.0, 900.0]):
        write_run([0.0], "l1=off", seed=seed)
        write_run([value], "l1=paper", seed=seed)
    rows = paired_rows(study(tmp_path))
    assert rows[0]["difference_mean"] == 390.0
    # One seed far off: the interval of so few values holds 0.
    assert rows[0]["difference_low"] < 0 < rows[0]["difference_high"]
    assert not any(key.startswith("iqm") for row in rows for key in row)
    assert "interquartile" not in paired_table(rows)


def test_training_row_says_what_l1_did(write_run: WriteRun, tmp_path: Path) -> None:
    for seed in range(2):
        signals = {"l1/switch_rate": [9.0, 0.1 + seed], "l1/u_a": [1.0, 2.0 + seed]}
        signals["l1/saturation"] = [0.0, 0.5]
        write_run([1, 2], "l1=paper", seed=seed, signals=signals)
        write_run([1, 2], "l1=off", seed=seed)
    rows = {cell.arm: training_row(cell, runs) for cell, runs in study(tmp_path).cells.items()}
    assert rows["paper"]["switches_per_1000"] == pytest.approx(1000 * np.mean([4.55, 5.05]))
    assert rows["paper"]["u_a"] == pytest.approx(np.mean([1.5, 2.0]))
    assert rows["paper"]["saturation"] == pytest.approx(0.25)
    assert "switches_per_1000" not in rows["off"]
    text = training_table(list(rows.values()))
    assert "| switches per 1000 steps | L1 input | saturation |" in text
    assert "| 4800 | 1.75 | 0.25 |" in text
    assert "switches" not in training_table([rows["off"]])


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


def test_few_pairs_are_shown_as_they_are(write_run: WriteRun, tmp_path: Path) -> None:
    for seed, value in enumerate([10.0, 20.0]):
        write_run([value], "l1=off", seed=seed)
        write_run([2 * value], "l1=paper", seed=seed, deterministic=[value])
    rows = paired_rows(study(tmp_path))
    assert [row["differences"] for row in rows] == ["10 20", "0 0"]
    assert not any("difference_low" in row for row in rows)
    text = paired_table(rows)
    assert "| 10, 20 |" in text and "[" not in text


def test_an_arm_without_baseline_has_no_differences(write_run: WriteRun, tmp_path: Path) -> None:
    write_run([1.0], "l1=paper", seed=3)
    row = paired_rows(study(tmp_path))[0]
    assert (row["pairs"], row["without_pair"]) == (0, "3")
    assert "difference_mean" not in row
    assert "3" in paired_table([row])


def evaluated(value: float, *cells: tuple[str, str, str, float]) -> list[dict[str, Any]]:
    """Rows of an evaluation: L1, noise, policy, and what is added to the value."""
    row = {"bias": 0.0, "gain": 1.0, "episodes": 25}
    return [
        row | {"l1": l1, "noise": noise, "policy": policy, "return_mean": value + more}
        for l1, noise, policy, more in cells
    ]


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


def test_markdown_drops_columns_that_say_nothing() -> None:
    rows = [{"a": "1", "b": "", "c": "–"}, {"a": "2", "b": "", "c": "3"}]
    assert markdown(rows) == "| a | c |\n|---|---|\n| 1 | – |\n| 2 | 3 |"


def test_markdown_without_rows_is_empty() -> None:
    assert markdown([]) == ""


def test_csv_keeps_full_precision_and_all_columns(tmp_path: Path) -> None:
    write_table(tmp_path / "table.csv", [{"a": 1 / 3}, {"a": 2.0, "b": "x, y"}])
    with (tmp_path / "table.csv").open() as file:
        first, second = csv.DictReader(file)
    assert float(first["a"]) == 1 / 3
    assert (first["b"], second["b"]) == ("", "x, y")


def test_time_rows_are_medians_of_finished_runs(write_run: WriteRun, tmp_path: Path) -> None:
    def timings(*fits: float) -> list[dict[str, float]]:
        rest = {"random": 0.5, "trpo": 2.0, "collect": 0.25, "evaluate": 100.0}
        return [{"iteration": i, "fit": fit, **rest} for i, fit in enumerate(fits)]

    write_run([1, 2], "l1=off", seed=0, timings=timings(1, 9), steps=1000)
    write_run([1, 2], "l1=off", seed=1, timings=timings(3, 5), steps=1000)
    write_run([1], "l1=off", "outer_iterations=2", seed=2, timings=timings(77), steps=1000)
    write_run([1, 2], "l1=paper", seed=0)
    (row,) = time_rows(study(tmp_path))
    assert (row["l1"], row["runs"]) == ("off", 2)
    assert (row["fit"], row["trpo"], row["collect"], row["evaluate"]) == (4.0, 2.0, 0.25, 100.0)
    # (1 + 9) / 2 or (3 + 5) / 2, and 2.75 for the other phases, in 1500 steps an iteration.
    assert row["ms_per_step"] == pytest.approx(1000 * np.mean([15.5, 13.5]) / 3000)
    assert "| inverted_pendulum | none | off | 2 | 4 | 2 | 0.25 | 100 | 4.83 |" in time_table([row])
