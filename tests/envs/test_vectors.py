from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs import GymEnv, GymWrapper, PendulumEnv, RewardSum, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_l1.envs import ExternalTask, environment_source, make_env, vector_environment

ONE = torch.ones(1)


class InParts(gymnasium.Env):
    """Observations in parts, as dm_control has them, one of them a number."""

    observation_space = gymnasium.spaces.Dict(
        velocity=gymnasium.spaces.Box(-9, 9, (2,), np.float64),
        height=gymnasium.spaces.Box(-9, 9, (), np.float64),
    )
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        return {"velocity": np.array([1.0, 2.0]), "height": np.array(0.5)}, {}

    def step(self, action):
        return {"velocity": np.array([3.0, 4.0]), "height": np.array(0.7)}, 1.0, False, False, {}


def test_observations_in_parts_are_joined_in_the_order_of_their_names():
    env = vector_environment(GymWrapper(InParts()))
    data = env.rollout(2)
    torch.testing.assert_close(data["observation"][0], torch.tensor([0.5, 1.0, 2.0]))
    torch.testing.assert_close(data["next", "observation"][1], torch.tensor([0.7, 3.0, 4.0]))
    assert data["action"].dtype == torch.float32


class OfTwoTypes(InParts):
    """Only the velocity is in double precision."""

    observation_space = gymnasium.spaces.Dict(
        height=gymnasium.spaces.Box(-9, 9, (), np.float32),
        velocity=gymnasium.spaces.Box(-9, 9, (2,), np.float64),
    )

    def step(self, action):
        return {"velocity": np.array([3.0, 4.0]), "height": np.float32(0.7)}, 1.0, False, False, {}


def test_parts_of_two_types_are_joined_in_single_precision():
    env = vector_environment(GymWrapper(OfTwoTypes()))
    check_env_specs(env)
    after = env.rollout(2)["next"]
    assert after["observation"].dtype == torch.float32 and after["velocity"].dtype == torch.float64
    torch.testing.assert_close(after["observation"][1], torch.tensor([0.7, 3.0, 4.0]))


def test_environments_that_read_their_observation_again_are_joined_beside_it():
    # TorchRL's pendulum has no state but its angle and rate, two numbers.
    env, plain = vector_environment(PendulumEnv()), PendulumEnv()
    env.set_seed(0), plain.set_seed(0)
    data, expected = (one.rollout(5, lambda td: td.set("action", ONE)) for one in (env, plain))
    both = torch.stack([expected["next", "th"], expected["next", "thdot"]], -1)
    assert torch.equal(data["next", "observation"], both)


def test_actions_that_are_no_vector_are_refused():
    with pytest.raises(ValueError, match=r"continuous actions .*'action': OneHot") as caught:
        vector_environment(GymEnv("CartPole-v1"))
    assert "\n" not in str(caught.value)


class Written(gymnasium.Env):
    """Writes every observation to the same array; pushes what it is given."""

    action_space = gymnasium.spaces.Box(-1, 1, (1,))
    observation_space = gymnasium.spaces.Box(-9, 9, (1,))

    def reset(self, *, seed=None, options=None):
        self.place = np.zeros(1, np.float32)
        return self.place, {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.place += action
        return self.place, 0.0, False, False, {}


def test_observations_do_not_change_after_they_are_read():
    env = environment_source(Written).single()
    data = env.rollout(4, lambda td: td.set("action", ONE))
    assert data["observation"].flatten().tolist() == [0, 1, 2, 3]
    assert data["next", "observation"].flatten().tolist() == [1, 2, 3, 4]


def test_disturbed_actions_are_clipped_as_those_of_tasks_are():
    source = environment_source(Written)
    task = ExternalTask(source, dt=0.1, horizon=5)
    for env in (make_env(task, 2, bias=0.5), source.several(2, {"bias": 0.5})):
        after = env.step(env.reset().set("action", torch.tensor([[0.25], [1.0]])))["next"]
        assert after["observation"].flatten().tolist() == [0.75, 1.0]
    own = environment_source("half_cheetah").several(1)
    assert [type(transform).__name__ for transform in own.transform] == []


def test_rewards_that_are_summed_up_are_no_part_of_the_state():
    env = vector_environment(TransformedEnv(PendulumEnv(), RewardSum()))
    assert env.observation_spec["observation"].shape == (2,)


def test_parts_that_would_be_left_out_of_the_state_are_named():
    class Gripping(InParts):
        observation_space = gymnasium.spaces.Dict(
            **InParts.observation_space.spaces, gripper=gymnasium.spaces.Discrete(2)
        )

    with pytest.raises(ValueError, match=r"gripper are not .*observation_keys=\[height,velocity\]"):
        environment_source(Gripping).one()
