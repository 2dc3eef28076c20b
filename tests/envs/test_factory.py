from __future__ import annotations

import pytest
import torch
from torchrl.envs import Transform
from torchrl.envs.utils import check_env_specs

from torchrl_l1.envs import BatchedMujocoEnv, get_task, make_env


class _Controller(Transform):
    """Stands where a controller would: subtracts 1 and keeps what it saw and sent."""

    def __init__(self):
        super().__init__()
        self.seen, self.sent = [], []

    def _inv_call(self, tensordict):
        self.seen.append(tensordict["observation"].clone())
        tensordict["action"] = tensordict["action"] - 1
        self.sent.append(tensordict["action"].clone())
        return tensordict


def _names(env):
    return [type(transform).__name__ for transform in env.transform]


def test_neutral_values_add_no_transform():
    env = make_env("inverted_pendulum", 2, seed=0, actuator_bias=[0.0], actuator_gain=[1.0])
    assert _names(env) == []
    twin = BatchedMujocoEnv("inverted_pendulum", 2, seed=0)
    torch.manual_seed(0)
    ours = env.rollout(100)
    torch.manual_seed(0)
    assert (ours == twin.rollout(100)).all()


def test_order_and_composition():
    controller = _Controller()
    env = make_env(
        "inverted_pendulum",
        3,
        action_noise=0.1,
        observation_noise=0.2,
        actuator_bias=0.5,
        actuator_gain=0.6,
        extra_transforms=[controller],
        seed=0,
        max_steps=5,
    )
    assert _names(env) == [
        "ActuatorGain",
        "ActuatorBias",
        "ActionNoise",
        "ObservationNoise",
        "_Controller",
    ]
    check_env_specs(env)
    controller.seen.clear()
    controller.sent.clear()
    received = []
    base_step = env.base_env._step

    def spy(tensordict):
        received.append(tensordict["action"].clone())
        return base_step(tensordict)

    env.base_env._step = spy
    rollout = env.rollout(12, break_when_any_done=False)
    assert torch.equal(torch.stack(controller.seen, 1), rollout["observation"])
    sent = torch.stack(controller.sent, 1)
    torch.testing.assert_close(sent, rollout["action"] - 1)
    noise = torch.stack(received, 1) / 0.6 - 0.5 - sent
    assert 0 < noise.abs().max() <= 0.1 + 1e-5
    assert noise.unique().numel() > 30


def test_arguments_reach_the_environment():
    env = make_env("half_cheetah", 2, seed=4, max_steps=6, dtype=torch.float64)
    assert env.rollout(100).shape == (2, 6)
    assert env.reset()["observation"].dtype == torch.float64
    twin = make_env("half_cheetah", 2, seed=4)
    again = make_env("half_cheetah", 2, seed=4)
    assert torch.equal(twin.reset()["observation"], again.reset()["observation"])


def test_errors():
    with pytest.raises(
        KeyError, match="Available: cartpole, half_cheetah, hopper, inverted_pendulum"
    ):
        make_env("pendulum", 2)
    for argument in ("action_noise", "observation_noise"):
        with pytest.raises(ValueError, match="half_width"):
            make_env("half_cheetah", 2, **{argument: -0.1})


def test_settings_of_a_task_go_through():
    name = "gymnasium/MountainCarContinuous-v0"
    env = make_env(name, 2, dt=0.5, horizon=7, seed=0)
    assert env.base_env.task.dt == 0.5 and env.rollout(20).shape == (2, 7)
    own = get_task("hopper", horizon=50)
    assert own.horizon == 50 and get_task("hopper", horizon=1000) is get_task("hopper")
    assert get_task(own, horizon=30).horizon == 30
    for settings in ({"dt": 0.3}, {"observation_keys": ["x"]}):
        with pytest.raises(ValueError, match=next(iter(settings))):
            get_task(own, **settings)
    with pytest.raises(ValueError, match=r"horizon .* go with a name"):
        get_task(env.base_env.task, horizon=5)
