from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.stats
from scipy.stats import trim_mean

from torchrl_l1.report import report, training
from torchrl_l1.report.curves import Panel
from torchrl_l1.report.identity import facts
from torchrl_l1.report.published import ReferenceCurves
from torchrl_l1.report.runs import find_runs
from torchrl_l1.report.study import Study, studies
from torchrl_l1.report.training import (
    paired_rows,
    paired_table,
    plot_comparison,
    run_rows,
    time_rows,
    time_table,
    training_row,
    training_table,
)

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


def test_the_authors_stand_beside_a_shorter_run_as_they_were_then(
    write_run: WriteRun, tmp_path: Path
) -> None:
    write_run(np.zeros(6), "l1=off", "noise=none")  # ends after 7 x 2500 real steps
    file = tmp_path / "curves.csv"
    columns = "arm,setting,seed,iteration,total_train_samples,average_return"
    lines = [
        f"L1_OFF,Inverted_Pendulum,{seed},{i},{(i + 1) * 5000 // 3},{-(i + 1) * 10**seed}"
        for seed in range(2)
        for i in range(20)
    ]
    file.write_text("\n".join([columns, *lines]) + "\n")
    ((cell, runs),) = study(tmp_path / "runs").cells.items()
    row = training_row(cell, runs, ReferenceCurves(file))
    # Iterations 5 to 7 of theirs are the last that end within ours; the whole ends with 18 to 20.
    assert (row["authors_then_mean"], row["authors_mean"]) == (-6 * 5.5, -19 * 5.5)
    assert row["authors_then_spread"] == pytest.approx(6 * 4.5)
    assert "| -33 ± 27 |" in training_table([row])


def test_what_all_runs_do_unlike_their_recipe_is_told_and_bars_the_papers_numbers(
    write_run: WriteRun, tmp_path: Path
) -> None:
    for seed in range(2):
        write_run([1], "l1=off", "horizon=50", seed=seed)
    page = report([tmp_path / "runs"])
    assert "paper_mean" not in (page.parent / "training.csv").read_text()
    (line,) = [line for line in page.read_text().splitlines() if "`horizon=50`" in line]
    assert line == "- inverted_pendulum: `outer_iterations=1`, `horizon=50`"


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
    # Seed 0 of the L1 arm has other settings (4 iterations): no pair for it, nor for its baseline.
    stochastic = [
        row
        for row in paired_rows(study(tmp_path))
        if row["policy"] == "stochastic" and not row["variant"]
    ]
    (row,) = stochastic
    differences = on[1:6].mean(axis=1) - off[1:6].mean(axis=1)
    assert (row["pairs"], row["seeds"], row["without_pair"]) == (5, "1 2 3 4 5", "0 6 7")
    assert row["difference_mean"] == pytest.approx(differences.mean())
    assert row["iqm"] == pytest.approx(trim_mean(differences, 0.25))
    assert [float(v) for v in row["differences"].split()] == pytest.approx(
        differences.tolist(), rel=1e-5
    )
    assert row["difference_low"] < row["difference_mean"] < row["difference_high"]
    assert differences.min() <= row["iqm_low"] <= row["iqm_high"] <= differences.max()


def test_seeds_that_are_lost_leave_a_mark_in_the_tables(
    write_run: WriteRun, tmp_path: Path
) -> None:
    for seed in range(3):
        for arm in ("off", "paper"):
            run = write_run([-3, -2, -1], f"l1={arm}", seed=seed)
            if arm == "paper" and seed:
                metrics = run / "metrics.csv"
                metrics.write_text(metrics.read_text().replace("-1.0", "nan"))
    (run / "diverged.txt").write_text("training diverged in iteration 2")
    page = report([tmp_path / "runs"])
    rows, (pairs, _) = (
        list(csv.DictReader(io.StringIO((page.parent / f"{table}.csv").read_text())))
        for table in ("training", "pairs")
    )
    assert [(row["l1"], row["seeds"]) for row in rows] == [("off", "3"), ("paper", "1")]
    assert rows[1]["unfinished"] == "seed 1: cannot be read; seed 2: diverged"
    assert (pairs["seeds"], pairs["without_pair"]) == ("0", "1 2")
    (line,) = re.findall(rf".*{run}/metrics.csv, line 4.*", page.read_text())
    assert line.endswith("not a finite number. Its training diverged in iteration 2")


def test_more_cells_than_colours_are_told_apart(
    write_run: WriteRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for epsilon in range(9):
        write_run([1], "l1=paper", f"l1.epsilon={epsilon}")
    panels: list[Panel] = []
    monkeypatch.setattr(training, "plot_panels", lambda found, file: panels.extend(found))
    plot_comparison(study(tmp_path), "inverted_pendulum", ["l1.epsilon"], tmp_path / "a.png")
    assert len({(line.color, str(line.style)) for line in panels[0].lines}) == 9


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


def test_one_way_to_act_is_printed_once(write_run: WriteRun, tmp_path: Path) -> None:
    for seed in range(2):
        for arm in ("off", "paper"):
            write_run([1, 2, 3 + seed], f"l1={arm}", recipe="pets/inverted_pendulum", seed=seed)
    (study,) = studies(find_runs([tmp_path]))
    assert "deterministic_mean" not in training_row(*next(iter(study.cells.items())))
    assert "return_deterministic" not in run_rows(study)[0]
    (pair,) = paired_rows(study)
    assert "policy" not in pair and pair["pairs"] == 2


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
    assert "| inverted_pendulum | none | off | 2 | 4 | 2 | 0.25 | 100 | 4.83 |" in (
        time_table([row], facts("metrpo"))
    )


def test_times_are_those_of_the_phases_that_there_are(write_run: WriteRun, tmp_path: Path) -> None:
    timings = [
        {"iteration": i, "random": 0.5 * (i == 0), "fit": 1.0, "collect": 4.0, "evaluate": 100.0}
        for i in range(2)
    ]
    write_run([1, 2], "l1=off", recipe="pets/inverted_pendulum", timings=timings, steps=100)
    (study,) = studies(find_runs([tmp_path]))
    (row,) = time_rows(study)
    assert (row["fit"], row["collect"], row["evaluate"]) == (1.0, 4.0, 100.0)
    assert "trpo" not in row
    # Two times 5 seconds and the random data, for 300 steps.
    assert row["ms_per_step"] == pytest.approx(1000 * 10.5 / 300)
    assert time_table([row], study.facts).splitlines()[0] == (
        "| task | noise | L1 | runs | fit, s | collection, s | measuring returns, s "
        "| training, ms per real step |"
    )
