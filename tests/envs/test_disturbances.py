from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_l1.envs import ActuatorBias, ActuatorGain, BatchedMujocoEnv


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
    for value in (float("nan"), [0.0, float("inf")], [[1.0]]):
        with pytest.raises(ValueError, match="finite number, or one for each"):
            transform(value)
    wrong = TransformedEnv(BatchedMujocoEnv("half_cheetah", 2, seed=0), transform([1.0, 2.0]))
    with pytest.raises(ValueError, match="2 values, but the action 'action' has 6"):
        wrong.rollout(1)
    with pytest.raises(RuntimeError, match="belongs to an environment"):
        transform(0.5)(TensorDict({"action": torch.zeros(2, 6)}, batch_size=[2]))
