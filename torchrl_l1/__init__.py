"""Robust model-based reinforcement learning with L1 adaptive control, for TorchRL.

The names users compose are exported here; everything else lives in the sub-packages ``control``,
``dynamics``, ``planning``, ``envs``, ``objectives``, ``algorithms``, ``experiment``, ``campaign``
and ``report``.
"""

from torchrl_l1._version import __version__
from torchrl_l1.algorithms import METRPO, PETS, METRPOConfig, PETSConfig
from torchrl_l1.control import (
    ActionJacobian,
    Affinizer,
    L1Config,
    L1Controller,
    L1State,
    L1Transform,
)
from torchrl_l1.dynamics import EnsembleDynamics, EnsembleDynamicsLoss, EnsembleModelEnv
from torchrl_l1.envs import BatchedMujocoEnv, make_env
from torchrl_l1.planning import CEMConfig, ModelPredictiveController, TrajectorySampler

__all__ = [
    "METRPO",
    "PETS",
    "ActionJacobian",
    "Affinizer",
    "BatchedMujocoEnv",
    "CEMConfig",
    "EnsembleDynamics",
    "EnsembleDynamicsLoss",
    "EnsembleModelEnv",
    "L1Config",
    "L1Controller",
    "L1State",
    "L1Transform",
    "METRPOConfig",
    "ModelPredictiveController",
    "PETSConfig",
    "TrajectorySampler",
    "__version__",
    "make_env",
]
