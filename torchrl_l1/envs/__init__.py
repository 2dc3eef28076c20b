"""Benchmark tasks, the batched MuJoCo environment, noise and disturbances.

Importing this package registers the tasks with Gymnasium, ``torchrl_l1/HalfCheetah-v0`` and so on.
"""

from __future__ import annotations

from torchrl_l1.envs.factory import make_env
from torchrl_l1.envs.gymnasium_env import MujocoTaskEnv, gymnasium_id, register_tasks
from torchrl_l1.envs.mujoco_env import BatchedMujocoEnv
from torchrl_l1.envs.perturbations import (
    DISTURBANCES,
    ActionNoise,
    ActuatorBias,
    ActuatorGain,
    Disturbance,
    ObservationNoise,
    Perturbation,
)
from torchrl_l1.envs.simulation import BatchedSimulator, StartStates, TaskSimulation
from torchrl_l1.envs.task import Task
from torchrl_l1.envs.tasks import TASKS, get_task

register_tasks()

__all__ = [
    "DISTURBANCES",
    "TASKS",
    "ActionNoise",
    "ActuatorBias",
    "ActuatorGain",
    "BatchedMujocoEnv",
    "BatchedSimulator",
    "Disturbance",
    "MujocoTaskEnv",
    "ObservationNoise",
    "Perturbation",
    "StartStates",
    "Task",
    "TaskSimulation",
    "get_task",
    "gymnasium_id",
    "make_env",
    "register_tasks",
]
