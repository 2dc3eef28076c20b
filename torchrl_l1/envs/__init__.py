"""Benchmark tasks, the batched MuJoCo environment, noise and disturbances.

Importing this package registers the tasks with Gymnasium, ``torchrl_l1/HalfCheetah-v0`` and so on.
"""

from __future__ import annotations

from torchrl_l1.envs.actuators import (
    ActuatorBias,
    ActuatorDelay,
    ActuatorGain,
    DeadZone,
    FailingMotor,
    SineBias,
    StepBias,
    Stiction,
    WalkBias,
)
from torchrl_l1.envs.disturbances import RandomSigns, Uniform
from torchrl_l1.envs.external import ExternalEnv, ExternalTask
from torchrl_l1.envs.factory import get_task, make_env
from torchrl_l1.envs.gymnasium_env import MujocoTaskEnv
from torchrl_l1.envs.mujoco_env import BatchedMujocoEnv
from torchrl_l1.envs.perturbations import (
    DISTURBANCES,
    SUITES,
    ActionNoise,
    Disturbance,
    ObservationNoise,
    Perturbation,
    disturbance_transforms,
    suite,
)
from torchrl_l1.envs.plant import disturbed_model, wind_force
from torchrl_l1.envs.references import (
    code_digests,
    file_digest,
    load_attribute,
    load_module,
    same_code,
)
from torchrl_l1.envs.sensors import SensorBias, SensorDelay, SensorDropout
from torchrl_l1.envs.simulation import BatchedSimulator, StartStates, TaskSimulation
from torchrl_l1.envs.sources import EnvironmentSource, environment_source
from torchrl_l1.envs.task import AnyTask, BadAction, Task, action_bounds
from torchrl_l1.envs.tasks import TASKS
from torchrl_l1.envs.vectors import vector_environment
from torchrl_l1.registration import gymnasium_id, register_tasks

register_tasks()

__all__ = [
    "DISTURBANCES",
    "SUITES",
    "TASKS",
    "ActionNoise",
    "ActuatorBias",
    "ActuatorDelay",
    "ActuatorGain",
    "AnyTask",
    "BadAction",
    "BatchedMujocoEnv",
    "BatchedSimulator",
    "DeadZone",
    "Disturbance",
    "EnvironmentSource",
    "ExternalEnv",
    "ExternalTask",
    "FailingMotor",
    "MujocoTaskEnv",
    "ObservationNoise",
    "Perturbation",
    "RandomSigns",
    "SensorBias",
    "SensorDelay",
    "SensorDropout",
    "SineBias",
    "StartStates",
    "StepBias",
    "Stiction",
    "Task",
    "TaskSimulation",
    "Uniform",
    "WalkBias",
    "action_bounds",
    "code_digests",
    "disturbance_transforms",
    "disturbed_model",
    "environment_source",
    "file_digest",
    "get_task",
    "gymnasium_id",
    "load_attribute",
    "load_module",
    "make_env",
    "register_tasks",
    "same_code",
    "suite",
    "vector_environment",
    "wind_force",
]
