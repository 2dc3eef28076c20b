from __future__ import annotations

import math

import pytest
import scipy.stats
import torch

from torchrl_l1.planning import ShootingConfig, plan_shooting


def test_takes_the_best_of_uniform_sequences_and_the_given_one():
    drawn = []

    def evaluate(u):
        drawn.append(u)
        returns = -(u - 0.3).square().sum((-2, -1))
        returns[:, 1::2] = math.nan
        return returns

    mean = torch.stack([torch.zeros(2, 1), torch.full((2, 1), 0.3)])
    generator = torch.Generator().manual_seed(0)
    result = plan_shooting(evaluate, mean, -1.0, 3.0, ShootingConfig(2, 2000), generator)
    (u,) = drawn
    best = (u[0, ::2] - 0.3).square().sum((-2, -1)).argmin()
    assert torch.equal(result.actions[0], u[0, ::2][best])
    assert torch.equal(result.actions[1], mean[1])
    assert result.best_return[1] == 0
    uniform = scipy.stats.uniform(-1, 4)
    assert scipy.stats.kstest(u[0, 1:].flatten().numpy(), uniform.cdf).pvalue > 1e-3


def test_keeps_the_given_sequence_where_nothing_is_finite():
    mean = torch.full((1, 2, 1), 0.25)
    result = plan_shooting(
        lambda u: torch.full(u.shape[:2], math.nan), mean, -1.0, 1.0, ShootingConfig(2, 5)
    )
    assert torch.equal(result.actions, mean) and result.best_return.item() == -math.inf


def test_impossible_settings_are_named():
    with pytest.raises(ValueError, match=r"ShootingConfig.candidates must be in \[1, inf\], got 0"):
        ShootingConfig(candidates=0)
