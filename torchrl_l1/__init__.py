"""Robust model-based reinforcement learning with L1 adaptive control, for TorchRL.

The names that users compose are exported here; everything else lives in the sub-packages
``control``, ``dynamics``, ``planning``, ``envs``, ``objectives``, ``algorithms``, ``experiment``,
``campaign``, ``report`` and ``deployment``. Names are loaded on first use, since torch takes
seconds to import.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import TYPE_CHECKING

from torchrl_l1._version import __version__
from torchrl_l1.registration import register_tasks

if TYPE_CHECKING:
    from torchrl_l1.algorithms import MBMF, METRPO, PETS, MBMFConfig, METRPOConfig, PETSConfig
    from torchrl_l1.control import (
        ActionJacobian,
        Affinizer,
        L1Config,
        L1Controller,
        L1State,
        L1Transform,
    )
    from torchrl_l1.deployment import RobustController, robustify
    from torchrl_l1.dynamics import (
        EnsembleDynamics,
        EnsembleDynamicsLoss,
        EnsembleModelEnv,
        fit_dynamics,
    )
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
    "RobustController",
    "ShootingConfig",
    "TrajectorySampler",
    "__version__",
    "fit_dynamics",
    "make_env",
    "robustify",
]

# In the order in which they import each other: looking a name up loads no more than it needs.
_PACKAGES = (
    *("control", "dynamics", "envs", "objectives", "planning", "algorithms"),
    "deployment",
)

if "gymnasium" in sys.modules:
    register_tasks()


def __getattr__(name: str) -> object:
    """Load a sub-package, or the one that exports a public name (PEP 562)."""
    if name in _PACKAGES:
        return import_module(f"{__name__}.{name}")
    for package in _PACKAGES if name in __all__ else ():
        module = import_module(f"{__name__}.{package}")
        if name in module.__all__:
            globals()[name] = getattr(module, name)
            return globals()[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_PACKAGES})
