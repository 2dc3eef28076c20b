"""TorchRL's own list of tests for transforms, written for L1Transform."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer, Unbounded
from torchrl.envs import (
    ClipTransform,
    Compose,
    EnvBase,
    ExcludeTransform,
    GymEnv,
    ParallelEnv,
    SerialEnv,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from torchrl_l1.control import L1Transform


def model(observation: Tensor, action: Tensor) -> Tensor:
    return 0.01 * observation + 0.1 * action.expand_as(observation)


def l1(**settings) -> L1Transform:
    return L1Transform(model, epsilon=0.5, **settings)


pendulum = partial(GymEnv, "Pendulum-v1")


def transformed(base=pendulum) -> TransformedEnv:
    # Workers cannot be asked for their time step.
    return TransformedEnv(base(), l1(dt=0.05))


def check(env: EnvBase) -> TensorDictBase:
    check_env_specs(env)
    env.set_seed(0)
    data = env.rollout(6, break_when_any_done=False)
    env.close()
    assert not data["l1", "started"][..., 0, :].any() and data["l1", "started"][..., 1:, :].all()
    executed = data["next", "l1", "u_exec"]
    assert executed.shape == data["action"].shape and (executed != data["action"]).any()
    return data


def test_single_trans_env_check():
    assert check(transformed()).shape == (6,)


def test_serial_trans_env_check():
    assert check(SerialEnv(2, transformed)).shape == (2, 6)


@pytest.mark.usefixtures("forked_processes")
def test_parallel_trans_env_check():
    env = ParallelEnv(2, transformed)
    assert check(env).shape == (2, 6)


def test_trans_serial_env_check():
    assert check(transformed(partial(SerialEnv, 2, pendulum))).shape == (2, 6)


@pytest.mark.usefixtures("forked_processes")
def test_trans_parallel_env_check():
    base = partial(ParallelEnv, 2, pendulum)
    assert check(transformed(base)).shape == (2, 6)


def test_transform_no_env():
    data = TensorDict(observation=torch.ones(3), action=torch.ones(1))
    transform = l1(dt=0.05)
    for call in (transform, transform.inv):
        with pytest.raises(RuntimeError, match="L1Transform acts inside an environment"):
            call(data)


def test_transform_compose():
    data = TensorDict(observation=torch.ones(3), action=torch.ones(1))
    compose = Compose(ClipTransform(["observation"], low=-9.0, high=9.0), l1(dt=0.05))
    for call in (compose, compose.inv):
        with pytest.raises(RuntimeError, match="L1Transform acts inside an environment"):
            call(data)
    env = TransformedEnv(pendulum(), compose)
    assert env.transform[1].parent.transform[0] is not compose[0]
    check(env)


def test_transform_env():
    env = transformed()
    assert env.action_spec == pendulum().action_spec
    state, observation = env.state_spec["l1"], env.observation_spec["l1"]
    assert set(state.keys()) < set(observation.keys())
    assert isinstance(observation["u_exec"], Unbounded) and isinstance(env.action_spec, Bounded)
    reset = env.reset()
    assert observation.is_in(reset["l1"])
    torch.testing.assert_close(reset["l1", "seal"][:3], reset["observation"])
    step = env.rand_step(reset)
    assert observation.is_in(step["next", "l1"]) and step["action"].shape == (1,)
    twin = TransformedEnv(pendulum(), env.transform.clone())
    assert twin.transform.parent is not env.transform.parent
    with pytest.raises(AttributeError, match="already set"):
        TransformedEnv(pendulum(), env.transform)


def test_transform_model():
    module = torch.nn.Sequential(l1(dt=0.05), torch.nn.Linear(3, 1))
    with pytest.raises(RuntimeError, match="L1Transform acts inside an environment"):
        module(TensorDict(observation=torch.ones(3)))


@pytest.mark.parametrize("kind", [ReplayBuffer, TensorDictReplayBuffer])
def test_transform_rb(kind):
    data = transformed().rollout(6)
    buffer = kind(storage=LazyTensorStorage(10), batch_size=6)
    buffer.append_transform(l1(dt=0.05))
    with pytest.raises(RuntimeError, match="not to a replay buffer"):
        buffer.extend(data)
    # What stored data need not hold goes with one word.
    buffer = kind(storage=LazyTensorStorage(10), batch_size=6)
    buffer.append_transform(ExcludeTransform("l1", ("next", "l1"), inverse=True))
    buffer.extend(data)
    sample = buffer.sample()
    assert "l1" not in sample and ("next", "l1") not in sample.keys(True)
    assert sample["action"].shape == (6, 1)


def test_transform_inverse():
    env = transformed()
    data = env.reset().set("action", torch.full((1,), 0.5))
    before = data.clone()
    # On its way in the action becomes the executed input, on a copy.
    executed = env.transform.inv(data)
    assert executed is not data and (data == before).all()
    torch.testing.assert_close(executed["action"], torch.full((1,), 0.5))
    second = env.step(data)["next"].select("observation", "l1").set("action", data["action"])
    second = env.step(second)["next"].select("observation", "l1").set("action", data["action"])
    assert (env.transform.inv(second)["action"] != data["action"]).any()
