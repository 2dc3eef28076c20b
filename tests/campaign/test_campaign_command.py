"""Whole campaigns: processes, files, kills."""

from __future__ import annotations

import csv
import fcntl
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from torchrl_l1.campaign.description import read_campaign
from torchrl_l1.campaign.launcher import sweep
from torchrl_l1.campaign.plan import plan
from torchrl_l1.campaign.progress import overview
from torchrl_l1.campaign.runs import PlannedRun
from torchrl_l1.campaign.yaml_file import dump_yaml
from torchrl_l1.cli import main
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.run import run
from torchrl_l1.experiment.run_directory import RunDirectory

PENDULUM = "metrpo/inverted_pendulum"


@pytest.fixture
def campaign_file(tmp_path: Path, tiny_overrides: list[str]) -> Path:
    """A campaign of two tiny runs, to be changed with :func:`edit`."""
    file = tmp_path / "tiny.yaml"
    matrix = {"recipe": PENDULUM, "overrides": tiny_overrides, "matrix": {"seed": [0, 1]}}
    file.write_text(dump_yaml({"description": "two tiny runs", "runs": [matrix]}))
    return file


def edit(file: Path, **entries: Any) -> None:
    content: dict[str, Any] = OmegaConf.to_container(OmegaConf.load(file))
    matrix = entries.pop("matrix", None)
    if matrix is not None:
        content["runs"][0]["matrix"] = matrix
    file.write_text(dump_yaml(content | entries))


def planned(file: Path, output: Path, *overrides: str) -> list[PlannedRun]:
    return plan(read_campaign(str(file), overrides), output)


def command(file: Path, output: Path, *more: str) -> list[str]:
    return ["campaign", str(file), "--output", str(output), "--workers", "2", *more]


def ended_badly(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as exit_info:
        main(arguments)
    assert exit_info.value.code == 1
    printed = capsys.readouterr().err
    assert "Traceback" not in printed
    return printed


def test_killed_campaign_loses_at_most_the_running_iterations(campaign_file: Path) -> None:
    output = campaign_file.parent / "out"
    slower = ["outer_iterations=4", "fit.max_epochs=40", "fit.patience=40"]
    runs = planned(campaign_file, output, *slower)
    arguments = [sys.executable, "-m", "torchrl_l1.cli", *command(campaign_file, output, *slower)]
    log = campaign_file.with_suffix(".log")
    with log.open("w") as handle:
        process = subprocess.Popen(arguments, stdout=handle, stderr=handle)
        while process.poll() is None and not any(map(timings, runs)):
            time.sleep(0.005)
        time.sleep(random.uniform(0, max(map(mean_seconds, runs))))
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL, log.read_text()
    if sys.platform.startswith("linux"):
        # Its processes end with it, without any help.
        while any(run.directory.held() for run in runs):
            time.sleep(0.01)
    before = {run.directory.path: timings(run) for run in runs}
    assert any(before.values())
    assert not all(run.finished() for run in runs)

    assert subprocess.run(arguments, stdout=subprocess.DEVNULL).returncode == 0
    for seed, this in enumerate(sorted(runs, key=str)):
        # An iteration that is done again takes another time: these were not.
        kept = before[this.directory.path]
        assert timings(this)[: len(kept)] == kept
        unbroken = campaign_file.parent / f"unbroken_{seed}"
        run(compose(PENDULUM, [*this.overrides, f"run_dir={unbroken}"]))
        assert this.directory.metrics_file.read_text() == (unbroken / "metrics.csv").read_text()


def mean_seconds(this: PlannedRun) -> float:
    rows = list(csv.DictReader(timings(this)))
    total = sum(float(v) for row in rows for k, v in row.items() if k != "iteration")
    return total / max(len(rows), 1)


def timings(this: PlannedRun) -> list[str]:
    file = this.directory.timing_file
    return file.read_text().splitlines() if file.exists() else []


def test_skips_finishes_evaluates_and_goes_on_past_a_failure(
    campaign_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = campaign_file.parent / "it's a = study"
    evaluation = {"name": "noisy", "l1": ["off"], "noise": ["action"], "episodes": 2}
    evaluation |= {"policy": ["deterministic"], "where": {"seed": [2]}}
    edit(campaign_file, matrix={"seed": [0, 1, 2]}, evaluations=[evaluation])
    done, blocked, fresh = planned(campaign_file, output)
    run(compose(PENDULUM, [*done.overrides, f"run_dir={campaign_file.parent / 'done'}"]))
    done.directory.path.parent.mkdir(parents=True)
    (campaign_file.parent / "done").rename(done.directory.path)
    checkpoint = done.directory.checkpoint_file.read_bytes()
    blocked.directory.path.mkdir()
    (blocked.directory.path / "thesis.tex").write_text("years of work")

    error = ended_badly(command(campaign_file, output), capsys)
    assert "seed=1 ended with status 1" in error
    assert "is not empty and holds no run" in error  # from the end of its log
    assert [p.name for p in blocked.directory.path.iterdir()] == ["thesis.tex"]
    assert done.directory.checkpoint_file.read_bytes() == checkpoint
    assert fresh.finished()
    (row,) = table(fresh, "noisy")
    assert (row["noise"], row["l1"], row["episodes"]) == ("action", "off", "2")
    assert row["run"] == str(fresh.directory.path)
    assert not path_of(done, "noisy").exists()
    assert OmegaConf.load(output / "campaign.yaml").name == "tiny"
    assert "finished, 1 of 1 evaluations" in overview([fresh])

    edit(campaign_file, matrix={"seed": [0, 2]})
    before = {file: file.stat().st_mtime_ns for file in output.rglob("seed_*/**/*.*")}
    main(command(campaign_file, output))
    assert {file: file.stat().st_mtime_ns for file in output.rglob("seed_*/**/*.*")} == before
    # A table is due again for other settings, and if it is older than the checkpoint.
    edit(campaign_file, evaluations=[evaluation | {"bias": [0.5]}])
    assert "finished, 0 of 1 evaluations" in overview(planned(campaign_file, output)[1:])
    os.utime(fresh.directory.checkpoint_file)
    assert "finished, 0 of 1 evaluations" in overview([fresh])


def path_of(this: PlannedRun, name: str) -> Path:
    return this.directory.path / "evaluations" / f"{name}.csv"


def table(this: PlannedRun, name: str) -> list[dict[str, str]]:
    with path_of(this, name).open() as file:
        return list(csv.DictReader(file))


def test_changed_settings_and_a_second_campaign_are_refused(
    campaign_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = campaign_file.parent / "out"
    edit(campaign_file, matrix={"seed": [0]})
    (this,) = planned(campaign_file, output)
    run(compose(PENDULUM, [*this.overrides, f"run_dir={this.directory.path}"]))
    error = ended_badly(command(campaign_file, output, "discount=0.9"), capsys)
    assert "discount: 0.99 there, 0.9 now" in error
    assert "--output" in error
    assert not (output / "campaign.yaml").exists()
    main(command(campaign_file, output))
    with (output / ".lock").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert "another campaign" in ended_badly(command(campaign_file, output), capsys)


def test_directory_of_a_running_run_is_held(tmp_path: Path) -> None:
    directory = RunDirectory(tmp_path / "run")
    assert not directory.held()
    with directory.open({"seed": 0}, resume=False):
        assert RunDirectory(tmp_path / "run").held()
    assert not directory.held()


def test_list_shows_states_and_does_nothing(
    campaign_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = campaign_file.parent / "out"
    main(command(campaign_file, output, "--list"))
    assert capsys.readouterr().out.splitlines() == [
        "waiting  metrpo/inverted_pendulum seed=0",
        "waiting  metrpo/inverted_pendulum seed=1",
        "2 runs: 0 finished, 0 begun, 2 waiting; 0 of 4 iterations",
    ]
    assert not output.exists()
    this, _ = planned(campaign_file, output)
    run(compose(PENDULUM, [*this.overrides, f"run_dir={this.directory.path}"]))
    main(command(campaign_file, output, "--list", "outer_iterations=3"))
    lines = capsys.readouterr().out.splitlines()
    assert lines[-3] == "2 of 3 iterations  metrpo/inverted_pendulum seed=0"
    assert lines[-1] == "2 runs: 0 finished, 1 begun, 1 waiting; 2 of 6 iterations"


def test_sweep_of_a_launcher_fills_the_same_directories(campaign_file: Path) -> None:
    output = campaign_file.parent / "it's a = study"
    edit(campaign_file, matrix={"noise": ["none"], "l1": ["off"], "l1.alpha": [1e-3, 0.1]})
    campaign = read_campaign(str(campaign_file), ["outer_iterations=1"])
    main(sweep(campaign.runs[0], output, "basic"))
    # Planning compares the configuration of each directory with its own.
    runs = plan(campaign, output)
    assert [this.finished() for this in runs] == [True, True]
    assert len(list(output.rglob("metrics.csv"))) == 2
    before = runs[0].directory.checkpoint_file.read_bytes()
    main(sweep(campaign.runs[0], output, "basic"))
    assert runs[0].directory.checkpoint_file.read_bytes() == before
