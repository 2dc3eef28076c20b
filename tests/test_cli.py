from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from torchrl_l1 import __version__
from torchrl_l1.cli import main
from torchrl_l1.experiment.launch import split_flags

TINY = [
    *("outer_iterations=1", "episodes_per_iteration=2", "horizon=15", "trpo_iterations=1"),
    *("imagined_steps=100", "imagined_horizon=10", "model.members=2", "model.hidden=[8]"),
    *("policy.hidden=[8]", "fit.batch_size=16", "fit.max_epochs=1", "wandb.mode=disabled"),
]
RUN = ["run", "metrpo/inverted_pendulum", *TINY]


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as exit_info:
        main(arguments)
    assert exit_info.value.code not in (0, None)
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    return printed.err


def test_run_resume_and_refusals(capsys: pytest.CaptureFixture[str]) -> None:
    main([*RUN, "run_dir=here"])
    assert "here/metrics.csv" in capsys.readouterr().out
    before = {file: file.read_bytes() for file in Path("here").rglob("*") if file.is_file()}
    assert "already holds a run" in refused([*RUN, "run_dir=here"], capsys)
    message = refused([*RUN, "run_dir=here", "seed=9", "--resume"], capsys)
    assert "another configuration" in message
    assert "seed: 0 there, 9 now" in message
    assert "label must be" in refused([*RUN, "run_dir=there", "label=both"], capsys)
    main(["run", "--resume", *RUN[1:], "run_dir=here"])
    assert "nothing to do" in capsys.readouterr().out
    after = {file: file.read_bytes() for file in Path("here").rglob("*") if file.is_file()}
    assert after == before
    assert not Path("there").exists()


def test_sweep_runs_every_combination() -> None:
    main([*RUN, "-m", "seed=0,1", "run_dir=swept/${label}_${seed}", "label=nominal"])
    assert {path.name for path in Path("swept").iterdir()} == {"nominal_0", "nominal_1"}


def test_default_run_directory_names_recipe_overrides_and_seed() -> None:
    main(["run", "metrpo/inverted_pendulum", "seed=4", *TINY, "l1=off"])
    (metrics,) = Path("runs/metrpo/inverted_pendulum").rglob("metrics.csv")
    assert metrics.parent.name == "seed_4"
    assert "l1=off" in metrics.parent.parent.name
    with metrics.open() as file:
        assert "l1/u_a" not in next(csv.reader(file))


def test_flags_may_stand_anywhere() -> None:
    arguments = ["seed=1", "--cfg", "job", "-p", "l1", "-m", "l1=off"]
    assert split_flags(arguments) == (["--cfg", "job", "-p", "l1", "-m"], ["seed=1", "l1=off"])


def test_composed_recipe_can_be_printed(capsys: pytest.CaptureFixture[str]) -> None:
    main([*RUN, "seed=7", "--cfg", "job"])
    assert "seed: 7" in capsys.readouterr().out
    assert not list(Path().iterdir())


def test_verify_exits_by_its_verdict(capsys: pytest.CaptureFixture[str]) -> None:
    steps, trace = 5, {}
    trace["obs"] = np.zeros((steps, 2))
    trace["drift"] = np.ones((steps, 2))
    trace["jac"] = np.ones((steps, 2, 1))
    for name in ("action", "u", "sigma_m"):
        trace[name] = np.zeros((steps, 1))
    trace["x_hat"] = np.ones((steps, 2))
    trace["switch"] = np.ones(steps, dtype=bool)
    scalars = {"dt": np.array(0.1), "bound": np.array(1.0)}
    trace |= scalars
    # Restarted at each step with a zero action, the controller predicts x + drift.
    np.savez("good.npz", **{f"plant/case/{key}": value for key, value in trace.items()})
    main(["verify", "good.npz"])
    assert "1 of 1 traces" in capsys.readouterr().out
    trace["x_hat"] = trace["x_hat"] + 1e-3
    np.savez("bad.npz", **{f"plant/case/{key}": value for key, value in trace.items()})
    for tolerance in ("1e-9", "nan"):
        with pytest.raises(SystemExit) as exit_info:
            main(["verify", "bad.npz", "--tolerance", tolerance])
        assert exit_info.value.code == 1
        printed = capsys.readouterr().out
        assert "TOO LARGE" in printed and "0 of 1 traces" in printed


def test_a_recipe_is_copied_to_be_edited(capsys: pytest.CaptureFixture[str]) -> None:
    main(["recipes", "--copy", "metrpo/inverted_pendulum", "mine.yaml"])
    assert capsys.readouterr().out == "mine.yaml is yours: torchrl-l1 run mine.yaml\n"
    main(["run", "mine.yaml", "seed=7", "--cfg", "job"])
    assert "recipe: mine" in capsys.readouterr().out
    assert "already exists" in refused(
        ["recipes", "--copy", "metrpo/inverted_pendulum", "mine.yaml"], capsys
    )
    assert "NAME" in refused(["recipes", "--copy", "a", "b", "c"], capsys)


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_info:
        main(["--version"])
    assert exit_info.value.code == 0
    assert capsys.readouterr().out == f"torchrl-l1 {__version__}\n"


def test_unknown_command_and_option_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert "invalid choice" in refused(["train"], capsys)
    assert "unrecognized" in refused(["evaluate", "x", "--loud"], capsys)


def test_arguments_are_left_as_they_were() -> None:
    before = list(sys.argv)
    main([*RUN, "--cfg", "job"])
    assert sys.argv == before


def test_a_closed_pipe_is_told_in_a_line() -> None:
    command = [sys.executable, "-u", "-m", "torchrl_l1.cli", "recipes"]
    read, write = os.pipe()
    os.close(read)
    ended = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert ended.returncode == 1
    assert ended.stderr == "torchrl-l1 recipes: the reader of the output has exited\n"


@pytest.mark.parametrize("name", ["stdout", "stderr"])
@pytest.mark.parametrize("command", ["recipes", "run metrpo/inverted_pendulum --cfg job"])
def test_a_stream_that_was_never_open_is_not_needed(
    command: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, name, None)
    main(command.split())
    getattr(sys, name).close()


@pytest.mark.parametrize("more", [[], ["-m", "seed=0,1"]])
def test_a_run_has_one_option_of_a_group(
    more: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """A list as in a campaign's matrix was one run with all of them, of which the last counts."""
    line = refused([*RUN, "run_dir=here", "l1=[off, paper]", *more], capsys)
    assert "l1=[off, paper]: a run has one l1; use -m l1=off,paper or" in line
    assert not list(Path.cwd().iterdir())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--dt", "nan"], "--dt must be finite and positive, got nan"),
        (["--horizon", "0"], "--horizon must be at least 1, got 0"),
        (["--horizon", "-5"], "--horizon must be at least 1, got -5"),
    ],
)
def test_a_new_recipe_has_no_facts_that_it_would_be_refused_for(
    options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    source = ["--from", "gymnasium/Pendulum-v1"]
    assert message in refused(["new-task", "mine.yaml", *source, *options], capsys)
    assert not list(Path.cwd().iterdir())


@pytest.mark.parametrize(
    "size", ["horizon=100000000000000000", "episodes_per_iteration=1000000000000"]
)
def test_what_no_memory_holds_is_a_line(size: str, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused([*RUN, "run_dir=here", size], capsys)
    assert "fit into the memory of this machine" in line and "episodes" in line
    assert len(line.strip().splitlines()) == 1
