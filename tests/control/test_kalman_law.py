"""The robust law against the documented formulas in NumPy, with explicit inverses."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_l1.control import (
    ActionJacobian,
    L1Config,
    L1State,
    ResidualStatistics,
    augment,
    init,
    step,
)
from torchrl_l1.control.kalman_law import adapted, estimate

BOUNDS = {"action_low": -1.0, "action_high": 1.0}


def updated(
    mean: np.ndarray, prior: np.ndarray, seen: np.ndarray, missed: np.ndarray, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A disturbance's mean and covariance after a residual of that noise."""
    gain = prior @ seen.T @ np.linalg.inv(seen @ prior @ seen.T + noise)
    return mean + gain @ missed, (np.eye(len(mean)) - gain @ seen) @ prior


# A step of three states and two actions, whose input and disturbance stay within the bounds.
X_HAT = np.array([0.5, -0.3, 1.0])
MEAN = np.array([0.3, -0.2])
PRIOR = np.array([[0.5, 0.1], [0.1, 0.4]])
NOISE = np.array([9.0, 1.0, 0.5])
SEEN = np.array([[1.0, 0.2], [0.3, -0.8], [0.1, 0.4]])
COVARIANCE = 0.001 * np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 2.0], [0.0, 2.0, 16.0]])
SKILL = np.array([-9.0, 8.0])  # gained and promised before
INFLATION, PROCESS_NOISE = 2.0, 0.1
SMALL, HUGE = np.array([0.1, -0.1, 0.1]), np.array([1.8, 5.7, -1.8])  # what it misses


def given(config: L1Config, missed: np.ndarray) -> tuple[L1State, torch.Tensor, ResidualStatistics]:
    """State, observation and statistics of the step."""
    state = init([], 3, 2, config, dtype=torch.float64)._replace(
        x_hat=torch.as_tensor(X_HAT),
        sigma_m=torch.as_tensor(MEAN),
        started=torch.tensor([True]),
        covariance=torch.as_tensor(PRIOR).flatten(),
        noise=torch.as_tensor(NOISE),
        jacobian=torch.as_tensor(SEEN).flatten(),
        skill=torch.as_tensor(SKILL) if config.skill_forgetting < 1 else None,
    )
    statistics = ResidualStatistics(torch.as_tensor(COVARIANCE), INFLATION, PROCESS_NOISE)
    return state, torch.as_tensor(X_HAT + missed), statistics


def expected(missed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Mean before the projection, covariance, the residual's ratios of noise and its doubt."""
    prior = PRIOR + PROCESS_NOISE**2 * np.eye(2)  # half the range of the action is one
    scale = np.sqrt(np.array([9.0, 1.0, 1.0]) * (9.0 + 1.0 + 1.0) / 3)
    weight = INFLATION * COVARIANCE * np.outer(scale, scale)
    mean, _ = updated(MEAN, prior, SEEN, missed, weight)
    left = missed - SEEN @ (mean - MEAN)
    doubt = max(1.0, left @ np.linalg.inv(weight) @ left / 3)
    mean, covariance = updated(MEAN, prior, SEEN, missed, doubt * weight)
    left = missed - SEEN @ (mean - MEAN)
    square = left**2 + np.diag(SEEN @ covariance @ SEEN.T)
    return mean, covariance, square / np.diag(INFLATION * COVARIANCE), doubt


def forecast_before(missed: np.ndarray) -> tuple[float, float]:
    """What the estimate before the step took off the square of the residual, and promised to."""
    scale = np.sqrt(np.array([9.0, 1.0, 1.0]) * (9.0 + 1.0 + 1.0) / 3)
    doubt = expected(missed)[3]
    weight = np.linalg.inv(doubt * INFLATION * COVARIANCE * np.outer(scale, scale))
    forecast, residual = SEEN @ MEAN, SEEN @ MEAN + missed
    gained = residual @ weight @ residual - missed @ weight @ missed
    return gained, forecast @ weight @ forecast


WRONG = -4 * SEEN @ MEAN  # the residual is thrice the forecast, with the other sign


@pytest.mark.parametrize("missed", [SMALL, WRONG, HUGE], ids=["small", "wrong", "huge"])
def test_the_input_is_scaled_by_what_forecasts_have_gained_of_what_they_promised(missed):
    config = L1Config.robust(0.05, skill_forgetting=0.9, dead_zone=0.0, **BOUNDS)
    gained, promised = forecast_before(missed)
    found = estimate(config, *given(config, missed))
    sums = 0.9 * SKILL + [gained, promised]
    np.testing.assert_allclose(found.skill, sums)
    share = (sums[0] + 10) / (sums[1] + 10)
    assert (share < 0) == (missed is WRONG)
    acted = adapted(config, found, torch.zeros(2, dtype=torch.float64)).q
    np.testing.assert_allclose(acted, min(max(share, 0.0), 1.0) * found.posterior.mean)


@pytest.mark.parametrize(("period", "low", "high"), [(None, 0.99, 1.0), (4, 0.0, 0.2)])
def test_a_lasting_disturbance_is_acted_on_and_one_that_outruns_the_estimate_is_not(
    period, low, high
):
    rng = np.random.default_rng(0)
    found = {}
    for forgetting in (0.99, 1.0):
        config = L1Config.robust(
            0.05, skill_forgetting=forgetting, process_noise=0.3, forgetting=1.0, dead_zone=0.0,
            **BOUNDS,
        )  # fmt: skip
        statistics = ResidualStatistics(0.0001 * torch.eye(2, dtype=torch.float64))
        state = init([], 2, 1, config, dtype=torch.float64)
        zero, x, acted = torch.zeros(2, dtype=torch.float64), torch.zeros(2).double(), []
        jacobian = torch.tensor([[0.5], [0.2]], dtype=torch.float64)
        for t in range(600):
            u, state, signals = step(
                config, state, x, zero[:1], zero, jacobian, residuals=statistics
            )
            sign = 1.0 if period is None or t % period < period // 2 else -1.0
            x = x + jacobian @ (u + 0.4 * sign) + 0.01 * torch.as_tensor(rng.normal(size=2))
            acted.append(state.q.abs().item())
        found[forgetting] = np.mean(acted[300:])
        gained, promised = (10.0, 10.0) if state.skill is None else (state.skill + 10).tolist()
        share = min(max(gained / promised, 0.0), 1.0)
        assert signals.forecast_skill.item() == pytest.approx(share)
    assert low <= found[0.99] / found[1.0] <= high
    assert found[1.0] > 0.2


@pytest.mark.parametrize("missed", [SMALL, HUGE], ids=["small", "huge"])
def test_an_estimate_is_that_of_the_documented_formulas(missed):
    config = L1Config.robust(0.05, forgetting=0.9, **BOUNDS)
    mean, covariance, ratio, doubt = expected(missed)
    assert (doubt > 1) == (abs(mean).max() > 2) == (missed is HUGE)
    bounded = mean.clip(-2, 2)  # no disturbance is larger than the range of the action
    found = estimate(config, *given(config, missed))
    np.testing.assert_allclose(found.posterior.mean, bounded)
    np.testing.assert_allclose(found.posterior.covariance, covariance)
    np.testing.assert_allclose(found.noise, 0.9 * NOISE + 0.1 * ratio)
    np.testing.assert_allclose(found.innovation, missed)
    np.testing.assert_allclose(found.residual, missed + SEEN @ MEAN)
    np.testing.assert_allclose(found.effect_matched, SEEN @ bounded)


def test_the_diagnostics_are_those_of_the_estimate():
    config = L1Config.robust(0.05, dead_zone=0.1, skill_forgetting=1.0, **BOUNDS)
    state, observation, statistics = given(config, SMALL)
    zero, jacobian = torch.zeros(3, dtype=torch.float64), torch.as_tensor(SEEN)
    *_, found = step(config, state, observation, zero[:2], zero, jacobian, residuals=statistics)
    mean, covariance, *_ = expected(SMALL)
    variance = np.diag(covariance)
    acted = mean * (1 - 0.1**2 * variance / mean**2)
    for name, value in {
        "prediction_error": np.linalg.norm(SMALL),
        "matched": np.linalg.norm(SEEN @ mean) / 0.05,
        "unmatched": np.linalg.norm(SMALL + SEEN @ (MEAN - mean)) / 0.05,
        "u_a": np.linalg.norm(acted),
        "posterior_deviation": variance.sum() ** 0.5,
        "significance": (abs(mean) / variance**0.5).max(),
        "forecast_skill": 1.0,
    }.items():
        assert getattr(found, name).item() == pytest.approx(value), name


class Uneven:
    """It errs little where it pushes forwards."""

    def mean_change(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return torch.cat([action.sin(), 0.5 * action.sin()], -1)

    def residual_covariance(self, observation: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return torch.diag_embed(torch.where(action > 0, 0.01, 1.0).to(action).expand(2))


def test_a_residual_is_weighed_by_what_was_expected_of_the_last_executed_input():
    config = L1Config.robust(
        0.05, covariance="sum", process_noise=0.1, inflation=2.0, forgetting=1.0, dead_zone=0.0,
        initial_deviation=0.5, skill_forgetting=1.0,
    )  # fmt: skip
    rng, model = np.random.default_rng(0), ActionJacobian(Uneven())
    state = init([], 2, 1, config, dtype=torch.float64)
    gain, seen = np.array([1.0, 0.5]), np.zeros((2, 1))  # nothing is seen at first
    u, x_hat, mean, signs = np.zeros(1), np.zeros(2), np.zeros(1), set()
    covariance = (0.5**2 - 0.1**2) * np.eye(1)  # a step of the walk before the first
    for x, u_rl in zip(rng.normal(size=(12, 2)), rng.normal(size=(12, 1)), strict=True):
        noise = 2.0 * (0.01 if u > 0 else 1.0) * np.eye(2)
        prior = covariance + 0.1**2 * np.eye(1)
        mean, covariance = updated(mean, prior, seen, x - x_hat, noise)
        signs.add((*(u > 0), *(u_rl > 0), *(u_rl > mean)))
        u = u_rl - mean
        seen = np.outer(gain, np.cos(u))
        x_hat = x + gain * np.sin(u) + seen @ mean
        found, state, _ = augment(config, model, state, *map(torch.as_tensor, (x, u_rl)))
        np.testing.assert_allclose(found, u)
        np.testing.assert_allclose(state.sigma_m, mean)
        np.testing.assert_allclose(state.covariance, covariance.flatten())
        np.testing.assert_allclose(state.x_hat, x_hat)
    assert len(signs) > 4  # of the last input, this step's action and its input
