"""Model-based reinforcement learning algorithms, one readable loop each."""

from torchrl_l1.algorithms.algorithm import Algorithm
from torchrl_l1.algorithms.config import ModelConfig
from torchrl_l1.algorithms.mbmf import MBMF
from torchrl_l1.algorithms.mbmf_config import (
    ClonedPolicyConfig,
    CloningConfig,
    FineTuningConfig,
    MBMFConfig,
)
from torchrl_l1.algorithms.metrpo import METRPO
from torchrl_l1.algorithms.metrpo_config import METRPOConfig, PolicyConfig
from torchrl_l1.algorithms.offline import Offline
from torchrl_l1.algorithms.offline_config import (
    DatasetColumns,
    OfflineCloningConfig,
    OfflineConfig,
)
from torchrl_l1.algorithms.outcomes import OutcomeConfig, Outcomes
from torchrl_l1.algorithms.pets import PETS
from torchrl_l1.algorithms.pets_config import PETSConfig
from torchrl_l1.envs import Perturbation

__all__ = [
    "MBMF",
    "METRPO",
    "PETS",
    "Algorithm",
    "ClonedPolicyConfig",
    "CloningConfig",
    "DatasetColumns",
    "FineTuningConfig",
    "MBMFConfig",
    "METRPOConfig",
    "ModelConfig",
    "Offline",
    "OfflineCloningConfig",
    "OfflineConfig",
    "OutcomeConfig",
    "Outcomes",
    "PETSConfig",
    "Perturbation",
    "PolicyConfig",
]
