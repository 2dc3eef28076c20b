"""Benchmark tasks, the batched MuJoCo environment, noise and disturbances.

Importing this package registers the tasks with Gymnasium, ``torchrl_l1/HalfCheetah-v0`` and so on.
"""

from __future__ import annotations

from .disturbances import ActuatorBias, ActuatorGain
from .factory import make_env
from .gymnasium_env import MujocoTaskEnv, gymnasium_id, register_tasks
from .mujoco_env import BatchedMujocoEnv
from .noise import ActionNoise, ObservationNoise
from .simulator import BatchedSimulator
from .start_states import StartStates
from .task import Task
from .task_simulation import TaskSimulation
from .tasks import TASKS, get_task

register_tasks()

__all__ = [
    "TASKS",
    "ActionNoise",
    "ActuatorBias",
    "ActuatorGain",
    "BatchedMujocoEnv",
    "BatchedSimulator",
    "MujocoTaskEnv",
    "ObservationNoise",
    "StartStates",
    "Task",
    "TaskSimulation",
    "get_task",
    "gymnasium_id",
    "make_env",
    "register_tasks",
]
