"""Whole campaigns: processes, files, kills."""

from __future__ import annotations

import csv
import json
import os
import random
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from omegaconf import OmegaConf

from torchrl_l1.campaign import child, jobs, progress
from torchrl_l1.campaign.description import dump_yaml, load_yaml, read_campaign
from torchrl_l1.campaign.evaluation import evaluate_run, is_evaluated
from torchrl_l1.campaign.jobs import sweep
from torchrl_l1.campaign.plan import PlannedRun, plan
from torchrl_l1.campaign.progress import overview
from torchrl_l1.campaign.workers import TAKEN
from torchrl_l1.cli import main
from torchrl_l1.experiment.errors import RunDirectoryError
from torchrl_l1.experiment.files import locked
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
    for key in ("recipe", "matrix"):
        if key in entries:
            content["runs"][0][key] = entries.pop(key)
    file.write_text(dump_yaml(content | entries))


def planned(file: Path, output: Path, *overrides: str) -> list[PlannedRun]:
    return plan(read_campaign(str(file), overrides), output)


def train(this: PlannedRun, folder: Path | None = None, **settings: Any) -> None:
    config = OmegaConf.merge(this.config, settings)
    config.run_dir = str(folder or this.directory.path)
    run(config)


def command(file: Path, output: Path, *more: str) -> list[str]:
    return ["campaign", str(file), "--output", str(output), "--workers", "2", *more]


def ended_badly(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as exit_info:
        main(arguments)
    assert exit_info.value.code == 1
    printed = capsys.readouterr().err
    assert "Traceback" not in printed
    return printed


def test_killed_campaign_loses_at_most_the_running_iterations(
    campaign_file: Path, start_cli: Callable[..., Any]
) -> None:
    output = campaign_file.parent / "out"
    slower = ["outer_iterations=4", "fit.max_epochs=40", "fit.patience=40"]
    runs = planned(campaign_file, output, *slower)
    arguments = command(campaign_file, output, *slower)
    log = campaign_file.with_suffix(".log")
    process = start_cli(arguments, log)
    while process.poll() is None and not any(map(timings, runs)):
        time.sleep(0.005)
    time.sleep(random.uniform(0, max(map(mean_seconds, runs))))
    process.kill()
    assert process.wait() == -signal.SIGKILL, log.read_text()
    if sys.platform.startswith("linux"):
        # Its processes end with it, without any help.
        while any(run.directory.held() for run in runs):
            time.sleep(0.01)
    before = {run.directory.path: timings(run) for run in runs}
    assert any(before.values())
    assert not all(run.finished() for run in runs)

    assert start_cli(arguments, log).wait() == 0, log.read_text()
    for seed, this in enumerate(sorted(runs, key=str)):
        # An iteration that is done again takes another time: these were not.
        kept = before[this.directory.path]
        assert timings(this)[: len(kept)] == kept
        unbroken = campaign_file.parent / f"unbroken_{seed}"
        train(this, unbroken)
        assert this.directory.metrics_file.read_text() == (unbroken / "metrics.csv").read_text()


def mean_seconds(this: PlannedRun) -> float:
    rows = list(csv.DictReader(timings(this)))
    total = sum(float(v) for row in rows for k, v in row.items() if k != "iteration")
    return total / max(len(rows), 1)


def timings(this: PlannedRun) -> list[str]:
    file = this.directory.timing_file
    return file.read_text().splitlines() if file.exists() else []


def test_skips_finishes_evaluates_and_goes_on_past_a_failure(
    campaign_file: Path, start_cli: Callable[..., Any]
) -> None:
    output = campaign_file.parent / "it's a = study"
    evaluation = {"name": "noisy", "l1": ["off"], "noise": ["action"], "episodes": 2}
    evaluation |= {"policy": ["deterministic"], "where": {"seed": [2]}}
    edit(campaign_file, matrix={"seed": [0, 1, 2]}, evaluations=[evaluation])
    done, blocked, fresh = planned(campaign_file, output)
    train(done)
    checkpoint = done.directory.checkpoint_file.read_bytes()
    blocked.directory.path.mkdir()
    (blocked.directory.path / "thesis.tex").write_text("years of work")

    log = campaign_file.with_suffix(".log")
    assert start_cli(command(campaign_file, output), log).wait() == 1
    error = log.read_text()
    assert "Traceback" not in error
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
    # A table is due again for other settings, and if its run has gone on since.
    edit(campaign_file, evaluations=[evaluation | {"bias": [0.5]}])
    assert "finished, 0 of 1 evaluations" in overview(planned(campaign_file, output)[1:])
    # Tables that are older than lists of epsilon, and than alpha, count on.
    described = path_of(fresh, "noisy").with_suffix(".yaml")
    now = described.read_text()
    older = {k: v for k, v in load_yaml(described).items() if k != "alpha"} | {"epsilon": None}
    described.write_text(dump_yaml(older))
    assert "finished, 1 of 1 evaluations" in overview([fresh])
    described.write_text(dump_yaml(older | {"epsilon": 0.3}))
    assert "finished, 0 of 1 evaluations" in overview([fresh])
    for broken in ("[]", "iterations: 2\nloudness: 3", now.replace("iterations", "rounds")):
        described.write_text(broken)
        assert "finished, 0 of 1 evaluations" in overview([fresh])
    described.write_text(now)
    # A copy keeps no times; what counts is the number of iterations.
    os.utime(fresh.directory.checkpoint_file)
    assert "finished, 1 of 1 evaluations" in overview([fresh])
    assert load_yaml(described)["iterations"] == 2
    # A row that the run has not written is none.
    with fresh.directory.metrics_file.open("a") as file:
        file.write("another,row\n")
    assert "0 of 2 iterations" in overview([fresh])


def test_evaluation_sweeps_epsilon_and_alpha(campaign_file: Path) -> None:
    sweep = {"name": "tuning", "epsilon": [0.5, 2], "alpha": 0.1, "policy": ["stochastic"]}
    edit(campaign_file, matrix={"seed": [0]}, evaluations=[sweep | {"episodes": 1}])
    (this,) = planned(campaign_file, campaign_file.parent / "out")
    train(this)
    (settings,) = this.evaluations
    assert not is_evaluated(this.directory, settings)
    # As they reach the process that evaluates.
    evaluate_run(str(this.directory.path), "tuning", json.loads(json.dumps(settings.of_a_run())))
    assert is_evaluated(this.directory, settings)
    rows = [(row["l1"], row["epsilon"], row["alpha"]) for row in table(this, "tuning")]
    assert rows == [("off", "", ""), ("paper", "0.5", "0.1"), ("paper", "2.0", "0.1")]
    assert not is_evaluated(
        this.directory, replace(settings, matrix=settings.matrix | {"alpha": [0.2]})
    )


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
    train(this)
    error = ended_badly(command(campaign_file, output, "discount=0.9"), capsys)
    assert "discount: 0.99 there, 0.9 now" in error
    assert "--output" in error
    assert not (output / "campaign.yaml").exists()
    main(command(campaign_file, output))
    with locked(output / ".lock") as ours:
        assert ours
        assert "another campaign" in ended_badly(command(campaign_file, output), capsys)
    before = (output / "campaign.yaml").read_text()
    edit(campaign_file, name="other")
    error = ended_badly(command(campaign_file, output), capsys)
    assert "belongs to another campaign, tiny" in error
    assert "--output" in error
    assert (output / "campaign.yaml").read_text() == before


@pytest.mark.usefixtures("forked_workers")
def test_recipe_edited_meanwhile_changes_no_planned_run(campaign_file: Path) -> None:
    recipe = campaign_file.with_name("own.yaml")
    text = "defaults: [metrpo_recipe, _self_]\nrecipe: own\ntask: inverted_pendulum\n"
    recipe.write_text(text + "discount: 0.9\n")
    edit(campaign_file, matrix={"seed": [0]}, recipe="own.yaml")
    runs = planned(campaign_file, campaign_file.parent / "out")
    recipe.write_text(text + "discount: 0.8\n")
    assert jobs.work_on_runs(runs, 1) == []
    assert OmegaConf.load(runs[0].directory.config_file).discount == 0.9
    assert runs[0].problem() is None
    with pytest.raises(RunDirectoryError, match=r"0\.9 there, 0\.8 now"):
        planned(campaign_file, campaign_file.parent / "out")


def test_launcher_that_leaves_runs_or_trains_others_is_told(
    campaign_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A launcher that lost some of its jobs, and one that composed a recipe edited meanwhile."""
    output = campaign_file.parent / "out"
    monkeypatch.setattr(jobs, "_child", lambda *arguments: ["true"])
    error = ended_badly(command(campaign_file, output, "--launcher", "basic"), capsys)
    assert "2 of 2 runs are not as planned" in error
    assert "seed=0 has 0 of 2 iterations" in error
    edit(campaign_file, matrix={"seed": [0]}, evaluations=[{"name": "all"}])
    (this,) = planned(campaign_file, output)

    def train_another(*arguments: str) -> list[str]:
        train(this, discount=0.5)
        return ["true"]

    monkeypatch.setattr(jobs, "_child", train_another)
    error = ended_badly(command(campaign_file, output, "--launcher", "basic"), capsys)
    assert "discount: 0.5 there, 0.99 now" in error
    assert not path_of(this, "all").exists()


def test_run_that_lost_its_directory_says_so_to_the_workers(campaign_file: Path) -> None:
    this, _ = planned(campaign_file, campaign_file.parent / "out")
    with (
        this.directory.open(this.settings(), resume=False),
        pytest.raises(SystemExit) as exit_info,
    ):
        child.train({**this.settings(), "resume": True})
    assert exit_info.value.code == TAKEN


def test_time_left_goes_by_real_steps(
    campaign_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    edit(campaign_file, matrix={"episode_steps": [5, 15], "seed": [0]})
    runs = planned(campaign_file, campaign_file.parent / "out")
    assert [this.collected_steps(1) for this in runs] == [2 * 5, 2 * 15]
    clock = SimpleNamespace(monotonic=iter([0.0, 10.0]).__next__)
    monkeypatch.setattr(progress, "time", clock)
    monkeypatch.setattr(progress, "result", lambda this: "done")
    bar = progress.Progress(runs)
    bar.finished(runs[0])
    bar.close()
    # 20 steps took 10 s, 60 are left.
    assert "about 00:30 of training left" in capsys.readouterr().out


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
    train(this)
    main(command(campaign_file, output, "--list", "outer_iterations=3"))
    lines = capsys.readouterr().out.splitlines()
    assert lines[-3] == "2 of 3 iterations  metrpo/inverted_pendulum seed=0"
    assert lines[-1] == "2 runs: 0 finished, 1 begun, 1 waiting; 2 of 6 iterations"


def test_sweep_of_a_launcher_fills_the_same_directories(campaign_file: Path) -> None:
    output = campaign_file.parent / "it's a = study"
    edit(campaign_file, matrix={"noise": ["none"], "l1": ["off"], "trpo.damping": [1e-3, 0.1]})
    campaign = read_campaign(str(campaign_file), ["outer_iterations=1"])
    main(sweep(campaign.runs[0], output, "basic"))
    # Planning compares the configuration of each directory with its own.
    runs = plan(campaign, output)
    assert [this.finished() for this in runs] == [True, True]
    assert len(list(output.rglob("metrics.csv"))) == 2
    before = runs[0].directory.checkpoint_file.read_bytes()
    main(sweep(campaign.runs[0], output, "basic"))
    assert runs[0].directory.checkpoint_file.read_bytes() == before
