"""Closed loop on known plants: what the controller is for."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from torchrl_l1.control import L1Config, init, step

STABLE = np.array([[-0.5, 1.0, 0.0], [0.0, -1.0, 0.5], [0.2, 0.0, -0.8]])
H = np.array([[0.3], [1.0], [-0.4]])


def simulate(
    config: L1Config,
    disturbance: Callable[[float], np.ndarray],
    steps: int,
    u_rl: float = 0.2,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Plant x' = x + T (A x + h u) + T d(t), known to the controller but for d (units / s).

    Returns the adaptive input, the matched estimate and norms of the unmatched and matched
    estimates, one row per step.
    """
    dt = config.dt
    jac = torch.as_tensor(dt * H)
    state = init([], 3, 1, dtype=torch.float64)
    x = torch.zeros(3, dtype=torch.float64)
    rows = []
    for t in range(steps):
        drift = torch.as_tensor(dt * STABLE @ x.numpy())
        action = torch.tensor([u_rl], dtype=torch.float64)
        u, state, diagnostics = step(config, state, x, action, drift, jac)
        rows.append(
            [
                u.item() - u_rl,
                state.sigma_m.item(),
                diagnostics.unmatched.item(),
                diagnostics.matched.item(),
            ]
        )
        x = x + drift + jac @ u + dt * torch.as_tensor(disturbance(t * dt))
    return tuple(np.array(rows).T)


@pytest.mark.parametrize(("dt", "share"), [(0.04, 0.961), (0.008, 0.992), (0.05, 0.951)])
@pytest.mark.parametrize("preset", [L1Config.paper, L1Config.reference])
def test_constant_matched_disturbance_is_cancelled(preset, dt, share):
    d = 0.7
    u_a, sigma_m, unmatched, _ = simulate(preset(dt), lambda t: d * H[:, 0], steps=120)
    assert u_a[-1] == pytest.approx(-share * d, abs=5e-4 * d)
    assert sigma_m[-1] == pytest.approx(share * d, abs=5e-4 * d)
    assert unmatched[-1] < 1e-9


def test_unmatched_disturbance_is_estimated_and_not_acted_on():
    direction = np.array([1.0, 0.1, 1.0])
    direction -= H[:, 0] * (direction @ H[:, 0]) / (H[:, 0] @ H[:, 0])
    u_a, sigma_m, unmatched, matched = simulate(L1Config(0.04), lambda t: direction, steps=120)
    assert np.abs(u_a).max() < 1e-12 and np.abs(sigma_m).max() < 1e-12
    assert unmatched[-1] == pytest.approx(0.961 * np.linalg.norm(direction), rel=1e-3)
    assert matched[-1] < 1e-12


def test_residual_of_a_slow_disturbance_is_of_the_order_of_the_sampling_time():
    """Theorem 1: O(T_s). The cutoff 0.35 / dt makes the filter's lag of that order too."""

    def residuals(dt: float) -> tuple[float, float]:
        def d(t: float) -> float:
            return 0.5 + 0.3 * np.sin(0.8 * t)

        steps = round(16 / dt)
        u_a, sigma_m, _, _ = simulate(L1Config(dt), lambda t: d(t) * H[:, 0], steps)
        truth = np.array([d(t * dt) for t in range(steps)])
        settled = slice(steps // 2, None)
        return np.abs(sigma_m - truth)[settled].max(), np.abs(u_a + truth)[settled].max()

    errors = np.array([residuals(dt) for dt in (0.08, 0.04, 0.02, 0.01)])
    ratios = errors[:-1] / errors[1:]
    assert (ratios > 1.8).all() and (ratios < 2.2).all(), errors


def test_without_disturbance_nothing_happens():
    u_a, sigma_m, unmatched, matched = simulate(L1Config(0.04), lambda t: np.zeros(3), steps=50)
    assert max(np.abs(v).max() for v in (u_a, sigma_m, unmatched, matched)) < 1e-12
