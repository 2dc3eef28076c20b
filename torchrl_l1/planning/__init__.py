"""Planning in learned models: trajectory sampling, optimisers of action sequences, a policy."""

from torchrl_l1.dynamics.network import PlanningNetwork, Precision, resolve_precision
from torchrl_l1.planning.cem import CEMConfig
from torchrl_l1.planning.cem import plan as plan_cem
from torchrl_l1.planning.compiled_motion import resolve_compilation
from torchrl_l1.planning.mppi import MPPIConfig
from torchrl_l1.planning.mppi import plan as plan_mppi
from torchrl_l1.planning.particles import Propagation
from torchrl_l1.planning.planner import PLAN_KEY, ModelPredictiveController
from torchrl_l1.planning.random_shooting import ShootingConfig
from torchrl_l1.planning.random_shooting import plan as plan_shooting
from torchrl_l1.planning.sequences import Evaluate, Plan
from torchrl_l1.planning.trajectory_sampling import TrajectorySampler, check_sampling, evaluate

__all__ = [
    "PLAN_KEY",
    "CEMConfig",
    "Evaluate",
    "MPPIConfig",
    "ModelPredictiveController",
    "Plan",
    "PlanningNetwork",
    "Precision",
    "Propagation",
    "ShootingConfig",
    "TrajectorySampler",
    "check_sampling",
    "evaluate",
    "plan_cem",
    "plan_mppi",
    "plan_shooting",
    "resolve_compilation",
    "resolve_precision",
]
