"""Model-based reinforcement learning algorithms, one readable loop each."""

from torchrl_l1.algorithms.collection import Perturbation
from torchrl_l1.algorithms.mbmf import MBMF
from torchrl_l1.algorithms.mbmf_config import (
    ClonedPolicyConfig,
    CloningConfig,
    FineTuningConfig,
    MBMFConfig,
)
from torchrl_l1.algorithms.metrpo import METRPO
from torchrl_l1.algorithms.metrpo_config import METRPOConfig, PolicyConfig
from torchrl_l1.algorithms.model_config import ModelConfig
from torchrl_l1.algorithms.pets import PETS
from torchrl_l1.algorithms.pets_config import PETSConfig

__all__ = [
    "MBMF",
    "METRPO",
    "PETS",
    "ClonedPolicyConfig",
    "CloningConfig",
    "FineTuningConfig",
    "MBMFConfig",
    "METRPOConfig",
    "ModelConfig",
    "PETSConfig",
    "Perturbation",
    "PolicyConfig",
]
