"""Environments of the user's through run, sweeps, campaigns, evaluations and reports."""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from tests.conftest import Process
from torchrl_l1.campaign import read_campaign
from torchrl_l1.campaign.jobs import sweep
from torchrl_l1.campaign.plan import plan
from torchrl_l1.campaign.reuse import find_reusable
from torchrl_l1.cli import main
from torchrl_l1.experiment.launch import compose
from torchrl_l1.experiment.run_directory import RunDirectory

PACKAGE = """
import gymnasium
import numpy as np
from gymnasium.spaces import Box


class Raft(gymnasium.Env):
    dt = 0.1
    observation_space = Box(-np.inf, np.inf, (2,), np.float64)
    action_space = Box(np.float32(-1), np.float32(2), (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-1.0, 1.0, 2)
        return self.state.copy(), {}

    def step(self, action):
        self.state = self.state + 0.1 * np.array([self.state[1], action[0]])
        return self.state.copy(), -float(np.square(self.state).sum()), False, False, {}


def make_env():
    return Raft()


def reward(observation, action, next_observation):
    return -next_observation.square().sum(-1)


if "Raft-v0" not in gymnasium.registry:
    gymnasium.register("Raft-v0", Raft, max_episode_steps=9)
"""

TINY = [
    *("outer_iterations=1", "horizon=8", "random_episodes=2", "particles=2", "cem.horizon=2"),
    *("cem.candidates=4", "cem.elites=2", "cem.iterations=1", "model.members=2"),
    *("model.hidden=[8]", "fit.max_epochs=1", "fit.max_gradient_steps=3", "wandb.mode=disabled"),
    *("termination=none", "fit.validation_fraction=0.3"),
]
NAMES = ["rafts:Raft-v0", "rafts.boats:make_env", "own.py:make_env"]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a package, a file and a recipe of the user's, in which commands are given."""
    package = tmp_path / "rafts"
    package.mkdir()
    (package / "boats.py").write_text(PACKAGE)
    (package / "__init__.py").write_text("from rafts.boats import Raft, make_env, reward\n")
    (tmp_path / "own.py").write_text(PACKAGE)
    (tmp_path / "mine.yaml").write_text(
        "defaults:\n  - /pets/any@_global_\n  - _self_\nrecipe: mine\n"
        "task: own.py:make_env\nreward: own.py:reward\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    for name in [name for name in sys.modules if name.partition(".")[0] in ("rafts", "own")]:
        del sys.modules[name]


def rows(file: Path) -> list[dict[str, str]]:
    with file.open() as handle:
        return list(csv.DictReader(handle))


def test_a_file_beside_the_recipe_is_found_from_everywhere(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Run, resume, evaluate and report, each from another folder."""
    elsewhere = place / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    run_dir = place / "runs" / "a"
    main(["run", "../mine.yaml", *TINY, f"run_dir={run_dir}"])
    config = OmegaConf.load(run_dir / "config.yaml")
    assert (config.task, list(config.search_path)) == ("own.py:make_env", [str(place)])
    monkeypatch.chdir(place / "runs")
    main(["run", "../mine.yaml", *TINY, f"run_dir={run_dir}", "outer_iterations=2", "--resume"])
    assert len(rows(run_dir / "metrics.csv")) == 2
    main(
        ["evaluate", str(run_dir), "--episodes", "2", "--bias", "0", "0.5", "--l1", "off", "robust"]
    )
    table = rows(run_dir / "evaluation" / "evaluation.csv")
    assert {row["l1"] for row in table} == {"off", "robust"} and len(table) == 4
    main(["report", str(place / "runs")])
    assert "own.py:make_env" in (place / "runs" / "report" / "report.md").read_text()
    capsys.readouterr()


LAUNCHERS = {
    "basic": [],
    "joblib": ["hydra.launcher.n_jobs=2"],
    "submitit_local": ["hydra.launcher.timeout_min=5"],
    "ray": ["+hydra.launcher.ray.init.num_cpus=2"],
}


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_sweeps_over_packages_functions_and_files(
    launcher: str, place: Path, start_cli: Callable[..., Process]
) -> None:
    """In a process of its own, whose path does not have the folder, and in the launcher's."""
    if launcher != "basic":
        pytest.importorskip(f"hydra_plugins.hydra_{launcher.partition('_')[0]}_launcher")
    tasks = ",".join(NAMES)
    more = [f"hydra/launcher={launcher}", *LAUNCHERS[launcher]]
    arguments = ["run", "pets/any", "-m", f"task={tasks}", "reward=rafts:reward", *TINY, *more]
    assert str(place) not in sys.path
    # The workers that joblib keeps are waited for at an end that a fork does not have.
    process = start_cli(arguments, anew=launcher != "basic")
    assert process.wait() == 0, (place / "output").read_text()
    found = sorted(place.glob("runs/**/metrics.csv"))
    assert len(found) == 3
    names = {OmegaConf.load(file.with_name("config.yaml")).task for file in found}
    assert names == set(NAMES)
    # The same environment under three names learns the same.
    assert len({file.read_text() for file in found}) == 1


@pytest.mark.usefixtures("forked_workers")
def test_a_campaign_over_environments(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (place / "study.yaml").write_text(
        "runs:\n  - recipe: pets/any\n    overrides: ["
        + ", ".join(f"'{text}'" for text in [*TINY, "reward=rafts:reward"])
        + "]\n    matrix:\n      task: [rafts:Raft-v0, own.py:make_env]\n"
        "evaluations:\n  - name: frozen\n    l1: [off]\n    bias: [0.0, 0.5]\n    episodes: 2\n"
    )
    main(["campaign", "study.yaml", "--workers", "1", "--output", "out"])
    folders = sorted(path.name for path in (place / "out" / "pets" / "any").iterdir())
    assert folders == ["task=own.py_make_env", "task=rafts_Raft-v0"]
    for folder in folders:
        run_dir = place / "out" / "pets" / "any" / folder / "seed_0"
        assert len(rows(run_dir / "evaluations" / "frozen.csv")) == 2
    planned = plan(read_campaign("study.yaml"), Path("out"))
    assert all(run.finished() for run in planned)
    arguments = sweep(read_campaign("study.yaml").runs[0], Path("/out"), "basic")
    assert any("${path_text:${hydra:overrides.task.0}}" in text for text in arguments)
    capsys.readouterr()


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["task=gymnasium/CartPole-v1"], "Discrete(2) as actions"),
        (["task=gymnasium/MountainCarContinuous-v0"], "give dt=SECONDS"),
        (["task=gymnasium/Nothing-v0"], "Nothing"),
        (["task=nowhere.py:make"], "no file nowhere.py"),
        (["task=own.py:nothing"], "own.py has no 'nothing'"),
        (["task=own.py:PACKAGES", "horizon=3"], "own.py has no"),
        (["task=own.py:make_env"], "give horizon=STEPS"),
        (["task=own.py:make_env", "horizon=3"], "say reward=learned or"),
        (["task=own.py:make_env", "horizon=3", "reward=learned"], "say termination=learned"),
        (["task=own.py:make_env", "horizon=3", "dt=0.2"], "takes 0.1 s, not 0.2"),
        (["task=half_cheetah", "dt=0.2"], "leave dt out"),
        (["task=half_cheeta"], "Unknown task 'half_cheeta'"),
    ],
)
def test_what_will_not_do_is_a_line_before_work_starts(
    overrides: list[str], words: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["run", "pets/any", *overrides, "run_dir=there", "wandb.mode=disabled"])
    error = capsys.readouterr().err.strip()
    assert words in error
    assert error.startswith("torchrl-l1 run: ") and "\n" not in error
    assert not (place / "there").exists()


def test_plants_that_cannot_be_changed_are_refused_before_a_campaign_starts(place: Path) -> None:
    (place / "study.yaml").write_text(
        "runs:\n  - recipe: mine.yaml\n    overrides: [termination=none, horizon=8]\n"
        "evaluations:\n  - name: frozen\n    mass: [2.0]\n"
    )
    with pytest.raises(ValueError, match="mass changes the plant"):
        plan(read_campaign("study.yaml"), Path("out"))


def test_only_recipes_that_name_code_have_a_search_path(place: Path) -> None:
    assert list(compose("mine.yaml").search_path) == [str(place)]
    assert list(compose("pets/any", ["task=gymnasium/Pendulum-v1"]).search_path) == []
    assert list(compose("pets/any", ["task=rafts:Raft-v0"]).search_path) == [str(place)]
    assert list(compose("metrpo/half_cheetah").search_path) == []


def test_offline_learning_starts_where_measured_episodes_did(place: Path) -> None:
    rest = ["horizon=8", "fit.max_epochs=1", "fit.max_gradient_steps=3", "wandb.mode=disabled"]
    rows_ = "x,v,u\n" + "".join(f"{0.1 * i},{0.2 * (i % 3)},{0.3 * (i % 2)}\n" for i in range(60))
    (place / "data.csv").write_text(rows_)
    main(
        [
            *("run", "offline/inverted_pendulum", "task=own.py:make_env", "reward=own.py:reward"),
            *("termination=none", "dataset=data.csv", "columns.observation=[x,v]"),
            *("columns.action=[u]", "imagined_from_data=0.0", "imagined_steps=100"),
            *("imagined_horizon=5", "trpo_iterations=1", "evaluation_episodes=2"),
            *("outer_iterations=1", "cloning.max_epochs=1", "run_dir=runs/offline", *rest),
        ]
    )
    assert len(rows(place / "runs" / "offline" / "metrics.csv")) == 1


def test_a_suite_leaves_out_what_cannot_act_and_one_run_is_no_two_seeds(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["run", "mine.yaml", *TINY, "run_dir=runs/a", "checkpoint.best=true"])
    kept = "runs/a/checkpoints/best.pt"
    with pytest.raises(SystemExit):
        main(["evaluate", "runs/a", "--episodes", "1", "--payload", "0.5"])
    assert "leave it out" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["evaluate", "runs/a", kept, "--episodes", "1"])
    assert "are of one run" in capsys.readouterr().err
    assert not (place / "runs" / "a" / "evaluation").exists()
    main(["evaluate", kept, "--suite", "quick", "--episodes", "1", "--l1", "off"])
    table = rows(place / "runs" / "a" / "evaluation_best" / "evaluation.csv")
    assert len(table) > 3 and all(float(row["payload"]) == 0 for row in table)


@pytest.mark.usefixtures("forked_workers")
def test_runs_of_another_folders_file_are_not_reused(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = place / "other"
    other.mkdir()
    (other / "own.py").write_text(PACKAGE.replace("0.1 * np", "0.3 * np"))
    overrides = ", ".join(f'"{text}"' for text in [*TINY, "reward=learned"])
    for folder in (place, other):
        (folder / "study.yaml").write_text(
            f"runs:\n  - recipe: pets/any\n    overrides: [{overrides}]\n"
            '    matrix:\n      task: ["own.py:make_env"]\n'
        )
    main(["campaign", "study.yaml", "--output", "study", "--workers", "1"])
    found = []
    for folder in (place, other):
        monkeypatch.chdir(folder)
        output = (folder / "again").resolve()
        runs = plan(read_campaign("study.yaml", []), output)
        found.append(len(find_reusable(runs, output, [place / "study"])))
    assert found == [1, 0]


def test_code_that_has_changed_since_a_run_began_is_told(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the same file, where there is no other folder to compare it with."""
    command = ["run", "mine.yaml", *TINY, "run_dir=r", "--resume"]
    told = "own.py has changed since the run in r began; it is used as it is"
    main(command)
    main([*command, "outer_iterations=2"])
    assert told not in "".join(capsys.readouterr())
    before = RunDirectory("r").changed_files(
        OmegaConf.to_container(OmegaConf.load("r/config.yaml"))
    )
    (place / "own.py").write_text(PACKAGE.replace("0.1 * np.array", "0.2 * np.array"))
    for again in ([*command, "outer_iterations=3"], ["evaluate", "r", "--episodes", "1"]):
        main(again)
        assert told in "".join(capsys.readouterr())
    config = OmegaConf.to_container(OmegaConf.load("r/config.yaml"))
    assert (before, RunDirectory("r").changed_files(config)) == ([], ["own.py"])
    main(["report", "r", "--output", "out"])
    assert "| own.py | sha256 " in Path("out/report.md").read_text()


def test_a_run_that_has_gone_on_elsewhere_is_evaluated_with_the_code_that_is_there(
    place: Path,
) -> None:
    main(["run", "mine.yaml", *TINY, "run_dir=r"])
    (place / "moved").mkdir()
    for name in ("own.py", "mine.yaml"):
        (place / name).rename(place / "moved" / name)
    main(["run", "moved/mine.yaml", *TINY, "run_dir=r", "--resume"])
    assert OmegaConf.load("r/config.yaml").search_path == [str(place / "moved")]
    main(["evaluate", "r", "--episodes", "1", "--l1", "off"])
    assert len(rows(Path("r/evaluation/evaluation.csv"))) == 1


def test_runs_of_changed_code_are_not_reused_and_told(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = 'runs: [{recipe: mine.yaml, overrides: ["' + '", "'.join(TINY) + '"]}]\n'
    (place / "c.yaml").write_text(text)
    main(["campaign", "c.yaml", "--output", "one", "--workers", "1"])
    runs = plan(read_campaign("c.yaml"), place / "two")
    assert len(find_reusable(runs, place / "two", [place / "one"])) == 1
    command = ["campaign", "c.yaml", "--list", "--output"]
    main([*command, "one"])
    assert "has changed" not in capsys.readouterr().err
    (place / "own.py").write_text(PACKAGE.replace("0.1 * np.array", "0.2 * np.array"))
    assert not find_reusable(runs, place / "two", [place / "one"])
    for folder, told in (("one", 1), ("two", 0)):
        main([*command, folder])
        assert capsys.readouterr().err.count("own.py has changed since runs in") == told
