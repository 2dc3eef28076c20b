from __future__ import annotations

import gc
from copy import deepcopy

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete
from gymnasium.utils import EzPickle
from gymnasium.wrappers import DtypeObservation
from torchrl.data import Unbounded
from torchrl.envs import GymEnv, GymWrapper, StepCounter, Transform, TransformedEnv

from torchrl_l1.envs import ExternalTask, environment_source

NARROW = Box(-0.1, 0.1, (1,), np.float64)
STATE = Box(-9, 9, (2,), np.float64)


class Plant(gymnasium.Env):
    """Has a connection that closing releases, as a simulator or a machine has."""

    dt = 0.1
    action_space, observation_space = NARROW, STATE

    def __init__(self, observation_space=STATE, reward=1.0):
        self.observation_space, self.reward = observation_space, reward
        self.connections = ["open"]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        assert self.connections, "not connected"
        return self.observation_space.sample(), self.reward, False, False, {}

    def close(self):
        self.connections.remove("open")


def task_of(make, **settings):
    return ExternalTask(environment_source(make), horizon=9, **settings)


class Twofold(Transform):
    """The reward in two parts."""

    def __init__(self):
        super().__init__(in_keys=["reward"], out_keys=["reward"])

    def _apply_transform(self, reward):
        return torch.cat([reward, reward], -1)

    def transform_reward_spec(self, reward_spec):
        reward_spec["reward"] = Unbounded((2,))
        return reward_spec


def counted(make):
    """The same, stepped by TorchRL."""
    return lambda: TransformedEnv(GymWrapper(make()), StepCounter(9))


@pytest.mark.parametrize("around", [lambda make: make, counted])
def test_an_environment_is_closed_once_and_not_before_the_end(around):
    made = []

    def make():
        made.append(Plant())
        return made[-1]

    env = task_of(around(make)).environment(2, seed=0)
    gc.collect()
    assert [plant.connections for plant in made] == [[], ["open"], ["open"]]
    assert env.rollout(3).shape == (2, 3)
    env.close()
    del env
    gc.collect()
    assert [plant.connections for plant in made] == [[], [], []]


@pytest.mark.parametrize("make", [Plant, counted(Plant)])
def test_saturated_actions_are_within_bounds_of_double_precision(make):
    env = task_of(make).environment(1, seed=0)
    assert env.action_spec.space.high.double() > 0.1  # in single precision
    env.step(env.reset().set("action", env.action_spec.space.high))


@pytest.mark.parametrize("make", ["gymnasium/HalfCheetah-v5", lambda: GymEnv("HalfCheetah-v5")])
def test_deep_copies_continue_with_state_and_plant(make):
    env = ExternalTask(environment_source(make), horizon=9).environment(1, plant={"mass": 1.5})
    action = torch.full((1, 6), 0.3)
    data = env.step_mdp(env.step(env.reset().set("action", action)))
    copied = deepcopy(env)
    first, second = (member.members[0].simulation() for member in (env, copied))
    assert first.data is not second.data and first.model is not second.model
    np.testing.assert_array_equal(first.model.body_mass, second.model.body_mass)
    for _ in range(3):
        expected, found = (one.step(data.clone().set("action", action)) for one in (env, copied))
        assert torch.equal(expected["next", "observation"], found["next", "observation"])
        data = env.step_mdp(expected)


def test_copies_without_the_state_are_refused():
    class Bound(Plant, EzPickle):
        def __init__(self):
            Plant.__init__(self)
            EzPickle.__init__(self)
            self.handle = (number for number in range(3))

    member = task_of(Bound).environment(1).members[0]
    with pytest.raises(TypeError, match=r"Bound cannot be copied with its state \(.*generator"):
        deepcopy(member)
    with pytest.raises(TypeError, match="Bound cannot be pickled with its state"):
        member.__reduce_ex__(4)


MIXED = Dict(pose=STATE, gripper=Discrete(2), camera=Box(0, 255, (8, 8, 3), np.uint8))


@pytest.mark.parametrize("around", [lambda make: make, counted])
def test_parts_that_would_be_left_out_are_named(around):
    for space in (MIXED, Dict(observation=STATE, **{k: MIXED[k] for k in ("gripper", "camera")})):
        with pytest.raises(ValueError, match=r"gripper, camera are not .*observation_keys=\["):
            task_of(around(lambda space=space: Plant(space)))
    task = task_of(around(lambda: Plant(MIXED)), observation_keys=["pose"])
    assert task.environment(1).rollout(2)["observation"].shape == (1, 2, 2)


@pytest.mark.parametrize("around", [lambda make: make, counted])
def test_whole_numbers_are_refused_where_they_are_trained_on_and_where_they_are_played(around):
    def make():
        return Plant(Box(0, 255, (2,), np.uint8))

    for use in (task_of, lambda made: environment_source(made).several(1)):
        with pytest.raises(ValueError, match="floating-point"):
            use(around(make))
    assert task_of(around(lambda: DtypeObservation(make(), np.float32))).observation_dim == 2


def test_a_reward_of_several_numbers_is_named():
    env = task_of(lambda: Plant(reward=np.ones(2))).environment(1)
    with pytest.raises(ValueError, match=r"the environment returned a reward of shape \(2,\); one"):
        env.rollout(2)
    env = task_of(lambda: TransformedEnv(GymEnv("Pendulum-v1"), Twofold())).environment(1)
    with pytest.raises(ValueError, match=r"a reward of shape \(2,\); one"):
        env.rollout(2)
    assert task_of(lambda: Plant(reward=np.ones(1))).environment(1).rollout(2).shape == (1, 2)
