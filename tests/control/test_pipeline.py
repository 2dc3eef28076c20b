from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import gymnasium
import pytest
import torch
from torchrl.envs import (
    Compose,
    EnvBase,
    FrameSkipTransform,
    GymEnv,
    GymWrapper,
    ParallelEnv,
    PendulumEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    VecNorm,
    VecNormV2,
)

from torchrl_l1.control import L1Controller, L1Transform, time_step
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
    with pytest.raises(ValueError, match="knows dt once an environment is reset"):
        augmented.transform.config
    augmented.reset()
    assert augmented.transform.config.dt == pytest.approx(0.1)


def test_an_environment_that_does_not_tell():
    env = TransformedEnv(GymWrapper(Silent()), L1Transform(model))
    with pytest.raises(ValueError, match=r"L1Transform needs dt, .* the environment does not tell"):
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


def test_a_transform_appended_later_is_checked_at_the_next_reset():
    env = TransformedEnv(pendulum(), L1Transform(model))
    env.rollout(2)
    env.append_transform(FrameSkipTransform(2))
    with pytest.raises(ValueError, match="FrameSkipTransform comes after L1Transform"):
        env.reset()


def normalised(kind: type[VecNorm | VecNormV2], frozen: bool, outside: bool) -> TransformedEnv:
    """A pendulum behind a running normaliser, which has seen some steps."""
    env = TransformedEnv(pendulum(), kind(in_keys=["observation"]))
    env.rollout(5)
    if frozen:
        env.transform.freeze()
    return TransformedEnv(env, StepCounter(), auto_unwrap=False) if outside else env


def gymnasium_normalised(frozen: bool) -> GymWrapper:
    env = gymnasium.wrappers.NormalizeObservation(gymnasium.make("Pendulum-v1"))
    env.update_running_mean = not frozen
    return GymWrapper(env)


def with_face(face: str, env: EnvBase, **settings: Any) -> EnvBase:
    if face == "transform":
        return TransformedEnv(env, L1Transform(model, **settings), auto_unwrap=False)
    controller = L1Controller(model, observation_dim=3, action_dim=1, **settings)
    return TransformedEnv(env, controller.make_primer(), auto_unwrap=False)


FACES = ("transform", "controller")
NORMALISED = {
    "VecNorm": partial(normalised, VecNorm),
    "VecNormV2": partial(normalised, VecNormV2),
    "NormalizeObservation": lambda frozen, outside: gymnasium_normalised(frozen),
}


@pytest.mark.filterwarnings("ignore:.*VecNorm:FutureWarning")
@pytest.mark.parametrize("face", FACES)
@pytest.mark.parametrize("outside", [False, True])
@pytest.mark.parametrize("name", NORMALISED)
def test_statistics_that_change_before_l1_are_noticed(face, outside, name):
    make = NORMALISED[name]
    with pytest.warns(UserWarning, match=f"{name} stands between .* changes its statistics"):
        with_face(face, make(frozen=False, outside=outside)).reset()
    with_face(face, make(frozen=True, outside=outside)).reset()


def test_statistics_that_change_in_each_environment_are_noticed():
    base = SerialEnv(2, partial(gymnasium_normalised, False))
    with pytest.warns(UserWarning, match="NormalizeObservation stands between"):
        TransformedEnv(base, L1Transform(model, dt=0.05)).reset()


def test_statistics_that_change_elsewhere_do_not_matter():
    own = VecNormV2(in_keys=["observation"], out_keys=["normal"])
    TransformedEnv(pendulum(), Compose(own, L1Transform(model))).reset()


@pytest.mark.filterwarnings("ignore:.*VecNorm:FutureWarning")
@pytest.mark.parametrize("face", FACES)
def test_bounds_beyond_those_of_the_environment_are_noticed(face):
    for bounds in ({"action_high": 3.0}, {"action_low": -3.0}, {"action_high": (2.5,)}):
        with pytest.warns(UserWarning, match="the environment's action ends at -?2.0"):
            with_face(face, pendulum(), **bounds).reset()
    # Less authority is a choice, and infinite bounds say that the spec is wrong.
    for bound in (1.0, 2.0, math.inf):
        with_face(face, pendulum(), action_low=-bound, action_high=bound).reset()
