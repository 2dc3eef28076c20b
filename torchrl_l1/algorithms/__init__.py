"""Model-based reinforcement learning algorithms, one readable loop each."""

from torchrl_l1.algorithms.collection import Perturbation
from torchrl_l1.algorithms.metrpo import METRPO
from torchrl_l1.algorithms.metrpo_config import METRPOConfig, ModelConfig, PolicyConfig

__all__ = ["METRPO", "METRPOConfig", "ModelConfig", "Perturbation", "PolicyConfig"]
