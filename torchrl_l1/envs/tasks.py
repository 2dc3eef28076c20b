"""The benchmark tasks: one table of facts that physics, rewards and imagination share.

A :class:`Task` says everything that distinguishes one benchmark from another. On both tasks here
the real environment (:class:`~torchrl_l1.envs.BatchedMujocoEnv`) and the imagined rollouts of a
model-based algorithm evaluate the *same* reward function, so they cannot drift apart. A task may
differ in that: imagination asks for :attr:`Task.imagined_reward`. The facts follow the authors'
released code for arXiv 2403.14860, which builds on MBBL (arXiv:1907.02057); they differ from the
``-v4`` and ``-v5`` environments of Gymnasium, whose XML files (and nothing else) are used.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import torch
from torch import Tensor

__all__ = ["TASKS", "Task", "get_task"]

RewardFn = Callable[[Tensor, Tensor, Tensor], Tensor]
ResetFn = Callable[
    [np.random.Generator, np.ndarray, np.ndarray, int], tuple[np.ndarray, np.ndarray]
]


def _never(next_observation: Tensor) -> Tensor:
    return torch.zeros(
        next_observation.shape[:-1], dtype=torch.bool, device=next_observation.device
    )


@dataclass(frozen=True)
class Task:
    """Facts of one benchmark task.

    All functions are batched over leading dimensions. Observations are *clean*: noise is added by
    :class:`~torchrl_l1.envs.ObservationNoise` after reward and termination are known.

    Args:
        name: key of the task in :data:`TASKS`.
        model_file: MuJoCo XML, relative to Gymnasium's asset folder, or an absolute path.
        timestep: integration step of the XML in seconds.
        frame_skip: number of integration steps per environment step.
        horizon: environment steps after which an episode is truncated.
        observation_dim: size ``n`` of the observation.
        action_dim: size ``m`` of the action.
        action_low: lower bound of every action entry.
        action_high: upper bound of every action entry.
        observe: ``(qpos (N, nq), qvel (N, nv)) -> (N, n)``, NumPy float64.
        sample_reset: ``(rng, qpos0 (nq,), qvel0 (nv,), N) -> (qpos (N, nq), qvel (N, nv))``.
        reward: ``(observation (..., n), action (..., m), next_observation (..., n)) -> (...)``
            in torch; ``observation`` is the state *before* the step.
        terminated: ``next_observation (..., n) -> bool (...)`` in torch; never by default.
        reward_in_imagination: reward of imagined rollouts where it is not the real one.
        patch: optional edit of the :class:`mujoco.MjSpec` before it is compiled.

    Examples:
        >>> import torch
        >>> task = get_task("inverted_pendulum")
        >>> task.dt
        0.04
        >>> observation = torch.tensor([0.0, 0.5, 0.0, 0.0])
        >>> task.reward(observation, torch.zeros(1), observation)
        tensor(-0.2500)
    """

    name: str
    model_file: str
    timestep: float
    frame_skip: int
    horizon: int
    observation_dim: int
    action_dim: int
    action_low: float
    action_high: float
    observe: Callable[[np.ndarray, np.ndarray], np.ndarray]
    sample_reset: ResetFn
    reward: RewardFn
    terminated: Callable[[Tensor], Tensor] = _never
    reward_in_imagination: RewardFn | None = None
    patch: Callable[[mujoco.MjSpec], None] | None = None

    @property
    def imagined_reward(self) -> RewardFn:
        """Reward of imagined rollouts: the real one unless the task says otherwise."""
        return self.reward_in_imagination or self.reward

    @property
    def dt(self) -> float:
        """Duration of one environment step in seconds."""
        return self.timestep * self.frame_skip

    @property
    def model_path(self) -> Path:
        """Absolute path of the MuJoCo XML file."""
        return Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / self.model_file

    def build_spec(self) -> mujoco.MjSpec:
        """Reads and patches the XML, without compiling it."""
        spec = mujoco.MjSpec.from_file(str(self.model_path))
        if self.patch is not None:
            self.patch(spec)
        return spec

    def build_model(self, spec: mujoco.MjSpec | None = None) -> mujoco.MjModel:
        """Compiles the MuJoCo model.

        Args:
            spec: what to compile instead of :meth:`build_spec`, for example with decorations.

        Returns:
            A new :class:`mujoco.MjModel`.

        Raises:
            ValueError: if the XML's timestep, number of actuators or actuator range differ from
                the table's, so that a changed asset cannot silently change the benchmark.
        """
        spec = self.build_spec() if spec is None else spec
        with warnings.catch_warnings():
            # Gymnasium's half_cheetah.xml uses an attribute that MuJoCo 4 calls deprecated.
            warnings.filterwarnings("ignore", message=".*settotalmass.*")
            model = spec.compile()
        found = (model.opt.timestep, model.nu)
        if found != (self.timestep, self.action_dim):
            raise ValueError(
                f"Task {self.name!r}: {self.model_path} has (timestep, actuators) = {found}, but "
                f"the task says {(self.timestep, self.action_dim)}. Correct the task or patch it."
            )
        bounds = (self.action_low, self.action_high)
        if not np.array_equal(model.actuator_ctrlrange, np.tile(bounds, (model.nu, 1))):
            raise ValueError(
                f"Task {self.name!r}: {self.model_path} has the actuator ranges "
                f"{model.actuator_ctrlrange.tolist()}, but the task's action bounds are {bounds}."
            )
        return model


def _uniform_reset(
    rng: np.random.Generator, qpos0: np.ndarray, qvel0: np.ndarray, n: int, *, half_width: float
) -> tuple[np.ndarray, np.ndarray]:
    qpos = qpos0 + rng.uniform(-half_width, half_width, (n, qpos0.size))
    qvel = qvel0 + rng.uniform(-half_width, half_width, (n, qvel0.size))
    return qpos, qvel


def _cheetah_reset(
    rng: np.random.Generator, qpos0: np.ndarray, qvel0: np.ndarray, n: int
) -> tuple[np.ndarray, np.ndarray]:
    qpos = qpos0 + rng.uniform(-0.1, 0.1, (n, qpos0.size))
    qvel = qvel0 + 0.1 * rng.standard_normal((n, qvel0.size))
    return qpos, qvel


def _observe(qpos: np.ndarray, qvel: np.ndarray, *, skip: int) -> np.ndarray:
    return np.concatenate([qpos[..., skip:], qvel], axis=-1)


def _pendulum_reward(observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
    return -observation[..., 1].square()


def _cheetah_reward(observation: Tensor, action: Tensor, next_observation: Tensor) -> Tensor:
    return observation[..., 8] - 0.1 * action.clamp(-1.0, 1.0).square().sum(-1)


TASKS: dict[str, Task] = {
    task.name: task
    for task in (
        # Observation: cart position, pole angle (rad), cart velocity, angular velocity.
        # The cost is quadratic in the angle and nothing ends the episode, unlike Gymnasium's
        # "+1 per step until the pole leaves 0.2 rad".
        Task(
            name="inverted_pendulum",
            model_file="inverted_pendulum.xml",
            timestep=0.02,
            frame_skip=2,
            horizon=100,
            observation_dim=4,
            action_dim=1,
            action_low=-3.0,
            action_high=3.0,
            observe=partial(_observe, skip=0),
            sample_reset=partial(_uniform_reset, half_width=0.01),
            reward=_pendulum_reward,
        ),
        # Observation: all positions but the root's x, then all velocities; entry 8 is the root's
        # x velocity (m/s). The reward takes it *before* the step, where Gymnasium's takes the
        # mean over the step, and the control cost applies to the clipped action.
        Task(
            name="half_cheetah",
            model_file="half_cheetah.xml",
            timestep=0.01,
            frame_skip=5,
            horizon=1000,
            observation_dim=17,
            action_dim=6,
            action_low=-1.0,
            action_high=1.0,
            observe=partial(_observe, skip=1),
            sample_reset=_cheetah_reset,
            reward=_cheetah_reward,
        ),
    )
}
"""The tasks by name."""


def get_task(task: str | Task) -> Task:
    """Looks a task up by name; a :class:`Task` passes through.

    Args:
        task: a key of :data:`TASKS`, or a task of your own.

    Returns:
        The task.

    Raises:
        KeyError: if no task has this name; the message lists those that exist.
    """
    if isinstance(task, Task):
        return task
    if task not in TASKS:
        raise KeyError(f"Unknown task {task!r}. Available: {', '.join(sorted(TASKS))}.")
    return TASKS[task]
