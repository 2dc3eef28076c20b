"""Model-based reinforcement learning algorithms, one readable loop each."""

from torchrl_l1.algorithms.collection import Perturbation
from torchrl_l1.algorithms.metrpo import METRPO, METRPOConfig

__all__ = ["METRPO", "METRPOConfig", "Perturbation"]
