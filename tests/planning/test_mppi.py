from __future__ import annotations

import math

import pytest
import torch

from torchrl_l1.planning import MPPIConfig, plan_mppi


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_mean_is_weighted_by_the_exponential_of_the_returns():
    drawn = []

    def evaluate(u):
        drawn.append(u.double())
        return 1e4 + 3 * u.sum((-2, -1))  # the exponentials themselves would overflow

    start, config = torch.full((2, 3, 1), 0.2), MPPIConfig(3, 50, temperature=2.0)
    result = plan_mppi(evaluate, start, -1.0, 1.0, config, generator())
    weights = torch.exp(3 * drawn[0].sum((-2, -1)) / 2.0)
    weights = weights / weights.sum(1, keepdim=True)
    expected = torch.einsum("nc,nchm->nhm", weights, drawn[0]).float()
    torch.testing.assert_close(result.mean, expected, atol=1e-3, rtol=1e-3)
    assert torch.equal(result.actions, result.mean)


def test_finds_the_optimum_of_each_environment():
    target = torch.tensor([0.5, -0.7])[:, None, None, None]
    config = MPPIConfig(4, 500, 20, temperature=0.02, variance=0.02)
    result = plan_mppi(
        lambda u: -(u - target).square().sum((-2, -1)),
        torch.zeros(2, 4, 1),
        -1.0,
        1.0,
        config,
        generator(),
    )
    torch.testing.assert_close(result.actions, target[:, 0].expand(-1, 4, -1), atol=0.05, rtol=0)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_returns_that_are_not_finite_weigh_nothing(value):
    def evaluate(u):
        returns = torch.where(u[..., 0, 0] > 0, value, 0.0)
        returns[1] = value
        return returns

    start = torch.zeros(2, 1, 1)
    result = plan_mppi(evaluate, start, -1.0, 1.0, MPPIConfig(1, 200), generator())
    assert -0.5 < result.mean[0].item() < -0.05
    assert result.best[0].item() <= 0 and result.best_return[0] == 0
    assert torch.equal(result.actions[1], start[1]) and result.best_return[1] == -math.inf


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"horizon": 0}, "mppi.horizon must be"),
        ({"iterations": 0}, "mppi.iterations must be"),
        ({"candidates": 0}, "mppi.candidates must be"),
        ({"temperature": 0.0}, "mppi.temperature must be finite and positive"),
        ({"variance": math.nan}, "mppi.variance must be finite"),
    ],
)
def test_impossible_settings_are_named(wrong, message):
    with pytest.raises(ValueError, match=message):
        MPPIConfig(**wrong)


def test_leaves_a_bound_where_it_starts():
    start = torch.ones(1, 1, 1)
    config = MPPIConfig(1, 400, temperature=0.05)
    result = plan_mppi(
        lambda u: -(u + 0.5).square().sum((-2, -1)), start, -1.0, 1.0, config, generator()
    )
    assert result.mean.item() < 0


def test_draws_normal_sequences_clipped_to_the_bounds():
    drawn = []

    def evaluate(u):
        drawn.append(u)
        return torch.zeros(u.shape[:2])

    plan_mppi(evaluate, torch.zeros(1, 1, 1), -1.0, 1.0, MPPIConfig(1, 20_000), generator())
    u = drawn[0].flatten()
    # A quarter of the range is half of the way to a bound, beyond which 2.275 % lie on each side.
    assert (u == 1).double().mean().item() == pytest.approx(0.02275, abs=0.004)
    assert (u.abs() < 0.5).double().mean().item() == pytest.approx(0.6827, abs=0.012)
