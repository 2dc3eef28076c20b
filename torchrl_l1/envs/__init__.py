"""Benchmark tasks, the batched MuJoCo environment, noise and disturbances."""

from __future__ import annotations

from .disturbances import ActuatorBias, ActuatorGain
from .factory import make_env
from .mujoco_env import BatchedMujocoEnv
from .noise import ActionNoise, ObservationNoise
from .simulator import BatchedSimulator
from .start_states import StartStates
from .tasks import TASKS, Task, get_task

__all__ = [
    "TASKS",
    "ActionNoise",
    "ActuatorBias",
    "ActuatorGain",
    "BatchedMujocoEnv",
    "BatchedSimulator",
    "ObservationNoise",
    "StartStates",
    "Task",
    "get_task",
    "make_env",
]
