"""The benchmark tasks: their physics, rewards and terminations."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import torch
from torch import Tensor

from torchrl_l1.envs.task import Task
from torchrl_l1.registration import EPISODE_STEPS

# Swimmer: the front end of its head in the frame of the body "torso", metres along that body.
SWIMMER_TIP = 1.5

# Cart-pole: distance from the hinge to the tip of the pole, metres; also the scale of how closely
# the reward wants the tip at its highest point.
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

    The last entry is zero at the start of an episode, before any step. (The authors' environment
    keeps its value from the end of the previous episode, so the data would depend on what ran
    before.)
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
    """Tip velocity of the step minus a cost of the action as received, unclipped."""
    return next_observation[..., -1] - 1e-4 * action.square().sum(-1)


def swimmer_imagined_reward(
    observation: Tensor, action: Tensor, next_observation: Tensor
) -> Tensor:
    """As in the authors' imagination: the tip velocity of the step *before*."""
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
    """As in the authors' imagination: the height is that *after* the step."""
    alive = (~walker_fallen(next_observation)).to(observation)
    return observation[..., 8] - _control_cost(action) - _height_cost(next_observation) + alive


def cheetah_reward(observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
    """Speed before the step minus the control cost (clipped action)."""
    return observation[..., 8] - _control_cost(action)


def cartpole_reward(observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
    r"""Closeness of the pole's tip to its highest point above the middle of the rail, after a step.

    :math:`e^{-d^2 / l^2} - 0.01 \lVert a \rVert^2`, with the distance d of the tip :math:`(x - l
    \sin\theta, -l \cos\theta)` from :math:`(0, l)`, and the action as received, unclipped. Upright
    in the middle and without force it is one, hanging there :math:`e^{-4}`.
    """
    x, theta = next_observation[..., 0], next_observation[..., 1]
    across = x - POLE_LENGTH * theta.sin()
    below = POLE_LENGTH * (1 + theta.cos())
    nearness = torch.exp(-(across.square() + below.square()) / POLE_LENGTH**2)
    return nearness - 0.01 * action.square().sum(-1)


def unclamp_actuators(spec: mujoco.MjSpec) -> None:
    """Let actuators follow inputs beyond their ``ctrlrange``, which itself stays unchanged."""
    for actuator in spec.actuators:
        actuator.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE


# Observation: cart position, pole angle (rad), cart velocity, angular velocity. The cost is
# quadratic in the angle and nothing ends the episode, unlike Gymnasium's "+1 per step until the
# pole leaves 0.2 rad".
_INVERTED_PENDULUM = Task(
    name="inverted_pendulum",
    model_file="inverted_pendulum.xml",
    timestep=0.02,
    frame_skip=2,
    horizon=EPISODE_STEPS["inverted_pendulum"],
    observation_dim=4,
    action_dim=1,
    action_low=-3.0,
    action_high=3.0,
    observe=partial(observe_state, skip=0),
    sample_reset=partial(uniform_reset, half_width=0.01),
    reward=pendulum_reward,
)

# The same with the motor of the original experiments: MuJoCo 1.31 let it follow inputs beyond its
# range, which only a policy whose actions are neither clipped nor corrected by L1 ever sends.
_INVERTED_PENDULUM_UNCLAMPED = replace(
    _INVERTED_PENDULUM, name="inverted_pendulum_unclamped", patch=unclamp_actuators
)

# Observation: angles of body and two joints (rad), velocities of the torso frame (x, y) and of
# the angles, and the x velocity of the head's tip, averaged over the step just taken. The paper
# says 8 entries; its runs have these 9, which make the reward a function of the observation.
_SWIMMER = Task(
    name="swimmer",
    model_file="swimmer.xml",
    timestep=0.01,
    frame_skip=4,
    horizon=EPISODE_STEPS["swimmer"],
    observation_dim=9,
    action_dim=2,
    action_low=-1.0,
    action_high=1.0,
    observe=partial(observe_swimmer, dt=0.04),
    sample_reset=partial(uniform_reset, half_width=0.1),
    reward=swimmer_reward,
    reward_in_imagination=swimmer_imagined_reward,
)

# Observation: torso height, pitch, three joint angles, then all velocities; entry 5 is the x
# velocity. An episode continues with the hopper on the ground: no state ends it.
_HOPPER = Task(
    name="hopper",
    model_file="hopper.xml",
    timestep=0.002,
    frame_skip=4,
    horizon=EPISODE_STEPS["hopper"],
    observation_dim=11,
    action_dim=3,
    action_low=-1.0,
    action_high=1.0,
    observe=partial(observe_state, skip=1),
    sample_reset=partial(uniform_reset, half_width=0.005),
    reward=hopper_reward,
)

# Observation: torso height, pitch, six joint angles, then all velocities; entry 8 is the x
# velocity. A fall ends the episode. The XML is the one with different feet (sliding friction 0.9
# and 1.9), like the authors'; walker2d_v5.xml has 1.9 on both.
_WALKER = Task(
    name="walker",
    model_file="walker2d.xml",
    timestep=0.002,
    frame_skip=4,
    horizon=EPISODE_STEPS["walker"],
    observation_dim=17,
    action_dim=6,
    action_low=-1.0,
    action_high=1.0,
    observe=partial(observe_state, skip=1),
    sample_reset=partial(uniform_reset, half_width=0.005),
    reward=walker_reward,
    terminated=walker_fallen,
    reward_in_imagination=walker_imagined_reward,
)

# Observation: all positions but the root's x, then all velocities; entry 8 is the root's
# x velocity (m/s). The reward takes it *before* the step, where Gymnasium's takes the mean over
# the step, and the control cost applies to the clipped action.
_HALF_CHEETAH = Task(
    name="half_cheetah",
    model_file="half_cheetah.xml",
    timestep=0.01,
    frame_skip=5,
    horizon=EPISODE_STEPS["half_cheetah"],
    observation_dim=17,
    action_dim=6,
    action_low=-1.0,
    action_high=1.0,
    observe=partial(observe_state, skip=1),
    sample_reset=cheetah_reset,
    reward=cheetah_reward,
)

# Observation: cart position (m), pole angle (rad, zero where it hangs, not wrapped), cart velocity,
# angular velocity. The swing-up of arXiv 1805.12114, as in its authors' released code: the reward
# sees the state after the step, an episode lasts 200 steps and nothing ends it early.
_CARTPOLE = Task(
    name="cartpole",
    model_file=str(Path(__file__).parent / "assets" / "cartpole.xml"),
    timestep=0.02,
    frame_skip=2,
    horizon=EPISODE_STEPS["cartpole"],
    observation_dim=4,
    action_dim=1,
    action_low=-3.0,
    action_high=3.0,
    observe=partial(observe_state, skip=0),
    sample_reset=partial(normal_reset, standard_deviation=0.1),
    reward=cartpole_reward,
)

TASKS: dict[str, Task] = {
    task.name: task
    for task in (
        _INVERTED_PENDULUM,
        _INVERTED_PENDULUM_UNCLAMPED,
        _SWIMMER,
        _HOPPER,
        _WALKER,
        _HALF_CHEETAH,
        _CARTPOLE,
    )
}
"""The tasks by name."""


def built_in_task(task: str | Task) -> Task:
    """One of our own tasks by name; a :class:`~torchrl_l1.envs.Task` is returned as it is.

    Raises:
        KeyError: if no task has this name; the message lists those that exist.
    """
    if isinstance(task, Task):
        return task
    if task not in TASKS:
        raise KeyError(f"Unknown task {task!r}. Available: {', '.join(sorted(TASKS))}")
    return TASKS[task]


def is_plain(name: str) -> bool:
    """Whether a name can only mean one of our tasks."""
    return "/" not in name and ":" not in name and name not in gymnasium.registry
