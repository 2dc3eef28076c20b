"""Observations, resets, rewards and terminations of the tasks, as plain batched functions.

The facts are those of the authors' released code for arXiv 2403.14860 (METRPO part), those of the
cart-pole of the code released with arXiv 1805.12114. Observations and resets are NumPy, rewards and
terminations torch. ``observation`` is the state before the step, ``next_observation`` the one after
it; both are clean.
"""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from torch import Tensor

# Swimmer: the front end of its head in the frame of the body "torso", metres along that body.
SWIMMER_TIP = 1.5

# Cart-pole: from the hinge to the tip of the pole, metres; also how precisely the reward asks the
# tip to be at its highest point.
POLE_LENGTH = 0.6


def observe_state(
    qpos: np.ndarray, qvel: np.ndarray, previous_qpos: np.ndarray, *, skip: int
) -> np.ndarray:
    """All positions but the first ``skip``, then all velocities."""
    return np.concatenate([qpos[..., skip:], qvel], axis=-1)


def observe_swimmer(
    qpos: np.ndarray, qvel: np.ndarray, previous_qpos: np.ndarray, *, dt: float
) -> np.ndarray:
    """The three angles, all velocities, and the mean x velocity of the head's tip in the step.

    The last entry is zero at the start of an episode, where no step was taken. (The authors'
    environment repeats what it was at the end of the episode before: the data would depend on
    what ran before them.)
    """
    tip, previous_tip = (q[..., 0] + SWIMMER_TIP * np.cos(q[..., 2]) for q in (qpos, previous_qpos))
    velocity = (tip - previous_tip) / dt
    return np.concatenate([qpos[..., 2:], qvel, velocity[..., None]], axis=-1)


def uniform_reset(
    rng: np.random.Generator, qpos0: np.ndarray, qvel0: np.ndarray, n: int, *, half_width: float
) -> tuple[np.ndarray, np.ndarray]:
    """Uniform noise around the XML's pose and velocity."""
    qpos = qpos0 + rng.uniform(-half_width, half_width, (n, qpos0.size))
    qvel = qvel0 + rng.uniform(-half_width, half_width, (n, qvel0.size))
    return qpos, qvel


def normal_reset(
    rng: np.random.Generator,
    qpos0: np.ndarray,
    qvel0: np.ndarray,
    n: int,
    *,
    standard_deviation: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Normal noise around the XML's pose and velocity."""
    qpos = qpos0 + standard_deviation * rng.standard_normal((n, qpos0.size))
    qvel = qvel0 + standard_deviation * rng.standard_normal((n, qvel0.size))
    return qpos, qvel


def cheetah_reset(
    rng: np.random.Generator, qpos0: np.ndarray, qvel0: np.ndarray, n: int
) -> tuple[np.ndarray, np.ndarray]:
    """Uniform noise (half-width 0.1) on the pose, normal (0.1) on the velocities."""
    qpos = qpos0 + rng.uniform(-0.1, 0.1, (n, qpos0.size))
    qvel = qvel0 + 0.1 * rng.standard_normal((n, qvel0.size))
    return qpos, qvel


def pendulum_reward(observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
    """Minus the squared angle before the step."""
    return -observation[..., 1].square()


def swimmer_reward(observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
    """Tip velocity of the step, less a cost of the action as received, unclipped."""
    return next_observation[..., -1] - 1e-4 * action.square().sum(-1)


def swimmer_imagined_reward(
    observation: Tensor, action: Tensor, next_observation: Tensor
) -> Tensor:
    """As the authors imagine it: the tip velocity of the step *before*."""
    return observation[..., -1] - 1e-4 * action.square().sum(-1)


def _control_cost(action: Tensor) -> Tensor:
    return 0.1 * action.clamp(-1.0, 1.0).square().sum(-1)


def _height_cost(observation: Tensor) -> Tensor:
    return 3.0 * (observation[..., 0] - 1.3).square()


def hopper_reward(observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
    """Speed before the step, control cost (clipped action), height before the step, plus one."""
    return observation[..., 5] - _control_cost(action) - _height_cost(observation) + 1.0


def walker_fallen(next_observation: Tensor) -> Tensor:
    """Torso not between 0.8 and 2 m, or pitched by 1 rad or more."""
    height, pitch = next_observation[..., 0], next_observation[..., 1]
    return (height >= 2.0) | (height <= 0.8) | (pitch.abs() >= 1.0)


def walker_reward(observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
    """As Hopper's, but the one is earned only if the step did not end in a fall."""
    alive = (~walker_fallen(next_observation)).to(observation)
    return observation[..., 8] - _control_cost(action) - _height_cost(observation) + alive


def walker_imagined_reward(observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
    """As the authors imagine it: the height is that *after* the step."""
    alive = (~walker_fallen(next_observation)).to(observation)
    return observation[..., 8] - _control_cost(action) - _height_cost(next_observation) + alive


def cheetah_reward(observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
    """Speed before the step less the control cost (clipped action)."""
    return observation[..., 8] - _control_cost(action)


def cartpole_reward(observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
    r"""How near the pole's tip is to its highest point over the middle of the rail, after the step.

    :math:`e^{-d^2 / l^2} - 0.01 \lVert a \rVert^2`, with the distance d of the tip
    :math:`(x - l \sin\theta, -l \cos\theta)` from :math:`(0, l)`, and the action as received,
    unclipped. Upright in the middle and without force it is one, hanging there :math:`e^{-4}`.
    """
    x, theta = next_observation[..., 0], next_observation[..., 1]
    across = x - POLE_LENGTH * theta.sin()
    below = POLE_LENGTH * (1 + theta.cos())
    nearness = torch.exp(-(across.square() + below.square()) / POLE_LENGTH**2)
    return nearness - 0.01 * action.square().sum(-1)


def never(next_observation: Tensor) -> Tensor:
    """No state ends the episode."""
    return torch.zeros(
        next_observation.shape[:-1], dtype=torch.bool, device=next_observation.device
    )


def unclamp_actuators(spec: mujoco.MjSpec) -> None:
    """Lets actuators follow inputs beyond their ``ctrlrange``, which stays what it is."""
    for actuator in spec.actuators:
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
