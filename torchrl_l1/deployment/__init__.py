"""L1 around policies of any origin: from a policy to a robust one, films and exports."""

from torchrl_l1.deployment.assessment import Assessment
from torchrl_l1.deployment.environments import (
    EnvironmentSource,
    environment_source,
    time_step,
    vector_environment,
)
from torchrl_l1.deployment.export import ControlledStep, Exported, export
from torchrl_l1.deployment.learning import Exploration, target_switch_rate
from torchrl_l1.deployment.policies import FunctionPolicy, StableBaselinesPolicy, load_policy
from torchrl_l1.deployment.robust_controller import RobustController, load_target, robustify

__all__ = [
    "Assessment",
    "ControlledStep",
    "EnvironmentSource",
    "Exploration",
    "Exported",
    "FunctionPolicy",
    "RobustController",
    "StableBaselinesPolicy",
    "environment_source",
    "export",
    "load_policy",
    "load_target",
    "robustify",
    "target_switch_rate",
    "time_step",
    "vector_environment",
]
