"""Physics and task facts together: what TorchRL's and Gymnasium's environments have in common."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

from .simulator import MAX_MAGNITUDE, BatchedSimulator
from .task import Task

__all__ = ["TaskSimulation", "TaskStep"]


class TaskStep(NamedTuple):
    """Outcome of a step: ``reward`` float64, ``terminated`` and ``bad`` bool, each ``(N,)``."""

    reward: Tensor
    terminated: Tensor
    bad: Tensor


class TaskSimulation:
    """A task in ``num_envs`` simulations, without horizon, noise or random generator of its own.

    Args:
        task: the task.
        num_envs: number of environments ``N``.
        threads: threads that share the physics.

    Attributes:
        simulator: the physics.
        observation: clean observations ``(N, n)``, float64. Every reset and step puts a new tensor
            here; the old one is never written to.
    """

    def __init__(self, task: Task, num_envs: int, threads: int = 1) -> None:
        self.task = task
        self.simulator = BatchedSimulator(task, num_envs, threads)
        data = mujoco.MjData(self.simulator.model)
        self._initial = (data.qpos.copy(), data.qvel.copy())
        self.observation = self._observe(self.simulator.qpos)

    def _observe(self, previous_qpos: np.ndarray) -> Tensor:
        simulator = self.simulator
        # A copy: a task of a user may return the live positions themselves.
        return torch.tensor(self.task.observe(simulator.qpos, simulator.qvel, previous_qpos))

    def reset(self, rng: np.random.Generator, indices: np.ndarray) -> None:
        """Starts new episodes in some environments and leaves the others alone."""
        if indices.size:
            qpos, qvel = self.task.sample_reset(rng, *self._initial, indices.size)
            self.set_state(qpos, qvel, indices)

    def set_state(
        self, qpos: np.ndarray, qvel: np.ndarray, indices: np.ndarray | None = None
    ) -> None:
        """Starts new episodes from given states, in all environments or in some.

        Raises:
            ValueError: if a shape is wrong or a number is not finite.
        """
        self.simulator.set_state(qpos, qvel, indices)
        started = np.arange(self.simulator.num_envs) if indices is None else indices
        fresh = self._observe(self.simulator.qpos)
        chosen = torch.zeros(len(fresh), 1, dtype=torch.bool)
        chosen[started] = True
        # The others keep entries that belong to the step they took.
        self.observation = torch.where(chosen, fresh, self.observation)

    def step(self, action: Tensor) -> TaskStep:
        """Advances every environment by one environment step.

        An environment whose simulation turns bad keeps its state and its observation.

        Args:
            action: ``(N, m)``; MuJoCo clamps it where the XML says so.

        Raises:
            ValueError: if the shape is wrong, or an entry is not finite or beyond 1e10.
        """
        action = self._checked(action)
        before = self.simulator.qpos.copy()
        bad = torch.from_numpy(self.simulator.step(action.numpy()))
        previous, following = self.observation, self._observe(before)
        if bad.any():
            following = torch.where(bad.unsqueeze(-1), previous, following)
        self.observation = following
        reward = self.task.reward(previous, action, following)
        return TaskStep(reward, self.task.terminated(following) | bad, bad)

    def _checked(self, action: Tensor) -> Tensor:
        expected = (self.simulator.num_envs, self.task.action_dim)
        if tuple(action.shape) != expected:
            raise ValueError(f"'action' has shape {tuple(action.shape)}, expected {expected}.")
        action = action.detach().to(torch.float64)
        magnitude = np.abs(action.numpy())
        # Written so that NaN fails too; MuJoCo would replace such an input by zero.
        if not magnitude.max() <= MAX_MAGNITUDE:
            index = int(np.flatnonzero(~(magnitude <= MAX_MAGNITUDE).all(1))[0])
            raise ValueError(
                f"'action' of environment {index} is {action[index].tolist()}: every entry must "
                f"be finite and at most {MAX_MAGNITUDE:g} in magnitude. Check the policy's output."
            )
        return action
