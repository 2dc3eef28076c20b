from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from torchrl_l1.experiment.errors import RunDirectoryError
from torchrl_l1.report.runs import find_readable_runs, find_runs, l1_means

WriteRun = Callable[..., Path]


def test_unfinished_runs_say_how_far_they_are(write_run: WriteRun, tmp_path: Path) -> None:
    write_run([1, 2, 3, 4], iterations=4)
    write_run([1, 2], iterations=4)
    write_run([], iterations=4)
    done, half, begun = find_runs([tmp_path])
    assert (done.finished, half.finished, begun.finished) == (True, False, False)
    assert (half.progress, begun.progress) == ("2 of 4 iterations", "0 of 4 iterations")
    assert done.final == 3.0


def test_folders_may_overlap_and_foreign_files_are_passed_over(
    write_run: WriteRun, tmp_path: Path
) -> None:
    run = write_run([1])
    for folder in (run / "wandb" / "files", tmp_path / "other", tmp_path / ".hidden" / "run"):
        folder.mkdir(parents=True)
    (run / "wandb" / "files" / "config.yaml").write_text("task: x\nseed: 1\n")
    (tmp_path / "other" / "config.yaml").write_text("colour: blue\n")
    (tmp_path / ".hidden" / "run" / "config.yaml").write_text("task: x\nseed: 1\n")
    assert [found.path for found in find_runs([tmp_path, run, run.parent])] == [run]


def spoil(file: Path, before: str, after: str) -> None:
    text = file.read_text()
    assert before in text
    file.write_text(text.replace(before, after, 1))


@pytest.mark.parametrize(
    ("file", "before", "after", "message"),
    [
        ("metrics.csv", "return_mean", "reward", "no column return_mean"),
        ("metrics.csv", "-7.0", "oops", "line 3: return_mean is 'oops'"),
        ("metrics.csv", "-7.0", "nan", "line 3: return_mean is 'nan'"),
        ("metrics.csv", "1,7500", "4,7500", "not 0, 1, 2"),
        ("metrics.csv", "1,7500,-7.0,1.0,-7.0,0.5", "1,75", "return_mean is None"),
        ("config.yaml", "outer_iterations: 3", "outer_iterations: 2", "3 iterations"),
        ("config.yaml", "outer_iterations: 3", "outer_iterations: ???", "no outer_iterations"),
        ("config.yaml", "task:", "task: [", "cannot read"),
        ("versions.json", "{", "[[", "cannot read"),
        ("evaluations/ablation.csv", "bias", "offset", "no column bias"),
        ("evaluations/ablation.csv", "paper", "", "line 2: l1 is empty"),
        ("evaluations/ablation.csv", "none,0,", "none,0,5,", "line 2: more values than the 7"),
        ("evaluations/ablation.csv", "gain", "bias", "has the column bias twice"),
        ("metrics.csv", "policy/std", "return_mean", "has the column return_mean twice"),
        ("evaluations/ablation.csv", "-1,25", "-1,25\npaper,none,0,1,stochastic,-2,25", "line 3"),
    ],
)
def test_a_corrupt_file_is_named(
    write_run: WriteRun, tmp_path: Path, file: str, before: str, after: str, message: str
) -> None:
    row = {"l1": "paper", "noise": "none", "bias": 0, "gain": 1, "policy": "stochastic"}
    row |= {"return_mean": -1, "episodes": 25}
    run = write_run([-9, -7, -5], evaluations={"ablation": [row]})
    spoil(run / file, before, after)
    with pytest.raises(RunDirectoryError) as error:
        find_runs([tmp_path])
    assert str(run / file) in str(error.value)
    assert message in str(error.value)
    if file in ("metrics.csv", "config.yaml"):
        with pytest.raises(RunDirectoryError):
            find_readable_runs([tmp_path])
    else:
        (run,) = find_readable_runs([tmp_path]).runs
        assert run.final == -7.0


def test_a_folder_that_cannot_be_looked_into_is_listed(
    write_run: WriteRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = write_run([-9], name="open/seed_0")
    closed = write_run([-9], name="closed/seed_0", seed=1).parent
    scandir = os.scandir

    def refusing(path: str) -> Any:  # tests may run as root, who may look everywhere
        if Path(path) == closed:
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refusing)
    found = find_readable_runs([tmp_path])
    assert [one.path for one in found.runs] == [run]
    (error,) = found.errors
    assert f"cannot look into {closed}: Permission denied" in str(error)


def test_what_a_table_repeats_counts_once(write_run: WriteRun, tmp_path: Path) -> None:
    row = {"l1": "paper", "noise": "none", "bias": 0, "gain": 1, "policy": "stochastic"}
    table = [row | {"return_mean": -0.5, "episodes": 2}]
    episodes = [row | {"episode": number, "return": -number} for number in (0, 1)]
    tests = {"mine": 2 * table, "episodes/mine": 2 * episodes}
    write_run([-9], evaluations=tests)
    write_run(
        [-9],
        seed=1,
        evaluations={**tests, "episodes/mine": [*episodes, episodes[0] | {"return": 3}]},
    )
    found = find_readable_runs([tmp_path])
    (test,) = found.runs[0].evaluations["mine"]
    assert test.returns == (0.0, -1.0)
    assert not found.runs[1].evaluations
    (error,) = found.errors
    assert "episodes/mine.csv, line 4: its values for L1 paper" in str(error)


def test_a_return_of_no_number_costs_its_own_row_of_an_evaluation(
    write_run: WriteRun, tmp_path: Path
) -> None:
    row = {"noise": "none", "gain": 1, "policy": "stochastic"}
    returns = {("off", 0.0): -1.0, ("off", 0.5): -2.0, ("paper", 0.5): float("nan")}
    conditions = {(l1, bias): row | {"l1": l1, "bias": bias} for l1, bias in returns}
    tests = [conditions[at] | {"return_mean": r, "episodes": 2} for at, r in returns.items()]
    episodes = [
        conditions[at] | {"episode": i, "return": value + i - 0.5}
        for at, value in returns.items()
        for i in range(2)
    ]
    run = write_run([-9], evaluations={"mine": tests, "episodes/mine": episodes, "other": tests})
    spoil(run / "evaluations/other.csv", "nan", "oops")
    found = find_readable_runs([tmp_path])
    kept = {(t.l1, t.disturbances["bias"]): t for t in found.runs[0].evaluations.pop("mine")}
    assert {at: test.return_mean for at, test in kept.items()} == {
        at: value for at, value in returns.items() if at[0] == "off"
    }
    assert kept["off", 0.5].returns == (-2.5, -1.5)
    assert not found.runs[0].evaluations
    assert list(map(str, found.errors)) == [
        f"{run}/evaluations/mine.csv: the return is nan with L1 paper, noise none, stochastic "
        "policy, bias 0.5",
        f"{run}/evaluations/other.csv, line 4: return_mean is 'oops', not a number. Delete it and "
        "start its campaign again",
    ]


def test_an_evaluation_of_before_the_run_has_gone_on_is_left_out(
    write_run: WriteRun, tmp_path: Path
) -> None:
    row = {"l1": "paper", "noise": "none", "bias": 0, "gain": 1, "policy": "stochastic"}
    row |= {"return_mean": -1, "episodes": 25}
    tests = {name: [row] for name in ("now", "then", "damaged", "older")}
    run = write_run([-9, -7, -5], evaluations=tests)
    growing = write_run([-9, -7, -5], iterations=9, evaluations=tests)
    for path in (run, growing):
        (path / "evaluations" / "now.yaml").write_text("iterations: 3\n")
        (path / "evaluations" / "then.yaml").write_text("iterations: 2\n")
        (path / "evaluations" / "damaged.yaml").write_text("iterations: [\n")
    found = find_readable_runs([tmp_path])
    assert set(found.runs[0].evaluations) == {"now", "damaged", "older"}
    (error,) = found.errors
    assert str(run / "evaluations" / "then.csv") in str(error)
    assert "made after 2 iterations, but the run has 3" in str(error)


def test_what_cannot_be_read_is_left_out_and_the_rest_stays(
    write_run: WriteRun, tmp_path: Path
) -> None:
    row = {"l1": "paper", "noise": "none", "bias": 0, "gain": 1, "policy": "stochastic"}
    row |= {"return_mean": -1, "episodes": 25}
    tests = {"ablation": [row], "mine": [row]}
    good, partly, lost, broken = (write_run([-9, -7, -5], evaluations=tests) for _ in range(4))
    spoil(partly / "evaluations" / "mine.csv", "-1", "inf")
    spoil(lost / "metrics.csv", "-7.0", "nan")
    spoil(broken / "config.yaml", "task:", "task: [")
    found = find_readable_runs([tmp_path, good.parent])
    assert {run.path: set(run.evaluations) for run in found.runs} == {
        good: {"ablation", "mine"},
        partly: {"ablation"},
    }
    assert [(run.path, run.progress) for run in found.lost] == [(lost, "cannot be read")]
    assert len(found.errors) == 3
    for error, file in zip(
        found.errors,
        (partly / "evaluations" / "mine.csv", lost / "metrics.csv", broken / "config.yaml"),
        strict=True,
    ):
        assert str(file) in str(error)


def test_signals_and_times_are_read_where_they_are(write_run: WriteRun, tmp_path: Path) -> None:
    phases = ("random", "fit", "trpo", "collect", "evaluate")
    timings = [
        {"iteration": i, **dict.fromkeys(phases, 0.0), "fit": i, "trpo": 1.0, "evaluate": 1e6}
        for i in range(5)
    ]
    signals = {"l1/switch_rate": [9, 9, 0.1, 0.2, 0.3], "l1/u_a": [9, 9, 1, 2, 6]}
    signals["l1/saturation"] = [0, 0, 0, 0, float("nan")]
    path = write_run([1] * 5, "l1=paper", signals=signals, timings=timings, steps=1000)
    bare = write_run([1] * 5, "l1=off")
    runs = {run.path: run for run in find_runs([tmp_path])}
    # Of the last three; what is not known of one of them is not known.
    means = l1_means([runs[path]], [runs[path].ending])
    assert means == pytest.approx({"switches_per_1000": 200.0, "u_a": 3.0})
    assert l1_means([runs[path]], [np.array([4])], ("u_a",)) == {"u_a": 6.0}
    assert l1_means([runs[bare]], [runs[bare].ending]) == {}
    # (0 + 1) + ... + (4 + 1) seconds for 6000 steps, the random ones among them.
    assert runs[path].milliseconds_per_step == pytest.approx(15 / 6000 * 1000)
    assert math.isnan(runs[bare].milliseconds_per_step)


def test_a_short_run_took_its_time_for_all_its_steps(write_run: WriteRun, tmp_path: Path) -> None:
    timing = {"iteration": 0, "random": 1.0, "fit": 2.0, "trpo": 3.0, "collect": 4.0}
    write_run([1], timings=[timing], steps=1000)
    (run,) = find_runs([tmp_path])
    assert run.milliseconds_per_step == pytest.approx(10 / 2000 * 1000)


def test_nothing_to_report_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no run in"):
        find_runs([tmp_path])
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        find_runs([tmp_path / "nowhere"])


def test_episodes_of_another_evaluation_are_told(write_run: WriteRun, tmp_path: Path) -> None:
    """A kill, or a copy by hand, has left the episodes of one beside the table of another."""
    row = {"l1": "paper", "noise": "none", "bias": 0, "gain": 1, "policy": "stochastic"}
    table = [row | {"return_mean": 2.0, "episodes": 3}]
    for seed, returns in enumerate(([1.0, 2.0, 3.0], [10.0, 20.0, 30.0], [2.0, 2.0])):
        episodes = [row | {"episode": i, "return": value} for i, value in enumerate(returns)]
        write_run([-9], seed=seed, evaluations={"mine": table, "episodes/mine": episodes})
    found = find_readable_runs([tmp_path])
    assert [len(run.evaluations.get("mine", ())) for run in found.runs] == [1, 0, 0]
    assert len(found.errors) == 2
    for run, error in zip(found.runs[1:], found.errors, strict=True):
        assert str(error).startswith(
            f"{run.path / 'evaluations/episodes/mine.csv'} does not belong to "
        )
