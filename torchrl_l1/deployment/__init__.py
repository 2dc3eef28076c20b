"""L1 around policies of any origin: from a policy to a robust one, films and exports."""

from torchrl_l1.deployment.assessment import Assessment
from torchrl_l1.deployment.environments import (
    EnvironmentSource,
    environment_source,
    time_step,
    vector_environment,
)
from torchrl_l1.deployment.policies import FunctionPolicy, load_policy
from torchrl_l1.deployment.robustify import RobustController, robustify

__all__ = [
    "Assessment",
    "EnvironmentSource",
    "FunctionPolicy",
    "RobustController",
    "environment_source",
    "load_policy",
    "robustify",
    "time_step",
    "vector_environment",
]
