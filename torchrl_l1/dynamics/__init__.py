"""Learned models of the dynamics: batched ensembles, their training and their use."""

from torchrl_l1.dynamics.control_affine import ControlAffineDynamics
from torchrl_l1.dynamics.data import read_csv, read_minari, read_npz
from torchrl_l1.dynamics.ensemble import EnsembleMLP
from torchrl_l1.dynamics.factory import MODEL_FORMS, make_dynamics, matched_hidden
from torchrl_l1.dynamics.fit import (
    FitConfig,
    FitReport,
    fit_dynamics,
    fit_ensemble,
)
from torchrl_l1.dynamics.heads import (
    HEADS,
    BernoulliHead,
    DeterministicHead,
    GaussianHead,
    Head,
    make_head,
)
from torchrl_l1.dynamics.imagination import EnsembleModelEnv, EnsembleWorldModel, imagine
from torchrl_l1.dynamics.loss import EnsembleDynamicsLoss, evaluate_members
from torchrl_l1.dynamics.model import EnsembleDynamics
from torchrl_l1.dynamics.normalizer import DataBox, Normalizer
from torchrl_l1.dynamics.outcomes import (
    RewardModel,
    TerminationModel,
    fit_reward,
    fit_termination,
)
from torchrl_l1.dynamics.quality import FitQuality
from torchrl_l1.dynamics.residuals import calibrate_filter
from torchrl_l1.dynamics.transitions import Transitions, read_transitions
from torchrl_l1.dynamics.validation import measure_quality

__all__ = [
    "HEADS",
    "MODEL_FORMS",
    "BernoulliHead",
    "ControlAffineDynamics",
    "DataBox",
    "DeterministicHead",
    "EnsembleDynamics",
    "EnsembleDynamicsLoss",
    "EnsembleMLP",
    "EnsembleModelEnv",
    "EnsembleWorldModel",
    "FitConfig",
    "FitQuality",
    "FitReport",
    "GaussianHead",
    "Head",
    "Normalizer",
    "RewardModel",
    "TerminationModel",
    "Transitions",
    "calibrate_filter",
    "evaluate_members",
    "fit_dynamics",
    "fit_ensemble",
    "fit_reward",
    "fit_termination",
    "imagine",
    "make_dynamics",
    "make_head",
    "matched_hidden",
    "measure_quality",
    "read_csv",
    "read_minari",
    "read_npz",
    "read_transitions",
]
