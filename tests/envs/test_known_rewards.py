"""Rewards and terminations of imagination against those that Gymnasium's environments give."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.wrappers import TransformReward

from torchrl_l1.envs.known_rewards import _BUILDERS, known_outcome

EXACT = [
    ("Pendulum-v1", {}),
    ("MountainCarContinuous-v0", {}),
    ("InvertedPendulum-v5", {}),
    ("InvertedDoublePendulum-v5", {}),
    ("Reacher-v5", {}),
    ("Reacher-v5", {"reward_control_weight": 0.3, "reward_dist_weight": 2.0}),
    ("Pusher-v5", {}),
    ("HalfCheetah-v5", {"exclude_current_positions_from_observation": False}),
    ("Swimmer-v5", {"exclude_current_positions_from_observation": False}),
    ("Hopper-v5", {"exclude_current_positions_from_observation": False}),
    ("Hopper-v5", {"exclude_current_positions_from_observation": False, "healthy_reward": 3.0}),
    ("Walker2d-v5", {"exclude_current_positions_from_observation": False}),
]
NEARLY = [
    ("HalfCheetah-v5", {}),
    ("Swimmer-v5", {}),
    ("Hopper-v5", {}),
    ("Walker2d-v5", {}),
    ("Ant-v5", {}),
    ("Ant-v5", {"exclude_current_positions_from_observation": False}),
]


def played(name, steps=200, **settings):
    """Transitions of random actions, and what the environment said of them."""
    env = gymnasium.make(name, **settings)
    env.action_space.seed(0)
    observation, _ = env.reset(seed=0)
    rows = []
    for _ in range(steps):
        action = env.action_space.sample()
        following, reward, terminated, truncated, _ = env.step(action)
        rows.append((observation, action, following, reward, terminated))
        observation = env.reset()[0] if terminated or truncated else following
    columns = [torch.tensor(np.array(column)) for column in zip(*rows, strict=True)]
    return known_outcome(env), *columns


@pytest.mark.parametrize(("name", "settings"), EXACT)
def test_exact_rewards(name, settings):
    outcome, observation, action, following, reward, terminated = played(name, **settings)
    given = outcome.reward(observation.double(), action.double(), following.double())
    # Gymnasium squares actions in single precision, and its bodies are those of the last substep.
    tolerance = 2e-4 if "Double" in name else 2e-5
    inside = torch.ones_like(terminated)
    if name.startswith("InvertedDouble"):
        inside = (following[:, 5:8].abs() < 10).all(-1)
        assert inside.float().mean() > 0.9
    torch.testing.assert_close(
        given[inside], reward.double()[inside], rtol=tolerance, atol=tolerance
    )
    assert torch.equal(outcome.terminated(following), terminated)


@pytest.mark.parametrize(("name", "settings"), NEARLY)
def test_rewards_from_velocities_are_close(name, settings):
    outcome, observation, action, following, reward, terminated = played(name, **settings)
    assert "speed" in outcome.note
    given = outcome.reward(observation, action.double(), following)
    error = (given - reward).square().mean()
    assert error < 0.04 * reward.var(), float(error / reward.var())
    assert abs(float((given - reward).mean())) < 0.02 * float(reward.std())
    assert torch.equal(outcome.terminated(following), terminated)


def test_terminations_occur_in_what_is_compared():
    for name in ("InvertedPendulum-v5", "Hopper-v5", "Walker2d-v5"):
        *_, terminated = played(name, 100)
        assert terminated.any(), name


def test_every_known_class_is_compared():
    compared = {type(gymnasium.make(name).unwrapped).__name__ for name, _ in EXACT + NEARLY}
    known = {name.rpartition(".")[2] for name in _BUILDERS}
    assert known == compared


def test_what_may_change_a_reward_makes_it_unknown():
    assert known_outcome(TransformReward(gymnasium.make("Pendulum-v1"), lambda r: 2 * r)) is None
    assert known_outcome(gymnasium.make("CartPole-v1")) is None
    unseen = gymnasium.make("Ant-v5", include_cfrc_ext_in_observation=False)
    assert known_outcome(unseen) is None
    free = gymnasium.make("Ant-v5", include_cfrc_ext_in_observation=False, contact_cost_weight=0.0)
    assert known_outcome(free) is not None


def test_functions_are_batched():
    outcome = known_outcome(gymnasium.make("Walker2d-v5"))
    x, u = torch.randn(4, 3, 17), torch.randn(4, 3, 6)
    assert outcome.reward(x, u, x).shape == outcome.terminated(x).shape == (4, 3)
