from __future__ import annotations

import csv
import shlex
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import pytest
import wandb
from tensordict.nn import TensorDictModule

from torchrl_l1.cli import main, robustify
from torchrl_l1.control import L1Config
from torchrl_l1.deployment import RobustController, robustification
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.envs import environment_source, get_task, suite
from torchrl_l1.experiment.evaluate import TrainedRun
from torchrl_l1.experiment.settings import METRPORecipe
from torchrl_l1.experiment.tracking import Evaluated
from torchrl_l1.experiment.wandb_files import draw_id

TINY = ["--steps", "300", "--episodes", "2", "--most-steps", "15"]


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def refused(arguments, capsys) -> str:
    with pytest.raises(SystemExit) as exit_info:
        main(arguments)
    assert exit_info.value.code == 1
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    return printed.err


@pytest.mark.filterwarnings("ignore:the model is too poor")
def test_from_a_policy_to_a_controller_that_python_loads(policy_file, tmp_path, capsys):
    output = tmp_path / "out"
    policy = f"{policy_file}:balance"
    main(["robustify", "inverted_pendulum", "--policy", policy, "--bias", "0", "0.5", *TINY,
          "--output", str(output)])  # fmt: skip
    printed = capsys.readouterr().out
    with (output / "evaluation.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {(row["bias"], row["l1"]) for row in rows} == {
        (bias, l1) for bias in ("0.0", "0.5") for l1 in ("off", "paper", "robust", "oracle")
    }
    assert (output / "evaluation.png").stat().st_size > 5000
    page = (output / "README.md").read_text()
    assert "| bias 0.5 |" in page and "L1Config(dt=0.04" in page
    for name in ("evaluation.csv", "evaluation.png", "README.md", "controller"):
        assert str(output / name) in printed
    # The last lines are Python, and they run.
    usage = printed.partition("To use it:\n\n")[2]
    assert len(usage.strip().splitlines()) == 5
    names: dict[str, object] = {}
    exec(usage.replace("rollout(1000,", "rollout(7,"), names)
    assert names["data"]["next", "l1", "u_exec"].shape == (1, 7, 1)

    main(["export", str(output), "policy.pt", "--steps", "10", "--trust"])
    printed = capsys.readouterr().out
    assert "Largest difference in 10 steps" in printed
    assert f"Step:    {get_task('inverted_pendulum').dt} s, preset robust\n" in printed
    assert (tmp_path / "policy.pt").exists()

    # Again: it is the same policy. That of another does not take its place.
    again = ["robustify", "inverted_pendulum", *TINY, "--bias", "0", "--output", "out"]
    main([*again, "--policy", f"{policy_file.name}:balance"])
    kept = (output / "controller/controller.json").read_bytes()
    words = refused([*again, "--policy", f"{policy_file.name}:other"], capsys)
    assert f"holds the controller of {policy}" in words and "another --output" in words
    assert (output / "controller/controller.json").read_bytes() == kept


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("robustify nowhere --policy sb3:x.zip", "unknown environment 'nowhere'"),
        ("robustify hopper --policy sb3:x.zip", "no file x.zip"),
        ("robustify hopper --policy p --suite quick --bias 1", "--suite or --bias, not both"),
        ("robustify CartPole-v1 --policy sb3:x.zip --dt 0.02", "continuous actions"),
        ("robustify hopper --policy nofile.pt --output out/here", "nofile.pt"),
        ("play nowhere", "no folder nowhere"),
        ("play hopper --output film.avi", "must end in"),
        ("export nowhere file.pt", "no folder nowhere"),
    ],
)
def test_refusals_of_one_line(line, message, capsys, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    assert message in refused(shlex.split(line), capsys)
    assert not Path("out").exists() and not Path("runs").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--epsilon", "-1"], "epsilon must be finite and not negative, got -1"),
        (["--bias", "0.5", "-inf"], "--bias must be finite, got -inf"),
        (["--delay", "0.5"], "--delay: "),
        (["--mass", "-1"], "--mass: mass must be positive"),
        (["--mass", "2"], "mass changes the plant"),
    ],
)
def test_what_cannot_be_tested_is_refused_before_data_are_collected(
    options, message, policy_file, monkeypatch, capsys
):
    def collect(*arguments):
        raise AssertionError("data are collected")

    monkeypatch.setattr(robustification, "collect", collect)
    env = "gymnasium/Pendulum-v1" if options == ["--mass", "2"] else "inverted_pendulum"
    policy = f"{policy_file}:balance"
    assert message in refused(["robustify", env, "--policy", policy, *options], capsys)


@pytest.mark.parametrize(
    "name", ["README.md", "evaluation.csv", "episodes.csv", "evaluation.png", "controller"]
)
def test_no_file_of_the_user_s_is_replaced(name, policy_file, monkeypatch, capsys):
    monkeypatch.setattr(robustification, "collect", None)
    Path(name).write_text("mine")
    policy = f"{policy_file}:balance"
    arguments = ["robustify", "inverted_pendulum", "--policy", policy, "--output", "."]
    printed = refused(arguments, capsys)
    assert f"{name} already exists: give another --output" in printed or "move it away" in printed
    assert Path(name).read_text() == "mine"


def test_the_printed_use_has_the_parts_of_the_observation_in_the_policy_s_order(
    tmp_path, monkeypatch
):
    file = tmp_path / "envs.py"
    file.write_text(
        "import gymnasium\nimport numpy as np\nfrom gymnasium.spaces import Box, Dict\n\n\n"
        "class Parts(gymnasium.Env):\n"
        "    action_space = Box(-1, 1, (1,))\n"
        "    observation_space = Dict(place=Box(-9, 9, (1,)), speed=Box(-9, 9, (1,)))\n"
        "    seen = dict(place=np.ones(1, np.float32), speed=np.full(1, -7, np.float32))\n\n"
        "    def reset(self, *, seed=None, options=None):\n"
        "        return self.seen, {}\n"
    )
    source = environment_source(f"{file}:Parts")
    robust = RobustController(
        replace(source, observation_keys=("speed", "place")),
        TensorDictModule(lambda x: x[..., :1], ["observation"], ["action"]),
        EnsembleDynamics(2, 1, hidden=(4,)),
        {"robust": L1Config.robust(0.05)},
    )
    monkeypatch.setattr(RobustController, "load", lambda folder: robust)
    names: dict[str, object] = {}
    exec(robustify.usage_lines(tmp_path).partition("data =")[0], names)
    assert names["env"].reset()["observation"].tolist() == [-7.0, 1.0]


@pytest.mark.parametrize("error", [wandb.errors.UsageError, ConnectionResetError, TimeoutError])
def test_what_weights_and_biases_refuses_costs_no_result(error, robust, monkeypatch, capsys):
    def init(**options):
        raise error("api_key not configured")

    monkeypatch.setattr(wandb, "init", init)
    monkeypatch.setattr(robustify, "robustify", lambda *_, **__: robust)
    main(["robustify", "inverted_pendulum", "--policy", "p", "--bias", "1", "--episodes", "1",
          "--most-steps", "3", "--wandb", "offline", "--output", "out"])  # fmt: skip
    printed = capsys.readouterr()
    assert "To use it" in printed.out and "W&B: api_key not configured" in printed.err


def test_what_a_training_s_policy_is_worth_is_logged_to_the_training(tmp_path, monkeypatch):
    recipe = METRPORecipe(outer_iterations=1, task="hopper", recipe="mine")
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    draw_id(run_dir)
    logged = []
    monkeypatch.setattr(robustify, "load_run", lambda path: TrainedRun(run_dir, recipe, None))
    monkeypatch.setattr(robustify, "log_evaluation", lambda *arguments: logged.append(arguments))
    chart = tmp_path / "chart.png"
    for policy in (run_dir, run_dir / "checkpoints" / "best.pt"):
        options = Namespace(policy=str(policy), env="gymnasium/Hopper-v5", wandb="offline")
        robustify._log(options, [{"bias": 1.0}], chart, tmp_path)
        own, path, evaluated = logged.pop()
        assert (own.wandb.mode, own.recipe, path) == ("offline", "mine", run_dir)
        assert evaluated == Evaluated("robustify/gymnasium_Hopper-v5", [{"bias": 1.0}], [chart])


@pytest.mark.filterwarnings("ignore:the model is too poor")
def test_a_suite_with_what_weights_and_biases_is_told(policy_file, tmp_path, monkeypatch):
    told: dict[str, object] = {}

    class Run:
        def __enter__(self):
            return self

        def __exit__(self, *error):
            told["ended"] = error

        def log(self, values):
            told.update(values)

    def init(**options):
        told["options"] = options
        return Run()

    monkeypatch.setattr(wandb, "init", init)
    output = tmp_path / "out"
    policy = f"{policy_file}:balance"
    main(["robustify", "inverted_pendulum", "--policy", policy, "--suite", "quick",
          "--steps", "300", "--episodes", "1", "--most-steps", "4",
          "--wandb", "offline", "--output", str(output)])  # fmt: skip
    with (output / "evaluation.csv").open() as file:
        rows = list(csv.DictReader(file))
    cells = len(suite("quick")) - 4  # no contacts, which two need, no rotors, and no 50th step
    assert len([row for row in rows if row["l1"] == "off"]) == cells
    # Where a disturbance is not matched there is nothing that an oracle could be told.
    assert 0 < len([row for row in rows if row["l1"] == "oracle"]) < cells
    assert told["options"]["mode"] == "offline" and told["options"]["config"]["suite"] == "quick"
    assert len(told["evaluation"].data) == len(rows) and told["chart"] is not None
    assert told["ended"] == (None, None, None)
