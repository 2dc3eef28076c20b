"""``torchrl-l1 new-task`` and ``torchrl-l1 check``."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchrl_l1.cli import main
from torchrl_l1.experiment.launch import compose

ENVIRONMENT = """
import gymnasium
import numpy as np
from gymnasium.spaces import Box


class Odd(gymnasium.Env):
    dt = 0.1
    observation_space = Box(-np.inf, np.inf, (3,), np.float64)
    action_space = Box(-1, 1, (2,), np.float32)
    chance = np.random.default_rng(0)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.append(self.np_random.uniform(-1.0, 1.0, 2), 7.0)
        return self.state.copy(), {}

    def step(self, action):
        self.state[0] += 0.1 * action[0]
        self.state[1] += self.chance.normal()
        return self.state.copy(), -abs(float(self.state[0])), abs(self.state[0]) > 1.2, False, {}


def make_env():
    return Odd()


class Numb(Odd):
    def reset(self, *, seed=None, options=None):
        observation = super().reset(seed=seed)
        self.chance = self.np_random
        return observation


class Micro(gymnasium.Env):
    dt = 0.1
    observation_space = Box(-np.inf, np.inf, (1,), np.float32)
    action_space = Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-1e-6, 1e-6, 1)
        return self.state.astype(np.float32), {}

    def step(self, action):
        self.state = 0.7 * self.state + 1e-6 * action[0]
        return self.state.astype(np.float32), -1e6 * abs(float(self.state[0])), False, False, {}


class Lost(Odd):
    def step(self, action):
        observation, reward, *rest = super().step(action)
        return observation, np.nan, *rest


def wrong(observation, action, next_observation):
    return next_observation[..., 0] + 3.0


def late(next_observation):
    return next_observation[..., 0].abs() > 1.5
"""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "odd.py").write_text(ENVIRONMENT)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_new_recipe_composes_and_needs_no_fix(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["new-task", "swing.yaml", "--from", "gymnasium/Pendulum-v1"])
    said = capsys.readouterr().out
    assert "observation of 3 entries, action of 1 entry from -2 to 2" in said
    assert "0.05 s, an episode 200 steps" in said
    config = compose("swing.yaml")
    assert (config.task, config.reward, config.recipe) == (
        "gymnasium/Pendulum-v1", "builtin", "swing",
    )  # fmt: skip
    main(["check", "swing.yaml", "seed=1", "--steps", "1000", "horizon=100"])
    said = capsys.readouterr().out
    assert "fix" not in said.replace("nothing to fix", "")
    assert said.endswith("torchrl-l1 run swing.yaml seed=1 horizon=100\n")
    assert "the reward function reproduces the environment's rewards" in said
    with pytest.raises(SystemExit):
        main(["new-task", "swing.yaml", "--from", "gymnasium/Pendulum-v1"])
    assert "already exists" in capsys.readouterr().err


def test_a_new_recipe_and_its_environment_may_have_any_path(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (place / "envs #1").mkdir()
    (place / "odd.py").rename(place / "envs #1" / "odd.py")
    source = "envs #1/odd.py:make_env"
    main(["new-task", "a: b.yaml", "--from", source, "--horizon", "40"])
    assert "torchrl-l1 check 'a: b.yaml'" in capsys.readouterr().out
    config = compose("a: b.yaml")
    assert (config.recipe, config.task) == ("a: b", source)


def test_all_that_is_odd_is_named(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["new-task", "odd.yaml", "--from", "odd.py:make_env", "--horizon", "40"])
    assert "not known" in capsys.readouterr().out
    with pytest.raises(SystemExit) as caught:
        main(["check", "odd.yaml", "reward=odd.py:wrong", "termination=odd.py:late"])
    assert caught.value.code == 1
    said = capsys.readouterr().out
    for words in (
        "entries [2] of the observation never change",
        "the same seed does not give the same episodes",
        "the reward function explains",
        "correct it, or set reward=learned",
        "steps are called terminal",
        "entries [1] are hardly predicted",
        "things to fix",
    ):
        assert words in said, said
    with pytest.raises(SystemExit):
        main(["check", "odd.yaml", "task=odd.py:Numb"])
    said = capsys.readouterr().out
    assert "entries [1] of the action have no effect" in said
    assert "the same seed gives the same episodes" in said


def test_an_environment_without_a_finite_reward_is_named(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["check", "pets/any", "task=odd.py:Lost", "horizon=9", "reward=odd.py:wrong"]
    with pytest.raises(SystemExit):
        main([*command, "termination=none", "--steps", "20"])
    said = capsys.readouterr().out
    assert "16 of 16 steps gave observations or rewards that are not finite" in said
    assert "1 thing to fix" in said


def test_units_that_are_too_large_are_named(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["check", "pets/any", "task=odd.py:Micro", "horizon=20", "reward=learned"]
    command += ["termination=none", "--steps", "800"]
    with pytest.raises(SystemExit):
        main(command)
    said = capsys.readouterr().out
    assert "fix  'observation'[0] changes by" in said
    floor = said.partition("in smaller units, or ")[2].split()[0]
    assert floor.startswith("model.std_floor=")
    main([*command, floor])
    assert "nothing to fix" in capsys.readouterr().out


def test_what_will_not_do_is_a_line(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, words in (
        (["new-task", "a.txt", "--from", "gymnasium/Pendulum-v1"], "must end in .yaml"),
        (["new-task", "a.yaml", "--from", "odd.py:make_env"], "give horizon=STEPS"),
        (["new-task", "a.yaml", "--from", "odd.py:make_env"], "; here --horizon STEPS"),
        (["check", "pets/any", "task=gymnasium/CartPole-v1"], "Discrete(2) as actions"),
        (["check", "pets/any", "--steps", "9", "task=gymnasium/Pendulum-v1"], "at least 10, got 9"),
    ):
        with pytest.raises(SystemExit):
            main(arguments)
        error = capsys.readouterr().err.strip()
        assert words in error and "\n" not in error
