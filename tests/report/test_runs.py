from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from torchrl_l1.experiment.run_directory import RunDirectoryError
from torchrl_l1.report.runs import find_runs

WriteRun = Callable[..., Path]


def test_identity_comes_from_the_configuration(write_run: WriteRun, tmp_path: Path) -> None:
    expected = {
        write_run([1], "l1=off"): ("none", "off"),
        write_run([1], "l1=paper", "noise=action"): ("action", "paper"),
        write_run([1], "l1=reference", "noise=both"): ("both", "reference"),
        write_run([1], "l1=slow", "noise=observation"): ("observation", "slow"),
        write_run([1], "l1=paper", "l1.epsilon=7"): ("none", "paper"),
        write_run([1], "l1=paper", "l1.on_switch=reset"): ("none", "paper"),
        write_run([1], "perturbation.action_noise=0.3"): ("action 0.3, observation 0", "paper"),
    }
    runs = {run.path: run.identity for run in find_runs([tmp_path])}
    assert {path: (what.noise, what.arm) for path, what in runs.items()} == expected
    assert {what.task for what in runs.values()} == {"inverted_pendulum"}


def test_settings_that_do_not_touch_the_result_are_left_out(
    write_run: WriteRun, tmp_path: Path
) -> None:
    write_run([1], "l1=off", "threads=4", "device=cuda", "wandb.mode=offline", "l1.epsilon=9")
    write_run([1], "l1=off", "threads=1", "device=cpu", "resume=true", seed=8)
    first, second = (run.identity for run in find_runs([tmp_path]))
    assert first.shared == second.shared
    assert first.l1 == second.l1 == {}
    assert (first.seed, second.seed) == (0, 8)


def test_a_configuration_older_than_a_setting_has_its_default(
    write_run: WriteRun, tmp_path: Path
) -> None:
    old, new = write_run([1], "model=nonlinear"), write_run([1], "model=affine")
    text = (old / "config.yaml").read_text()
    assert text.count("  form: nonlinear\n") == 1
    (old / "config.yaml").write_text(text.replace("  form: nonlinear\n", ""))
    forms = {run.path: run.identity.model_form for run in find_runs([tmp_path])}
    assert forms == {old: "nonlinear", new: "affine"}


def test_unfinished_runs_say_how_far_they_are(write_run: WriteRun, tmp_path: Path) -> None:
    write_run([1, 2, 3, 4], iterations=4)
    write_run([1, 2], iterations=4)
    write_run([], iterations=4)
    done, half, begun = find_runs([tmp_path])
    assert (done.finished, half.finished, begun.finished) == (True, False, False)
    assert (half.progress, begun.progress) == ("2 of 4", "0 of 4")
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


def test_nothing_to_report_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no run in"):
        find_runs([tmp_path])
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        find_runs([tmp_path / "nowhere"])
