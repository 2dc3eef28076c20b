from __future__ import annotations

from dataclasses import replace
from functools import partial

import gymnasium
import pytest
import torch
from torchrl.envs import (
    Compose,
    FrameSkipTransform,
    GymEnv,
    GymWrapper,
    ParallelEnv,
    PendulumEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)

from torchrl_l1.control import L1Transform, time_step
from torchrl_l1.envs import TASKS, BatchedMujocoEnv, MujocoTaskEnv

pendulum = partial(GymEnv, "Pendulum-v1")


class Repeat(gymnasium.Wrapper):
    def __init__(self, env: gymnasium.Env, skip: int) -> None:
        super().__init__(env)
        self._skip = skip


class Silent(gymnasium.Env):
    """Tells nothing, and its ``dt`` is broken."""

    observation_space = gymnasium.spaces.Box(-1, 1, (3,))
    action_space = gymnasium.spaces.Box(-1, 1, (1,))

    @property
    def dt(self) -> float:
        raise RuntimeError("no clock")


def skipping(frames: int) -> TransformedEnv:
    return TransformedEnv(pendulum(), Compose(StepCounter(), FrameSkipTransform(frames)))


def vector_env(task: str) -> gymnasium.vector.VectorEnv:
    mode = gymnasium.vector.AutoresetMode.DISABLED
    return gymnasium.vector.SyncVectorEnv([partial(MujocoTaskEnv, task)], autoreset_mode=mode)


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (pendulum, 0.05),
        (partial(GymEnv, "InvertedPendulum-v5"), 0.04),
        (partial(GymEnv, "Pendulum-v1", frame_skip=4), 0.2),
        (partial(skipping, 3), 0.15),
        (lambda: TransformedEnv(skipping(3), FrameSkipTransform(2), auto_unwrap=False), 0.3),
        (lambda: GymWrapper(Repeat(gymnasium.make("Pendulum-v1"), 2)), 0.1),
        (lambda: GymWrapper(vector_env("hopper")), 0.008),
        (lambda: GymWrapper(MujocoTaskEnv("half_cheetah")), 0.05),
        (lambda: BatchedMujocoEnv("swimmer", 2), 0.04),
        (lambda: BatchedMujocoEnv(replace(TASKS["hopper"], frame_skip=8), 2), 0.016),
        (PendulumEnv, 0.05),
        (lambda: GymWrapper(Silent()), None),
        (partial(ParallelEnv, 2, pendulum), None),
    ],
)
def test_time_step_of_environments(make, expected, forked_processes):
    env = make()
    found = time_step(env)
    assert found == (None if expected is None else pytest.approx(expected, rel=1e-6))
    env.close(raise_if_closed=False)


def model(observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    return 0.1 * action.expand_as(observation)


def test_time_step_of_serial_environments_once_they_run():
    env = SerialEnv(2, partial(skipping, 2))
    augmented = TransformedEnv(env, L1Transform(model))
    with pytest.raises(ValueError, match="knows dt only once an environment"):
        augmented.transform.config
    augmented.reset()
    assert augmented.transform.config.dt == pytest.approx(0.1)


def test_an_environment_that_does_not_tell():
    env = TransformedEnv(GymWrapper(Silent()), L1Transform(model))
    with pytest.raises(
        ValueError, match=r"L1Transform needs dt, .* the environment does not declare"
    ):
        env.transform._complete()
    env = TransformedEnv(GymWrapper(Silent()), L1Transform(model, dt=0.3))
    env.transform._complete()
    assert env.transform.config.dt == 0.3


@pytest.mark.parametrize(("dt", "agrees"), [(0.05, True), (0.0500001, True), (0.0501, False)])
def test_rounding_is_no_difference(dt, agrees):
    env = TransformedEnv(pendulum(), L1Transform(model, dt=dt))
    if agrees:
        env.reset()
        assert env.transform.config.dt == dt
        return
    with pytest.raises(ValueError, match=r"has dt=0\.0501, but a step of the environment takes"):
        env.reset()
    TransformedEnv(pendulum(), L1Transform(model, dt=dt, check_dt=False)).reset()
