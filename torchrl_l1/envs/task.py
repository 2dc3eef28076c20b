"""The definition of a benchmark task, which physics, rewards and imagination share."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeAlias

import gymnasium
import mujoco
import numpy as np
import torch
from torch import Tensor

ObserveFn = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
RewardFn = Callable[[Tensor, Tensor, Tensor], Tensor]
Scalars: TypeAlias = float | tuple[float, ...]
ResetFn = Callable[
    [np.random.Generator, np.ndarray, np.ndarray, int], tuple[np.ndarray, np.ndarray]
]


class BadAction(ValueError):
    """An action that cannot be given to any environment: not finite, or beyond all bounds."""


def never(next_observation: Tensor) -> Tensor:
    """No state ends the episode."""
    return torch.zeros(
        next_observation.shape[:-1], dtype=torch.bool, device=next_observation.device
    )


class AnyTask(Protocol):
    """What algorithms need to know of a task, be it ours or an environment from elsewhere.

    Implemented by :class:`Task` and :class:`ExternalTask`; for :func:`make_env`, any other class
    also needs the ``environment`` method of the latter. Bounds are one number, or one for each
    entry of the action.
    """

    @property
    def name(self) -> str:
        """Name by which :func:`get_task` finds the task."""

    @property
    def dt(self) -> float:
        """Duration of one environment step in seconds."""

    @property
    def horizon(self) -> int:
        """Environment steps after which an episode is truncated."""

    @property
    def observation_dim(self) -> int:
        """Width ``n`` of the observation."""

    @property
    def action_dim(self) -> int:
        """Width ``m`` of the action."""

    @property
    def action_low(self) -> Scalars:
        """Lower bound of the action."""

    @property
    def action_high(self) -> Scalars:
        """Upper bound of the action."""

    @property
    def imagined_reward(self) -> RewardFn:
        """Reward in imagined rollouts."""

    @property
    def terminated(self) -> Callable[[Tensor], Tensor]:
        """Whether an episode ends in a next observation ``(..., n)``."""

    @property
    def terminates(self) -> bool:
        """Whether any state ends an episode."""


def action_bounds(task: AnyTask, device: torch.device | str | None = None) -> tuple[Tensor, Tensor]:
    """Lower and upper bounds of the action ``(m,)``, float32.

    Examples:
        >>> from torchrl_l1.envs import get_task
        >>> action_bounds(get_task("swimmer"))
        (tensor([-1., -1.]), tensor([1., 1.]))
    """
    low, high = (
        torch.tensor(bound, device=device)
        if isinstance(bound, tuple)
        else torch.full((task.action_dim,), bound, device=device)
        for bound in (task.action_low, task.action_high)
    )
    return low, high


@dataclass(frozen=True)
class Task:
    """Definition of one benchmark task.

    All functions are batched over leading dimensions. Observations are *clean*:
    :class:`~torchrl_l1.envs.ObservationNoise` adds noise after reward and termination are known.

    Args:
        name: key of the task in :data:`~torchrl_l1.envs.TASKS`.
        model_file: MuJoCo XML, relative to Gymnasium's asset folder, or an absolute path (for
            example of a file in your package).
        timestep: integration step of the XML in seconds.
        frame_skip: number of integration steps per environment step.
        horizon: environment steps after which an episode is truncated.
        observation_dim: size ``n`` of the observation.
        action_dim: size ``m`` of the action.
        action_low: lower bound of every action entry.
        action_high: upper bound of every action entry.
        observe: ``(qpos (N, nq), qvel (N, nv), previous_qpos (N, nq)) -> (N, n)``, NumPy float64.
            ``previous_qpos`` are the positions before the environment step just taken, for
            entries that are displacements; at the start of an episode they equal ``qpos``.
        sample_reset: ``(rng, qpos0 (nq,), qvel0 (nv,), N) -> (qpos (N, nq), qvel (N, nv))``.
        reward: ``(observation (..., n), action (..., m), next_observation (..., n)) -> (...)``
            in torch; ``observation`` is the state *before* the step.
        terminated: ``next_observation (..., n) -> bool (...)`` in torch; never by default.
        reward_in_imagination: reward in imagined rollouts, if it is not the real one.
        patch: optional edit of the :class:`mujoco.MjSpec` before it is compiled.

    Examples:
        >>> import torch
        >>> from torchrl_l1.envs import get_task
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
    observe: ObserveFn
    sample_reset: ResetFn
    reward: RewardFn
    terminated: Callable[[Tensor], Tensor] = never
    reward_in_imagination: RewardFn | None = None
    patch: Callable[[mujoco.MjSpec], None] | None = None

    @property
    def imagined_reward(self) -> RewardFn:
        """Reward in imagined rollouts: the real one unless the task says otherwise."""
        return self.reward_in_imagination or self.reward

    @property
    def terminates(self) -> bool:
        """Whether any state ends an episode."""
        return self.terminated is not never

    @property
    def dt(self) -> float:
        """Duration of one environment step in seconds."""
        return self.timestep * self.frame_skip

    @property
    def model_path(self) -> Path:
        """Absolute path of the MuJoCo XML file."""
        return Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / self.model_file

    def build_spec(self) -> mujoco.MjSpec:
        """Read and patch the XML, without compiling it."""
        spec = mujoco.MjSpec.from_file(str(self.model_path))
        if self.patch is not None:
            self.patch(spec)
        return spec

    def build_model(self, spec: mujoco.MjSpec | None = None) -> mujoco.MjModel:
        """Compile the MuJoCo model.

        Args:
            spec: what to compile instead of :meth:`build_spec`, for example with decorations.

        Returns:
            A new :class:`mujoco.MjModel`.

        Raises:
            ValueError: if the XML's timestep, number of actuators or actuator range differ from the
                task's, so that a changed asset cannot silently change the benchmark.
        """
        spec = self.build_spec() if spec is None else spec
        with warnings.catch_warnings():
            # Gymnasium's half_cheetah.xml uses an attribute that MuJoCo 4 deprecates.
            warnings.filterwarnings("ignore", message=".*settotalmass.*")
            model = spec.compile()
        found = (model.opt.timestep, model.nu)
        if found != (self.timestep, self.action_dim):
            raise ValueError(
                f"Task {self.name!r}: {self.model_path} has (timestep, actuators) = {found}, but "
                f"the task says {(self.timestep, self.action_dim)}; correct the task or patch it"
            )
        bounds = (self.action_low, self.action_high)
        if not np.array_equal(model.actuator_ctrlrange, np.tile(bounds, (model.nu, 1))):
            raise ValueError(
                f"Task {self.name!r}: {self.model_path} has the actuator ranges "
                f"{model.actuator_ctrlrange.tolist()}, but the task's action bounds are {bounds}"
            )
        return model
