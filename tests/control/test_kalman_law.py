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
    # What no disturbance explains that has just set in, of 0.3 of half the range.
    sudden = prior + 0.3**2 * np.eye(2)
    fit, spread = updated(MEAN, sudden, SEEN, missed, weight)
    left = missed - SEEN @ (fit - MEAN)
    doubt = max(1.0, left @ np.linalg.inv(weight) @ left / 3)
    square = left**2 + np.diag(SEEN @ spread @ SEEN.T) / ((9.0 + 1.0 + 1.0) / 3)
    ratio = square / np.diag(INFLATION * COVARIANCE)
    mean, covariance = updated(MEAN, prior, SEEN, missed, doubt * weight)
    return mean, covariance, np.minimum(ratio, 25 * np.maximum(NOISE, 1)), doubt


def forecast_before(missed: np.ndarray, dead_zone: float) -> tuple[float, float]:
    """What the estimate acted on took off the square of the residual, and promised to."""
    scale = np.sqrt(np.array([9.0, 1.0, 1.0]) * (9.0 + 1.0 + 1.0) / 3)
    doubt = expected(missed)[3]
    weight = np.linalg.inv(doubt * INFLATION * COVARIANCE * np.outer(scale, scale))
    variance = np.diag(PRIOR) + PROCESS_NOISE**2
    acted = MEAN * np.maximum(0, 1 - dead_zone**2 * variance / MEAN**2)
    forecast, residual = SEEN @ acted, SEEN @ MEAN + missed
    left = residual - forecast
    return residual @ weight @ residual - left @ weight @ left, forecast @ weight @ forecast


WRONG = -4 * SEEN @ MEAN  # the residual is thrice the forecast, with the other sign


@pytest.mark.parametrize("dead_zone", [0.0, 0.35])  # the second leaves one of two entries alone
@pytest.mark.parametrize("missed", [SMALL, WRONG, HUGE], ids=["small", "wrong", "huge"])
def test_the_input_is_scaled_by_what_forecasts_have_gained_of_what_they_promised(missed, dead_zone):
    config = L1Config.robust(0.05, skill_forgetting=0.9, dead_zone=dead_zone, **BOUNDS)
    gained, promised = forecast_before(missed, dead_zone)
    found = estimate(config, *given(config, missed))
    sums = 0.9 * SKILL + [gained, promised]
    np.testing.assert_allclose(found.skill, sums)
    share = (sums[0] + 10) / (sums[1] + 10)
    assert (share < 0) == (missed is WRONG and dead_zone == 0)
    mean, covariance, *_ = expected(missed)
    mean = mean.clip(-2, 2)
    significant = mean * np.maximum(0, 1 - dead_zone**2 * np.diag(covariance) / mean**2)
    acted = adapted(config, found, torch.zeros(2, dtype=torch.float64)).q
    np.testing.assert_allclose(acted, min(max(share, 0.0), 1.0) * significant)


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


EFFECT = np.array([1.0, 0.5, 0.3])


def inputs_against(
    disturbance: np.ndarray, noise: float, glitch: float = 0.0, **settings: float
) -> tuple[np.ndarray, L1State, np.ndarray]:
    """Inputs ``[T, 50]`` against a disturbance ``[T]``, the last state, and shares acted on.

    The model is right but for white noise. At step 30 the first sensor is off by ``glitch``.
    """
    config = L1Config.robust(0.05, process_noise=0.003, inflation=1.0, **settings, **BOUNDS)
    statistics = ResidualStatistics(noise**2 * torch.eye(3, dtype=torch.float64))
    state, rng = init([50], 3, 1, config, dtype=torch.float64), np.random.default_rng(0)
    x, zero = torch.zeros(50, 3).double(), torch.zeros(50, 1).double()
    jacobian = torch.as_tensor(EFFECT)[:, None].expand(50, 3, 1)
    inputs, shares = [], []
    for t, pushed in enumerate(disturbance):
        seen = x.clone()
        seen[:, 0] += glitch * (t == 30)
        u, state, signals = step(config, state, seen, zero, -seen, jacobian, residuals=statistics)
        force = (u + pushed).clamp(-1, 1)
        x = force * torch.as_tensor(EFFECT) + noise * torch.as_tensor(rng.normal(size=(50, 3)))
        inputs.append(u.squeeze(-1).numpy())
        shares.append(signals.forecast_skill.squeeze(-1).numpy())
    return np.stack(inputs), state, np.stack(shares)


@pytest.mark.parametrize("noise", [0.001, 0.01, 0.03, 0.1])
@pytest.mark.parametrize(("before", "after"), [(0.0, 0.1), (0.0, 0.5), (0.4, -0.4), (-0.2, 0.0)])
def test_a_change_after_long_quiet_is_followed_and_not_taken_for_noise(noise, before, after):
    disturbance = np.concatenate([np.full(100, before), np.full(120, after)])
    inputs, state, _ = inputs_against(disturbance, noise)
    # One that is told how good its sensors are, and takes all else for the disturbance.
    told, _, _ = inputs_against(disturbance, noise, forgetting=1.0, skill_forgetting=1.0)
    error, least = (np.abs(one[160:] + after).mean() for one in (inputs, told))
    assert error < 1.5 * least + 0.01
    assert state.noise.median() < 1.1


@pytest.mark.parametrize("size", [10.0, 100.0, 1000.0])
def test_one_wild_value_of_a_sensor_does_not_blind_the_filter(size):
    disturbance = np.concatenate([np.zeros(60), np.full(150, 0.2)])
    calm, wild = (
        np.median(inputs_against(disturbance, 0.1, glitch)[0], 1) < -0.16
        for glitch in (0.0, 0.1 * size)
    )
    assert calm.any() and wild.any()
    assert wild.argmax() < calm.argmax() + 10


def test_what_a_disturbance_explains_is_not_noise_however_long_it_lasts():
    disturbance = np.concatenate([np.zeros(60), np.full(1000, 0.05)])
    *_, state, _ = inputs_against(disturbance, 0.01)
    assert (state.noise.median(0).values < 1.1).all() and state.noise.max() < 3


def test_with_nothing_to_forecast_its_skill_is_not_in_doubt():
    inputs, _, shares = inputs_against(np.zeros(300), 0.1)
    assert (inputs == 0).mean() > 0.98 and shares.mean(1).min() > 0.95


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
