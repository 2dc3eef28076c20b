"""L1Transform on every kind of environment, with partial resets."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl import set_auto_unwrap_transformed_env
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import (
    Compose,
    DoubleToFloat,
    EnvBase,
    GymEnv,
    ParallelEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from torchrl_l1.control import ActionJacobian, L1Config, L1State, L1Transform, augment, init
from torchrl_l1.dynamics import EnsembleDynamics
from torchrl_l1.envs import TASKS, BatchedMujocoEnv

CONFIG = L1Config(0.04, epsilon=0.003, action_low=-3.0, action_high=3.0)
pendulum = partial(GymEnv, "InvertedPendulum-v5")


@pytest.fixture(scope="module")
def model() -> EnsembleDynamics:
    torch.manual_seed(0)
    return EnsembleDynamics(4, 1, members=2, hidden=(16,), activation="tanh")


@pytest.fixture
def actor() -> TensorDictModule:
    torch.manual_seed(1)
    return TensorDictModule(nn.Linear(4, 1), ["observation"], ["action"])


def with_l1(base: EnvBase, model: EnsembleDynamics, max_steps: int | None = 7) -> TransformedEnv:
    limit = [] if max_steps is None else [StepCounter(max_steps)]
    transform = Compose(DoubleToFloat(), L1Transform(model, CONFIG), *limit)
    return TransformedEnv(base, transform, auto_unwrap=True)


def assert_l1_is_right(data: TensorDictBase, model: EnsembleDynamics) -> None:
    """Recompute every environment's controller by itself from the recorded inputs."""
    data = data.reshape(-1, data.shape[-1])
    jacobian = ActionJacobian(model)
    resets = 0
    for trajectory in data.unbind(0):
        state = init([1], 4, 1)
        for t, item in enumerate(trajectory.unbind(0)):
            if t > 0 and trajectory["next", "done"][t - 1]:
                state = init([1], 4, 1)
                resets += 1
            assert item["l1", "started"].item() == state.started.item()
            with torch.no_grad():
                u, state, _ = augment(
                    CONFIG, jacobian, state, item["observation"][None], item["action"][None]
                )
            torch.testing.assert_close(item["next", "l1", "u_exec"], u[0], atol=1e-5, rtol=1e-5)
            for name, value in zip(L1State._fields, state, strict=True):
                torch.testing.assert_close(item["next", "l1", name], value[0], atol=1e-5, rtol=1e-5)
    assert resets > 0
    assert data["next", "l1", "n_switch"].max() > 0


# Forked from a process that has loaded the package, where the system does that well.
START = "forkserver" if sys.platform.startswith("linux") else "spawn"
BASES = {
    "one": pendulum,
    "own": lambda: BatchedMujocoEnv("inverted_pendulum", num_envs=2),
    "serial": lambda: SerialEnv(2, pendulum),
    "parallel": lambda: ParallelEnv(2, pendulum, mp_start_method=START),
}


@pytest.mark.parametrize("kind", BASES)
def test_around_an_environment(kind, model, actor):
    env = with_l1(BASES[kind](), model)
    check_env_specs(env)
    env.set_seed(0)
    assert_l1_is_right(env.rollout(20, actor, break_when_any_done=False), model)
    env.close()


def test_around_a_vectorised_gym_environment(model):
    # Gymnasium resets its own environments when the pole falls, which a constant push ensures.
    env = with_l1(pendulum(num_envs=2), model, max_steps=None)
    check_env_specs(env)
    env.set_seed(0)
    push = torch.tensor([[0.3], [1.0]])
    actor = TensorDictModule(lambda x: push + 0.1 * x[..., :1], ["observation"], ["action"])
    data = env.rollout(40, actor, break_when_any_done=False)
    first, second = (row.nonzero().flatten().tolist() for row in data["next", "done"].squeeze(-1))
    assert first != second
    assert_l1_is_right(data, model)
    env.close()


@pytest.mark.parametrize("kind", ["serial", "spawned"])
def test_inside_a_batched_environment(kind, model, actor):
    def make():
        l1 = L1Transform(model, CONFIG)
        return TransformedEnv(
            GymEnv("InvertedPendulum-v5"), Compose(DoubleToFloat(), l1, StepCounter(7))
        )

    env = SerialEnv(2, make) if kind == "serial" else ParallelEnv(2, make)
    check_env_specs(env)
    env.set_seed(0)
    assert_l1_is_right(env.rollout(20, actor, break_when_any_done=False), model)
    env.close()


@pytest.mark.parametrize("max_frames", [None, 5])
def test_in_a_collector(model, actor, max_frames):
    env = with_l1(SerialEnv(2, pendulum), model, max_steps=7 if max_frames is None else None)
    with set_auto_unwrap_transformed_env(True):  # the collector wraps the environment again
        collector = Collector(
            env,
            actor,
            frames_per_batch=40,
            total_frames=80,
            max_frames_per_traj=max_frames or 0,
            auto_register_policy_transforms=False,
        )
    batches = list(collector)
    collector.shutdown()
    # The second batch goes on where the first ended.
    assert_l1_is_right(torch.cat(batches, dim=-1), model)
    assert batches[1]["l1", "started"][:, 0].all() or max_frames is not None


@pytest.mark.parametrize("in_collector", [False, True])
def test_own_environments_that_end_at_different_times(model, in_collector):
    falling = replace(TASKS["inverted_pendulum"], terminated=lambda o: o[..., 1].abs() > 0.2)
    env = with_l1(BatchedMujocoEnv(falling, num_envs=4, seed=0), model, max_steps=None)
    push = torch.tensor([[0.2], [0.5], [1.0], [-1.5]])
    actor = TensorDictModule(lambda x: push + 0.1 * x[..., :1], ["observation"], ["action"])
    if in_collector:
        with set_auto_unwrap_transformed_env(True):
            collector = Collector(
                env,
                actor,
                frames_per_batch=80,
                total_frames=160,
                auto_register_policy_transforms=False,
            )
        data = torch.cat(list(collector), dim=-1)
        collector.shutdown()
    else:
        data = env.rollout(40, actor, break_when_any_done=False)
        env.close()
    ends = data["next", "terminated"].squeeze(-1)
    assert ends.any(-1).all()
    assert (ends.any(0) & ~ends.all(0)).any()  # partial resets
    assert len({tuple(row.nonzero().flatten().tolist()) for row in ends}) == 4
    assert_l1_is_right(data, model)


def test_partial_reset_by_hand(model, actor):
    env = with_l1(SerialEnv(3, pendulum), model, max_steps=None)
    data = env.reset()
    for _ in range(4):
        _, data = env.step_and_maybe_reset(actor(data))
    before = data["l1"].clone()
    data["_reset"] = torch.tensor([[False], [True], [False]])
    after = env.reset(data)["l1"]
    assert after["started"].squeeze(-1).tolist() == [True, False, True]
    for name in L1State._fields:
        torch.testing.assert_close(after[name][[0, 2]], before[name][[0, 2]], atol=0, rtol=0)
    assert after["n_switch"][1] == 0
    env.close()


def test_replay_data_hold_the_policys_action(model, actor):
    env = with_l1(SerialEnv(2, pendulum), model)
    data = env.rollout(10, actor, break_when_any_done=False)
    env.close()
    buffer = ReplayBuffer(storage=LazyTensorStorage(20), batch_size=20)
    buffer.extend(data.reshape(-1))
    stored = buffer[:]
    torch.testing.assert_close(stored["action"], actor(stored.clone())["action"])
    executed = stored["next", "l1", "u_exec"]
    assert not torch.allclose(executed, stored["action"])
