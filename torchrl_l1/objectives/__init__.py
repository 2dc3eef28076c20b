"""Policy objectives that TorchRL lacks: TRPO and the linear value baseline."""

from torchrl_l1.objectives.gaussian_trpo import gaussian_trpo_step, is_tanh_network
from torchrl_l1.objectives.linear_baseline import LinearFeatureBaseline
from torchrl_l1.objectives.trpo import (
    NonFiniteAdvantages,
    TRPOConfig,
    TRPOReport,
    conjugate_gradient,
    trpo_step,
)

__all__ = [
    "LinearFeatureBaseline",
    "NonFiniteAdvantages",
    "TRPOConfig",
    "TRPOReport",
    "conjugate_gradient",
    "gaussian_trpo_step",
    "is_tanh_network",
    "trpo_step",
]
