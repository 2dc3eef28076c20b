"""Start states of imagined episodes: those of the real task."""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from torch import Tensor

from .task import Task
from .tasks import get_task

__all__ = ["StartStates"]


class StartStates:
    """Draws clean initial observations of a task, without stepping any physics.

    Randomness follows torch's global generator, like the rest of an imagined rollout.

    Args:
        task: a key of :data:`~torchrl_l1.envs.TASKS`, or a :class:`~torchrl_l1.envs.Task`.

    Examples:
        >>> StartStates("half_cheetah")(8).shape
        torch.Size([8, 17])
    """

    def __init__(self, task: str | Task) -> None:
        self.task = get_task(task)
        data = mujoco.MjData(self.task.build_model())
        self._initial = (data.qpos.copy(), data.qvel.copy())

    def __call__(self, count: int) -> Tensor:
        """Initial observations ``(count, n)``, float32."""
        seed = int(torch.randint(2**31, ()))
        rng = np.random.default_rng(seed)
        qpos, qvel = self.task.sample_reset(rng, *self._initial, count)
        return torch.from_numpy(self.task.observe(qpos, qvel, qpos)).float()
