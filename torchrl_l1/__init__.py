"""Robust model-based reinforcement learning with L1 adaptive control, for TorchRL.

The names users compose are exported here; everything else lives in the sub-packages ``control``,
``dynamics``, ``planning``, ``envs``, ``objectives``, ``algorithms``, ``experiment``, ``campaign``
and ``report``.
"""

from torchrl_l1._version import __version__
from torchrl_l1.algorithms import MBMF, METRPO, PETS, MBMFConfig, METRPOConfig, PETSConfig
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
from torchrl_l1.planning import (
    CEMConfig,
    ModelPredictiveController,
    ShootingConfig,
    TrajectorySampler,
)

__all__ = [
    "MBMF",
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
    "MBMFConfig",
    "METRPOConfig",
    "ModelPredictiveController",
    "PETSConfig",
    "ShootingConfig",
    "TrajectorySampler",
    "__version__",
    "make_env",
]
