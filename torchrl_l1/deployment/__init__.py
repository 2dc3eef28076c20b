"""L1 around policies of any origin: robust controllers, films and exports."""

from torchrl_l1.control import time_step
from torchrl_l1.deployment.assessment import Assessment
from torchrl_l1.deployment.export import ControlledStep, Exported, export
from torchrl_l1.deployment.learning import Exploration, target_switch_rate
from torchrl_l1.deployment.policies import FunctionPolicy, load_policy
from torchrl_l1.deployment.policy_files import StableBaselinesPolicy
from torchrl_l1.deployment.robust_controller import RobustController, load_target
from torchrl_l1.deployment.robustification import robustify
from torchrl_l1.envs import EnvironmentSource, environment_source, vector_environment

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
