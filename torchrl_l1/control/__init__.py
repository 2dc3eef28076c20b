"""L1 adaptive control around learned dynamics.

The core is pure functions (:func:`step`, :func:`augment`); :class:`L1Transform` puts them into an
environment, :class:`L1Controller` behind a policy. :class:`OracleTransform` gives an upper bound on
what either can achieve.
"""

from torchrl_l1.control.affine import (
    AffineModel,
    Affinization,
    affinize,
    augment,
    switching_law,
)
from torchrl_l1.control.affinizer import Affinizer
from torchrl_l1.control.calibration import Calibration, calibrate
from torchrl_l1.control.config import L1Config
from torchrl_l1.control.controller import L1Controller, L1Primer
from torchrl_l1.control.jacobian import ActionJacobian, DynamicsModel
from torchrl_l1.control.law import step
from torchrl_l1.control.least_squares import solve_matched
from torchrl_l1.control.oracle import OracleTransform
from torchrl_l1.control.state import L1Diagnostics, L1State, ResidualStatistics, init
from torchrl_l1.control.step_time import repeats, time_step
from torchrl_l1.control.transform import L1Transform

__all__ = [
    "ActionJacobian",
    "AffineModel",
    "Affinization",
    "Affinizer",
    "Calibration",
    "DynamicsModel",
    "L1Config",
    "L1Controller",
    "L1Diagnostics",
    "L1Primer",
    "L1State",
    "L1Transform",
    "OracleTransform",
    "ResidualStatistics",
    "affinize",
    "augment",
    "calibrate",
    "init",
    "repeats",
    "solve_matched",
    "step",
    "switching_law",
    "time_step",
]
