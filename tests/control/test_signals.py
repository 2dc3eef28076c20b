from __future__ import annotations

import pytest
import torch

from torchrl_l1.control import L1Config
from torchrl_l1.control.kalman import Posterior
from torchrl_l1.control.signals import ControlInput, Terms, diagnose


def test_the_diagnostics_of_a_step_by_hand():
    flag = torch.tensor([False])
    terms = Terms(
        x_err=torch.tensor([3.0, -4.0]),
        estimate=torch.tensor([1.2, 1.4]),
        effect_matched=torch.tensor([0.6, 0.8]),
        control=ControlInput.of(
            L1Config(0.05, action_low=-1.0, action_high=1.0),
            torch.tensor([0.5, 1.0]),
            torch.tensor([0.3, -0.4]),
        ),
        ill_conditioned=flag,
        non_finite=flag,
        dtype=torch.float32,
        posterior=Posterior(torch.tensor([1.0, -3.0]), torch.diag(torch.tensor([0.04, 0.25]))),
        skill=torch.tensor([20.0, 50.0]),
    )
    found = diagnose(L1Config(0.05), terms, affinization_error=torch.tensor([0.7]))
    assert {name: value.item() for name, value in found._asdict().items()} == pytest.approx(
        {
            "switch": False,
            "affinization_error": 0.7,
            "prediction_error": 5.0,
            "matched": 1.0 / 0.05,
            "unmatched": 0.6 * 2**0.5 / 0.05,
            "u_a": 0.5,
            "saturation": 0.5,
            "ill_conditioned": False,
            "non_finite": False,
            "posterior_deviation": 0.29**0.5,
            "significance": 6.0,
            "forecast_skill": (20 + 10) / (50 + 10),
        }
    )
