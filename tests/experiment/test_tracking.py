"""W&B and TensorBoard beside the tables: complete, in one run, whatever happens between."""

from __future__ import annotations

import csv
import gc
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import wandb
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from wandb.proto import wandb_internal_pb2

from tests.conftest import HAS_FORKS
from tests.kills import descendants
from tests.wandb_files import problems, wandb_files
from tests.wandb_server import wandb_server
from torchrl_l1.campaign.description import read_campaign
from torchrl_l1.campaign.plan import plan
from torchrl_l1.cli import main
from torchrl_l1.experiment import tracking
from torchrl_l1.experiment.errors import RunDirectoryError
from torchrl_l1.experiment.evaluate import load_run
from torchrl_l1.experiment.run import run
from torchrl_l1.experiment.settings import METRPORecipe, WandbSettings
from torchrl_l1.experiment.tracking import (
    Evaluated,
    Tracker,
    check_wandb_mode,
    log_evaluation,
    trackers,
)
from torchrl_l1.experiment.wandb_files import ID_FILE, draw_id, known_id, whole_records

Recipe = Callable[..., DictConfig]
OFFLINE = "wandb.mode=offline"


@pytest.fixture(autouse=True)
def _nobody_is_logged_in(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("WANDB_MODE", "WANDB_API_KEY", "WANDB_RESUME", "WANDB_RUN_ID"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    monkeypatch.setenv("WANDB_CONFIG_DIR", str(tmp_path / "wandb_config"))


def settled(run_dir: Path) -> list[str]:
    """What W&B's files lack once its own process has written the last of them."""
    deadline = time.monotonic() + 60
    while (found := problems(run_dir)) and time.monotonic() < deadline:
        time.sleep(0.05)
    return found


def newest(run_dir: Path) -> Path:
    return wandb_files(run_dir)[-1].path


def cut(file: Path, rows: int) -> None:
    """Leave so many whole rows of a file and half of the next, as a kill may."""
    content = file.read_bytes()
    ends = [
        end
        for raw, end in whole_records(content)
        if wandb_internal_pb2.Record.FromString(raw).WhichOneof("record_type") == "history"
    ]
    file.write_bytes(content[: ends[rows] - 5])


def test_offline_files_hold_every_step_with_its_values(tiny_recipe: Recipe) -> None:
    settings = [
        *("wandb.entity=lab", "wandb.project=mine", "wandb.group=night", "wandb.name=first"),
        *("wandb.tags=[a,b]", "wandb.notes=why"),
    ]
    run_dir = run(tiny_recipe(OFFLINE, *settings))
    assert not settled(run_dir)
    (file,) = wandb_files(run_dir)
    written = file.runs[0]
    assert (written.entity, written.project, written.run_group) == ("lab", "mine", "night")
    assert (written.display_name, written.notes, list(written.tags)) == ("first", "why", ["a", "b"])
    config = {item.key for item in written.config.update}
    assert {"task", "model", "versions", "choices"} <= config


@pytest.mark.parametrize("rows", [0, 2])
def test_what_a_kill_has_cut_off_is_logged_again(rows: int, tiny_recipe: Recipe) -> None:
    run_dir = run(tiny_recipe(OFFLINE, "outer_iterations=3"))
    assert not settled(run_dir)
    cut(newest(run_dir), rows)
    assert len(wandb_files(run_dir)[0].history) == rows
    # All iterations are complete: only W&B lacks some.
    run(tiny_recipe(OFFLINE, "outer_iterations=3", "resume=true"))
    assert not settled(run_dir)
    first, second = wandb_files(run_dir)
    assert [len(first.history), len(second.history)] == [rows, 3 - rows]
    # Where nothing is lacking, nothing is written.
    run(tiny_recipe(OFFLINE, "outer_iterations=3", "resume=true"))
    assert len(wandb_files(run_dir)) == 2


def test_an_iteration_that_is_trained_again_is_not_logged_again(tiny_recipe: Recipe) -> None:
    run_dir = run(tiny_recipe(OFFLINE))
    assert not settled(run_dir)
    (run_dir / "checkpoint.pt").write_bytes(b"")
    run(tiny_recipe(OFFLINE, "outer_iterations=3", "resume=true"))
    files = wandb_files(run_dir)
    assert [[row["iteration"] for row in file.history] for file in files] == [[0, 1], [2]]


def test_evaluations_go_to_the_run_and_the_training_goes_on(
    tiny_recipe: Recipe, capsys: pytest.CaptureFixture[str]
) -> None:
    run_dir = run(tiny_recipe(OFFLINE))
    drawn = known_id(run_dir)
    main(["evaluate", str(run_dir), "--episodes", "2", "--bias", "0", "1", "--l1", "off"])
    assert "is not logged" not in capsys.readouterr().err
    run(tiny_recipe(OFFLINE, "outer_iterations=3", "resume=true"))
    assert not settled(run_dir)
    training, evaluation, more = wandb_files(run_dir)
    assert {file.runs[0].run_id for file in (training, evaluation, more)} == {drawn}
    (row,) = evaluation.history
    assert row["evaluation/_type"] == "table-file"
    assert row["evaluation/robustness/_type"] == "image-file"
    assert [row["_step"] for row in more.history] == [3]
    folder = evaluation.path.parent / "files"
    for name in ("evaluation", "evaluation/robustness"):
        assert (folder / row[f"{name}/path"]).is_file()


def test_nothing_of_wandb_where_it_is_not_wanted(tiny_recipe: Recipe, tmp_path: Path) -> None:
    run_dir = run(tiny_recipe("loggers=[]", "wandb.mode=offline"))
    main(["evaluate", str(run_dir), "--episodes", "2", "--bias", "0", "--l1", "off"])
    assert not (run_dir / "wandb").exists() and not (run_dir / ID_FILE).exists()


def test_online_without_a_key_is_a_line_and_leaves_nothing(
    tmp_path: Path, tiny_overrides: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["run", "metrpo/inverted_pendulum", *tiny_overrides, "wandb.mode=online"]
    before = set(tmp_path.iterdir())
    with pytest.raises(SystemExit) as exit_info:
        main([*command, f"run_dir={tmp_path / 'run'}"])
    assert exit_info.value.code == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "wandb.mode=online needs an API key" in line and "wandb login" in line
    assert set(tmp_path.iterdir()) == before


@pytest.mark.parametrize("mode", ["online", "run"])
def test_online_by_the_environment_needs_a_key_too(
    mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_MODE", mode)
    with pytest.raises(ValueError, match=f"WANDB_MODE={mode} needs an API key"):
        check_wandb_mode("auto")
    check_wandb_mode("offline")
    monkeypatch.setenv("WANDB_API_KEY", "short")
    with pytest.raises(ValueError, match="W&B: WANDB_API_KEY invalid"):
        check_wandb_mode("auto")


def test_an_evaluation_that_weights_and_biases_refuses_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Abandoned(Exception):
        """Like W&B's errors about its own process, of no common class and without words."""

    for error, words in (
        (wandb.errors.CommError("no network"), "no network"),
        (Abandoned(), "Abandoned"),
    ):
        monkeypatch.setattr(tracking, "_used", lambda *_: ["wandb"])
        monkeypatch.setattr(tracking, "trackers", Mock(side_effect=error))
        for name in ("metrics.csv", "timing.csv", "config.yaml"):
            (tmp_path / name).touch()
        recipe = METRPORecipe(wandb=WandbSettings(mode="offline"))
        said: list[str] = []
        log_evaluation(recipe, tmp_path, Evaluated("evaluation", []), said.append)
        assert said == [f"{tmp_path}: evaluation is not logged: {words}"]


def test_a_kill_between_the_tables_costs_no_evaluation(tmp_path: Path) -> None:
    drawn = draw_id(tmp_path)
    (tmp_path / "config.yaml").touch()
    (tmp_path / "metrics.csv").write_text("iteration\n0\n")
    (tmp_path / "timing.csv").write_text("iteration,fit\n0,2.5\n1,3.5\n")
    recipe = METRPORecipe(wandb=WandbSettings(mode="offline"))
    said: list[str] = []
    log_evaluation(recipe, tmp_path, Evaluated("evaluation", [{"bias": 0.0}]), said.append)
    assert said == [] and known_id(tmp_path) == drawn
    (file,) = wandb_files(tmp_path)
    training, evaluation = file.history
    assert (training["iteration"], training["seconds/fit"]) == (0, 2.5)
    assert evaluation["evaluation/_type"] == "table-file"


def test_wandb_without_a_home_folder_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container with the number of a user that it does not know."""
    pwd = pytest.importorskip("pwd")
    monkeypatch.setattr(pwd, "getpwuid", Mock(side_effect=KeyError))
    monkeypatch.delenv("HOME", raising=False)
    for mode in ("auto", "offline", "online"):
        with pytest.raises(ValueError, match="set HOME"):
            check_wandb_mode(mode)
    check_wandb_mode("disabled")
    monkeypatch.setenv("WANDB_MODE", "disabled")
    check_wandb_mode("auto")


def test_a_mode_of_the_environment_that_there_is_not_is_named(
    tiny_recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_MODE", "of")
    with pytest.raises(ValueError, match="WANDB_MODE=of: it must be one of online, offline"):
        run(tiny_recipe("wandb.mode=auto"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("loggers=[wandb,paper]", "loggers must be"),
        ("checkpoint.every=0", r"checkpoint\.every"),
        ("wandb.project=a/b", "wandb.project: .* cannot contain characters"),
        ("wandb.tags=['']", "wandb.tags: .* between 1 and 64 characters"),
        ("wandb.tags=[" + 65 * "x" + "]", "wandb.tags: .* between 1 and 64 characters"),
    ],
)
def test_settings_that_cannot_be_meant_are_named(
    override: str, words: str, tiny_recipe: Recipe, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=words):
        run(tiny_recipe(override))
    assert not (tmp_path / "run").exists()


def test_names_tell_arms_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tiny_overrides: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    named = []
    monkeypatch.setattr(
        "torchrl_l1.experiment.launch.run", lambda config: named.append(config.wandb.name)
    )
    monkeypatch.setattr("torchrl_l1.experiment.launch.final_return", lambda run_dir: 0.0)
    recipe = "metrpo/inverted_pendulum"
    main(["run", recipe, "-m", "l1=off,paper", "seed=0,1", "wandb.tags=[x]", "loggers=[wandb]"])
    assert named == [f"{recipe} l1={l1} seed={seed}" for l1 in ("off", "paper") for seed in (0, 1)]
    main(["run", recipe, "wandb.name=mine"])
    assert named[-1] == "mine"
    (tmp_path / "study.yaml").write_text(
        f"runs: [{{recipe: {recipe}, matrix: {{l1: ['off', paper], seed: [0]}}}}]\n"
    )
    runs = plan(read_campaign("study.yaml"), tmp_path)
    assert [one.config.wandb.name for one in runs] == [
        f"{recipe} l1=off seed=0",
        f"{recipe} l1=paper seed=0",
    ]


def test_tensorboard_lacks_nothing_after_a_kill(tiny_recipe: Recipe) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    both = "loggers=[tensorboard]"
    run_dir = run(tiny_recipe(both))
    (events,) = (run_dir / "tensorboard").glob("events*")
    events.write_bytes(events.read_bytes()[:-100])
    run(tiny_recipe(both, "resume=true"))
    run(tiny_recipe(both, "resume=true", "outer_iterations=3"))
    main(["evaluate", str(run_dir), "--episodes", "2", "--bias", "0", "1", "--l1", "off"])
    shown = EventAccumulator(str(run_dir / "tensorboard"), {"scalars": 0}).Reload()
    with (run_dir / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    for name in rows[0]:
        values = {event.step: event.value for event in shown.Scalars(name)}
        assert values == pytest.approx({i: float(row[name]) for i, row in enumerate(rows)})
    assert "evaluation/robustness" in shown.Tags()["images"]


def test_tensorboard_that_is_not_installed_is_a_line(
    tiny_recipe: Recipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torchrl_l1.experiment.tracking.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'torchrl-l1\[tensorboard\]'"):
        run(tiny_recipe("loggers=[tensorboard]"))


def test_wandb_sync_makes_one_run_of_what_kills_and_evaluations_have_left(
    tiny_recipe: Recipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_dir = run(tiny_recipe(OFFLINE))
    assert not settled(run_dir)
    cut(newest(run_dir), 1)
    recipe = load_run(run_dir).recipe
    chart = run_dir.with_name("chart.png")
    Image.new("RGB", (8, 8)).save(chart)
    log_evaluation(recipe, run_dir, Evaluated("evaluation", [], [chart]))
    run(tiny_recipe(OFFLINE, "outer_iterations=3", "resume=true"))
    assert not settled(run_dir)
    with wandb_server() as server:
        monkeypatch.setenv("WANDB_BASE_URL", server.url)
        monkeypatch.setenv("WANDB_API_KEY", 40 * "a")
        monkeypatch.delenv("WANDB_SERVICE", raising=False)  # the process of these tests
        files = map(str, run_dir.glob("wandb/offline-run-*"))
        command = [sys.executable, "-m", "wandb", "sync", *files]
        done = subprocess.run(command, capture_output=True, text=True, cwd=run_dir.parent)
        assert done.returncode == 0, done.stderr
    ((drawn, lines),) = server.history.items()
    assert drawn == known_id(run_dir)
    shown = [lines[number] for number in sorted(lines)]
    assert [row["_step"] for row in shown] == [0, 1, 2, 3]
    assert ["evaluation/chart" in row for row in shown] == [False, False, True, False]
    with (run_dir / "metrics.csv").open() as file:
        for row, logged in zip(csv.DictReader(file), shown[:2] + shown[3:], strict=True):
            assert {name: float(value) for name, value in row.items()} == {
                name: float(logged[name]) for name in row
            }
    assert any(name.startswith("media/images/evaluation/chart") for name in server.media)


def test_a_run_that_is_logged_online_is_completed_when_it_goes_on(
    tiny_recipe: Recipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    with wandb_server() as server:
        monkeypatch.setenv("WANDB_BASE_URL", server.url)
        monkeypatch.setenv("WANDB_API_KEY", 40 * "a")
        wandb.teardown()  # it reads its settings once
        run_dir = run(tiny_recipe("wandb.mode=online", "wandb.name=arm"))
        drawn = str(known_id(run_dir))
        assert server.settings[drawn]["displayName"] == "arm"
        # The last row has not arrived, and the file has lost it too.
        del server.history[drawn][1]
        server.summaries[drawn] = {**server.history[drawn][0]}
        cut(newest(run_dir), 1)
        run(tiny_recipe("wandb.mode=online", "wandb.name=arm", "resume=true"))
        run(tiny_recipe("wandb.mode=online", "outer_iterations=3", "resume=true"))
        wandb.teardown()
    assert list(server.history) == [drawn]
    steps = [(row["_step"], row["iteration"]) for row in server.history[drawn].values()]
    assert steps == [(0, 0), (1, 1), (2, 2)]


def test_a_network_that_goes_away_does_not_hold_up_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tracking, "_UPLOAD", 0.5)
    recipe = METRPORecipe(wandb=WandbSettings(mode="online"))
    said: list[str] = []
    with ExitStack() as network:
        server = network.enter_context(wandb_server())
        monkeypatch.setenv("WANDB_BASE_URL", server.url)
        monkeypatch.setenv("WANDB_API_KEY", 40 * "a")
        wandb.teardown()
        with trackers(recipe, tmp_path, {}, [], [], said.append) as (tracker,):
            network.close()
            tracker.log({"iteration": 0}, {"iteration": 1.0})
    wandb.teardown()
    (file,) = wandb_files(tmp_path)
    assert said == [
        "W&B: not everything has arrived within 0.5 s; send the rest with "
        f"wandb sync {file.path.parent}"
    ]
    assert [row["iteration"] for row in file.history] == [0]


@pytest.mark.skipif(not HAS_FORKS, reason="finds the process in /proc")
@pytest.mark.filterwarnings("ignore:subprocess:ResourceWarning")  # of the processes killed
def test_a_process_of_wandb_that_dies_costs_one_line(tmp_path: Path) -> None:
    recipe = METRPORecipe(wandb=WandbSettings(mode="offline"))
    said: list[str] = []
    rows = [({"iteration": i}, {"iteration": 1.0}) for i in range(2)]
    for name in ("end", "signal", "row", "next"):
        (tmp_path / name).mkdir()
    # Before the end, also on a signal, and before a row.
    with trackers(recipe, tmp_path / "end", {}, [], [], said.append) as (tracker,):
        tracker.log(*rows[0])
        kill_wandb()
    with (
        pytest.raises(SystemExit, match="143"),
        trackers(recipe, tmp_path / "signal", {}, [], [], said.append) as (tracker,),
    ):
        tracker.log(*rows[0])
        kill_wandb()
        raise SystemExit(143)
    with trackers(recipe, tmp_path / "row", {}, [], [], said.append) as (tracker,):
        kill_wandb()
        for row in rows:
            tracker.log(*row)
    assert len(said) == 3
    assert all(line.endswith("--resume logs what it lacks of the training") for line in said)
    # The next run of the process, as in a sweep, has another one.
    with trackers(recipe, tmp_path / "next", {}, [], [], said.append) as (tracker,):
        tracker.log(*rows[0])
    assert len(said) == 3 and len(wandb_files(tmp_path / "next")[0].history) == 1
    gc.collect()


def test_a_process_of_wandb_that_does_not_start_is_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wandb, "init", Mock(side_effect=ConnectionResetError))
    recipe = METRPORecipe(wandb=WandbSettings(mode="offline"))
    with (
        pytest.raises(RunDirectoryError, match="W&B: ConnectionResetError; use"),
        trackers(recipe, tmp_path, {}, [], []),
    ):
        pass


def kill_wandb() -> None:
    """Kill W&B's own process, and wait until this one can notice."""
    for pid in descendants(os.getpid()):
        if Path(f"/proc/{pid}/comm").read_text().startswith("wandb-core"):
            os.kill(pid, signal.SIGKILL)
            while Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z":
                time.sleep(0.01)


def test_a_run_that_the_caller_logs_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    settings = wandb.Settings(silent=True, console="off")
    with wandb.init(mode="offline", dir=str(tmp_path), settings=settings) as mine:
        recipe = METRPORecipe(wandb=WandbSettings(mode="offline"))
        with trackers(recipe, tmp_path / "run", {}, [], []) as (tracker,):
            tracker.log({"iteration": 0}, {"iteration": 1.0})
        assert wandb.run is mine
        mine.log({"a": 1})
    (file,) = wandb_files(tmp_path / "run")
    assert [row["iteration"] for row in file.history] == [0]


def test_kills_at_random_moments_lose_nothing(
    tmp_path: Path, tiny_overrides: list[str], start_cli: Callable[..., Any]
) -> None:
    """Of processes that are forked; ``python -m tests.kills`` does it with whole ones."""
    settings = [*tiny_overrides, OFFLINE, "outer_iterations=5", "fit.max_epochs=100"]
    folder = tmp_path / "run"
    command = ["run", "metrpo/inverted_pendulum", *settings, f"run_dir={folder}", "--resume"]
    rng = random.Random(0)
    for rows in (0, 2):
        process = start_cli(command)
        while process.poll() is None and not logged(folder, rows):
            time.sleep(0.005)
        time.sleep(rng.uniform(0, 0.3))
        process.kill()
        process.wait()
    assert start_cli(command).wait(timeout=300) == 0
    # One file or several: what a killed process has not written yet is removed and logged again.
    assert not settled(folder) and wandb_files(folder)
    assert len((folder / "metrics.csv").read_text().splitlines()) == 6


def logged(folder: Path, rows: int) -> bool:
    file = folder / "metrics.csv"
    begun = any(folder.glob("wandb/offline-run-*/*.wandb"))
    return begun and (not rows or (file.exists() and len(file.read_text().splitlines()) > rows))


def test_a_logger_that_cannot_be_closed_leaves_none_open(
    tiny_recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = []

    class Broken(Tracker):
        def __init__(self, *_: object) -> None:
            self.number = len(closed)

        def log(self, metrics: Any, timing: Any) -> None: ...

        def evaluation(self, evaluated: Any) -> None: ...

        def close(self, status: int = 0) -> None:
            closed.append(status)
            raise OSError("no room")

    monkeypatch.setattr(tracking, "WandbTracker", Broken)
    monkeypatch.setattr(tracking, "TensorboardTracker", Broken)
    config = tiny_recipe("loggers=[wandb,tensorboard]", "wandb.mode=offline")
    recipe = OmegaConf.to_object(config)
    with pytest.raises(OSError, match="no room"), trackers(recipe, tmp_path, {}, [], []) as opened:
        assert len(opened) == 2
    assert closed == [0, 0]
