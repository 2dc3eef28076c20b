from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import trim_mean

from torchrl_l1.report.evaluation_tables import ablation_rows, evaluation_rows
from torchrl_l1.report.rendering import ablation_table, evaluation_table, paired_table
from torchrl_l1.report.runs import find_runs
from torchrl_l1.report.tables import markdown, write_csv
from torchrl_l1.report.training_tables import paired_rows, run_rows, training_row
from torchrl_l1.report.variants import Study

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
    assert per_seed.min() < row["return_low"] < row["return_mean"] < row["return_high"]
    assert row["return_high"] < per_seed.max()
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
    off, on = RNG.normal(-50, 10, (2, 7, 3))
    for seed in range(7):
        if seed != 5:
            write_run(off[seed], "l1=off", seed=seed)
        if seed != 6:
            write_run(on[seed], "l1=paper", seed=seed, iterations=4 if seed == 0 else 3)
    # Seed 0 of the L1 arm has other settings (4 iterations): no pair for it.
    stochastic = [
        row
        for row in paired_rows(study(tmp_path))
        if row["policy"] == "stochastic" and not row["variant"]
    ]
    (row,) = stochastic
    differences = on[1:5].mean(axis=1) - off[1:5].mean(axis=1)
    assert (row["pairs"], row["seeds"], row["without_pair"]) == (4, "1 2 3 4", "5")
    assert row["difference_mean"] == pytest.approx(differences.mean())
    assert row["iqm"] == pytest.approx(trim_mean(differences, 0.25))
    assert [float(v) for v in row["differences"].split()] == pytest.approx(
        differences.tolist(), rel=1e-5
    )
    assert row["difference_low"] < row["difference_mean"] < row["difference_high"]
    assert differences.min() <= row["iqm_low"] <= row["iqm_high"] <= differences.max()


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


def test_csv_keeps_full_precision_and_all_columns(tmp_path: Path) -> None:
    write_csv(tmp_path / "table.csv", [{"a": 1 / 3}, {"a": 2.0, "b": "x, y"}])
    with (tmp_path / "table.csv").open() as file:
        first, second = csv.DictReader(file)
    assert float(first["a"]) == 1 / 3
    assert (first["b"], second["b"]) == ("", "x, y")
