from __future__ import annotations

from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import FrameSkipTransform, GymEnv, TransformedEnv

from torchrl_l1.deployment import environment_source, time_step
from torchrl_l1.envs import TASKS, make_env
from torchrl_l1.envs.vectors import simulation_of


def test_time_steps_are_those_that_the_environments_tell():
    gym = gymnasium.make("InvertedPendulum-v5").unwrapped.dt
    assert time_step(GymEnv("InvertedPendulum-v5")) == gym
    assert time_step(GymEnv("InvertedPendulum-v5", frame_skip=3)) == 3 * gym
    skipping = TransformedEnv(GymEnv("InvertedPendulum-v5"), FrameSkipTransform(2))
    assert time_step(skipping) == 2 * gym
    for name, task in TASKS.items():
        assert environment_source(name).time_step() == time_step(make_env(name)) == task.dt
    assert time_step(GymEnv("MountainCarContinuous-v0")) is None


@pytest.mark.parametrize(
    ("name", "width"),
    [
        ("gymnasium/Pendulum-v1", 3),
        ("Pendulum-v1", 3),
        ("torchrl_l1:torchrl_l1/Cartpole-v0", 4),
        ("torchrl_l1/Cartpole-v0", 4),
        ("inverted_pendulum", 4),
    ],
)
def test_names(name, width):
    env = environment_source(name).one()
    assert env.observation_spec["observation"].shape[-1] == width


def test_functions_of_files(tmp_path):
    file = tmp_path / "own.py"
    file.write_text(
        "from torchrl.envs import GymEnv\n\n\ndef make_env():\n"
        "    return GymEnv('InvertedPendulum-v5')\n"
    )
    source = environment_source(f"{file}:make_env")
    assert source.one().observation_spec["observation"].shape == (4,)
    assert source.time_step() == pytest.approx(0.04)


def test_a_function_that_needs_arguments_is_named(tmp_path):
    file = tmp_path / "own.py"
    file.write_text("def make_env(size):\n    return size\n\n\ndef fails():\n    return len(3)\n")
    with pytest.raises(ValueError, match=r"own.py:make_env cannot be called .* 'size'\): give"):
        environment_source(f"{file}:make_env").one()
    with pytest.raises(TypeError, match="has no len"):  # of its own it is told as it is
        environment_source(f"{file}:fails").one()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nothing_like_it", "unknown environment 'nothing_like_it'; names are gymnasium/ID"),
        ("gymnasium/Nothing-v0", "Nothing"),
        ("no_such_package:Env-v0", "no_such_package"),
        ("missing.py:make", "no file missing.py"),
        ("dm_control/cartpole", "dm_control/DOMAIN/TASK"),
    ],
)
def test_names_that_stand_for_nothing(name, message):
    with pytest.raises(ValueError, match=message):
        environment_source(name)


def test_an_environment_in_place_of_its_maker_is_refused():
    with pytest.raises(TypeError, match="give a function that makes it"):
        environment_source(GymEnv("Pendulum-v1"))


def test_disturbances_act_between_controller_and_environment():
    source = environment_source("gymnasium/InvertedPendulum-v5")
    plain, biased = (source.several(2, given, seed=3) for given in ({}, {"bias": 0.4}))
    start, same = plain.reset(), biased.reset()
    torch.testing.assert_close(start["observation"], same["observation"])
    action = torch.tensor([[0.1], [-0.2]])
    moved = plain.step(start.set("action", action + 0.4))
    disturbed = biased.step(same.set("action", action))
    torch.testing.assert_close(moved["next", "observation"], disturbed["next", "observation"])
    torch.testing.assert_close(disturbed["action"], action)


def test_gymnasiums_own_plants_are_changed():
    source = environment_source("gymnasium/InvertedPendulum-v5")
    changed = source.single({"mass": 2.0})
    before = simulation_of(source.one()).model.body_mass
    np.testing.assert_allclose(simulation_of(changed).model.body_mass, 2 * before)
    changed.rollout(3)
    # It survives a reset, and the heavier plant moves less.
    force = TensorDict(action=torch.ones(1))
    speeds = []
    for env in (changed, source.single()):
        env.set_seed(0)
        speeds.append(env.step(env.reset().update(force))["next", "observation"][2])
    assert 0 < speeds[0] < 0.7 * speeds[1]


@pytest.mark.parametrize(
    ("env", "name"), [("Pendulum-v1", "mass"), ("InvertedPendulum-v5", "wind")]
)
def test_changes_of_a_plant_that_cannot_be_made_are_refused(env, name):
    with pytest.raises(ValueError, match=f"{name} changes the plant"):
        environment_source(env).several(2, {name: 0.5})


def test_dm_control():
    pytest.importorskip("dm_control")
    source = environment_source("dm_control/cartpole/balance")
    try:
        source.build()
    except AttributeError as error:  # of a release that does not know this MuJoCo yet
        pytest.skip(f"dm_control does not run here: {error}")
    assert source.time_step() == pytest.approx(0.01)
    data = source.one().rollout(2)
    parts = torch.cat([data["position"], data["velocity"]], -1).float()
    torch.testing.assert_close(data["observation"], parts)


def test_spaces_that_torchrl_cannot_wrap_are_named():
    class Mixed(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-9, 9, (2,))
        action_space = gymnasium.spaces.Tuple(
            (gymnasium.spaces.Box(-1, 1, (1,)), gymnasium.spaces.Discrete(2))
        )

    with pytest.raises(ValueError, match=r"returns a Mixed, which TorchRL cannot .* Tuple\(Box"):
        environment_source(Mixed).one()


class Holder:
    made = property(lambda self: GymEnv("Pendulum-v1"))


def test_a_function_that_does_not_tell_its_arguments_makes_environments() -> None:
    # Python has no signature of getattr.
    env = environment_source(partial(getattr, Holder(), "made")).one()
    assert env.reset()["observation"].shape[-1] == 3
