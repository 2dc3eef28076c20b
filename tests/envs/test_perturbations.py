from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_l1.envs import (
    ActionNoise,
    ActuatorBias,
    ActuatorGain,
    BatchedMujocoEnv,
    ObservationNoise,
)


class _Recorder(BatchedMujocoEnv):
    """Keeps what the simulator received and the clean state that it answered with."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.received, self.clean, self.rewards = [], [], []

    def _step(self, tensordict):
        self.received.append(tensordict["action"].clone())
        following = super()._step(tensordict)
        self.clean.append(following["observation"].clone())
        self.rewards.append(following["reward"].clone())
        return following


@given(half_width=st.floats(1e-3, 10.0), seed=st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_action_noise_distribution(half_width, seed):
    torch.manual_seed(seed)
    action = torch.full((20_000, 2), 0.25, dtype=torch.float64)
    original = TensorDict({"action": action}, batch_size=[20_000])
    noisy = ActionNoise(half_width)._inv_call(original.clone(False))["action"]
    noise = noisy - 0.25
    assert noise.abs().max() <= half_width * (1 + 1e-9)
    assert noise.std(0).sub(half_width / 3**0.5).abs().max() < 0.02 * half_width
    assert noise.mean(0).abs().max() < 0.02 * half_width
    assert torch.corrcoef(noise.T)[0, 1].abs() < 0.05
    assert (original["action"] == 0.25).all()


def test_action_noise_reaches_the_simulator_but_not_the_record():
    base = _Recorder("half_cheetah", 3, seed=0, max_steps=10)
    env = TransformedEnv(base, ActionNoise(0.1))
    torch.manual_seed(0)
    at_the_bound = torch.ones(3, 6)

    def policy(tensordict):
        return tensordict.set("action", at_the_bound.clone())

    rollout = env.rollout(35, policy, break_when_any_done=False)
    assert rollout["next", "done"].sum() == 9  # resets happened inside
    assert (rollout["action"] == 1.0).all()
    received = torch.stack(base.received, 1)
    noise = received - 1.0
    assert 0.09 < noise.abs().max() <= 0.1 + 1e-6  # beyond the bound: not clipped again
    assert noise.unique().numel() > 0.99 * noise.numel()
    # The control cost is that of the noisy action.
    speed = rollout["observation"][..., 8]
    expected = speed - 0.1 * received.clamp(-1, 1).square().sum(-1)
    torch.testing.assert_close(rollout["next", "reward"].squeeze(-1), expected)


def test_action_noise_against_manual_physics():
    env = TransformedEnv(BatchedMujocoEnv("inverted_pendulum", 2, seed=0), ActionNoise(0.1))
    manual = BatchedMujocoEnv("inverted_pendulum", 2, seed=0)
    current, _ = env.reset(), manual.reset()
    torch.manual_seed(11)
    following = env.step(current.set("action", torch.tensor([[0.5], [-2.0]])))
    torch.manual_seed(11)
    noise = torch.empty(2, 1).uniform_(-0.1, 0.1)
    action = torch.tensor([[0.5], [-2.0]]) + noise
    expected = manual.step(TensorDict({"action": action}, batch_size=[2]))
    assert torch.equal(following["next", "observation"], expected["next", "observation"])
    np.testing.assert_array_equal(env.simulator_state()[0], manual.simulator_state()[0])


def test_observation_noise_spares_resets_and_rewards():
    base = _Recorder("half_cheetah", 4, seed=0, max_steps=10)
    env = TransformedEnv(base, ObservationNoise(0.1))
    torch.manual_seed(0)
    rollout = env.rollout(45, break_when_any_done=False)
    noise = rollout["next", "observation"] - torch.stack(base.clean, 1)
    assert 0.09 < noise.abs().max() <= 0.1 + 1e-6
    assert noise.std() == pytest.approx(0.1 / 3**0.5, rel=0.03)
    assert (noise != 0).float().mean() > 0.99
    assert torch.equal(rollout["next", "reward"], torch.stack(base.rewards, 1))
    # Within an episode the next step starts from the noisy observation; a reset's is clean:
    # positions of a fresh HalfCheetah lie within 0.1 of zero, noise would push some beyond.
    inner = ~rollout["next", "done"][:, :-1].squeeze(-1)
    torch.testing.assert_close(
        rollout["observation"][:, 1:][inner], rollout["next", "observation"][:, :-1][inner]
    )
    starts = torch.cat([rollout["observation"][:, ::10]], 1)
    assert (starts[..., :8].abs() <= 0.1).all()
    twin = BatchedMujocoEnv("half_cheetah", 4, seed=3)
    env.set_seed(3)
    assert torch.equal(env.reset()["observation"], twin.reset()["observation"])


@pytest.mark.parametrize("transform", [ActionNoise, ObservationNoise])
def test_noise_follows_torch_manual_seed(transform):
    def record():
        torch.manual_seed(1)
        env = TransformedEnv(BatchedMujocoEnv("inverted_pendulum", 2, seed=0), transform(0.1))
        return env.rollout(20)

    assert (record() == record()).all()


@pytest.mark.parametrize("transform", [ActionNoise, ObservationNoise])
def test_noise_interface(transform):
    env = TransformedEnv(BatchedMujocoEnv("half_cheetah", 2, seed=0), transform(0.1))
    check_env_specs(env)
    assert "half_width=0.1" in repr(env.transform)
    for value in (-0.1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="half_width"):
            transform(value)


def test_noise_is_refused_by_replay_buffers():
    buffer = ReplayBuffer(storage=LazyTensorStorage(4), transform=ObservationNoise(0.1))
    buffer.extend(TensorDict({"observation": torch.zeros(4, 2)}, batch_size=[4]))
    with pytest.raises(RuntimeError, match="belongs to an environment"):
        buffer.sample(2)


@pytest.mark.parametrize(
    ("transform", "expected"),
    [
        (ActuatorBias(0.5), lambda a: a + 0.5),
        (ActuatorBias([0.5, 0, 0, 0, 0, -1]), lambda a: a + torch.tensor([0.5, 0, 0, 0, 0, -1])),
        (ActuatorGain(0.6), lambda a: a * 0.6),
        (ActuatorGain([0, 1, 2, 1, 1, 1]), lambda a: a * torch.tensor([0, 1, 2, 1, 1, 1])),
    ],
)
def test_executed_input_and_recorded_action(transform, expected):
    env = TransformedEnv(BatchedMujocoEnv("half_cheetah", 3, seed=0, max_steps=4), transform)
    manual = BatchedMujocoEnv("half_cheetah", 3, seed=0, max_steps=4)
    current, _ = env.reset(), manual.reset()
    torch.manual_seed(0)
    for _ in range(10):
        action = torch.rand(3, 6) * 2 - 1
        stepped, current = env.step_and_maybe_reset(current.set("action", action.clone()))
        assert torch.equal(stepped["action"], action)
        executed = TensorDict({"action": expected(action)}, batch_size=[3])
        reference, _ = manual.step_and_maybe_reset(executed)
        for key in ("observation", "reward", "done"):
            assert torch.equal(stepped["next", key], reference["next", key])


@pytest.mark.parametrize("transform", [ActuatorBias, ActuatorGain])
def test_disturbance_interface(transform):
    env = TransformedEnv(BatchedMujocoEnv("half_cheetah", 2, seed=0), transform(0.5))
    check_env_specs(env)
    assert "0.5" in repr(env.transform)
    for value in (float("nan"), [0.0, float("inf")]):
        with pytest.raises(ValueError, match="finite number, or one for each"):
            transform(value)
    wrong = TransformedEnv(BatchedMujocoEnv("half_cheetah", 2, seed=0), transform([1.0, 2.0]))
    with pytest.raises(ValueError, match="2 values, but the action 'action' has 6"):
        wrong.rollout(1)
    wrong = TransformedEnv(BatchedMujocoEnv("half_cheetah", 2, seed=0), transform([[1.0]] * 3))
    with pytest.raises(ValueError, match="one row for each environment"):
        wrong.rollout(1)
    with pytest.raises(RuntimeError, match="belongs to an environment"):
        transform(0.5)(TensorDict({"action": torch.zeros(2, 6)}, batch_size=[2]))
