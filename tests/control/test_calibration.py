from __future__ import annotations

import math

import pytest
import torch

from torchrl_l1.control import L1Config, ResidualStatistics, calibrate
from torchrl_l1.control.calibration import replay

BOUNDS = {"action_low": -1.0, "action_high": 1.0}


def autocorrelated(sequences: int, steps: int, n: int, correlation: float) -> torch.Tensor:
    """Normal numbers of unit variance, each correlated so with the one before ``(S, T, n)``."""
    generator = torch.Generator().manual_seed(0)
    white = torch.randn(sequences, steps, n, generator=generator)
    rows = [white[:, 0]]
    for t in range(1, steps):
        rows.append(correlation * rows[-1] + math.sqrt(1 - correlation**2) * white[:, t])
    return torch.stack(rows, 1)


def test_a_replay_is_the_regression_of_all_residuals_so_far():
    sequences, steps, n, m = 3, 25, 4, 2
    generator = torch.Generator().manual_seed(1)
    # Small, so that no estimate is beyond the bounds of the action.
    residual = 0.01 * torch.randn(sequences, steps, n, generator=generator, dtype=torch.float64)
    jacobian = torch.randn(sequences, steps, n, m, generator=generator, dtype=torch.float64)
    deviation = torch.tensor([0.1, 1.0, 3.0, 0.5], dtype=torch.float64)
    config = L1Config.robust(
        0.02, process_noise=0.0, inflation=2.0, forgetting=1.0, project=False, **BOUNDS
    )
    statistics = ResidualStatistics(torch.diag(deviation.square()))
    action = residual.new_zeros(sequences, steps, m)
    _, mean, variance = replay(config, residual, jacobian, action, statistics)
    precision = torch.diag(1 / (2 * deviation.square()))
    # Ridge regression on the first k residuals, whose penalty is the prior's.
    for k in (1, 7, steps):
        a, b = jacobian[:, :k].flatten(1, 2), residual[:, :k].flatten(1, 2)
        weights = precision.diagonal().repeat(k)
        information = a.mT @ (weights[:, None] * a) + torch.eye(m) / config.initial_deviation**2
        covariance = torch.linalg.inv(information)
        expected = (covariance @ a.mT @ (weights * b).unsqueeze(-1)).squeeze(-1)
        torch.testing.assert_close(mean[0, :, k - 1], expected)
        torch.testing.assert_close(variance[0, :, k - 1], covariance.diagonal(dim1=-2, dim2=-1))


@pytest.mark.parametrize(
    ("correlation", "least", "most"), [(0.0, 1, 2), (0.5, 2, 4), (0.9, 16, 32)]
)
def test_autocorrelated_residuals_are_inflated_as_the_variance_of_their_mean(
    correlation, least, most
):
    # The variance of the mean of an autoregressive process is (1 + c) / (1 - c) times that of
    # independent numbers: 1, 3 and 19. Powers of two are tried.
    residual = 0.1 * autocorrelated(400, 200, 1, correlation)
    jacobian = torch.full((400, 200, 1, 1), 0.5)
    config = L1Config.robust(0.02, forgetting=1.0, **BOUNDS)
    found = calibrate(config, residual, jacobian, 0.01 * torch.eye(1), process_noises=(1e-5,))
    assert least <= found.inflation <= most
    by_inflation = {row["inflation"]: row["consistency"] for row in found.table}
    assert by_inflation[found.inflation] <= 1
    assert list(by_inflation.values()) == sorted(by_inflation.values(), reverse=True)


def test_the_process_noise_is_as_large_as_the_residuals_allow():
    residual = autocorrelated(32, 100, 2, 0.0)
    jacobian = torch.ones(32, 100, 2, 1)
    config = L1Config.robust(0.02, **BOUNDS)
    noise = {}
    for scale in (0.01, 1.0):
        noise[scale] = calibrate(
            config,
            scale * residual,
            jacobian,
            scale**2 * torch.eye(2),
            process_noises=(0.001, 0.1),
        ).process_noise
    assert noise[0.01] > noise[1.0]


def test_candidates_do_not_mix():
    residual = 0.1 * autocorrelated(4, 30, 3, 0.5)
    jacobian = torch.randn(4, 30, 3, 2, generator=torch.Generator().manual_seed(2))
    config = L1Config.robust(0.02, **BOUNDS)
    covariance = 0.01 * torch.eye(3)
    several = calibrate(config, residual, jacobian, covariance).table
    for row in several[::5]:
        alone = calibrate(
            config,
            residual,
            jacobian,
            covariance,
            inflations=[row["inflation"]],
            process_noises=[row["process_noise"]],
        )
        assert alone.table[0] == pytest.approx(row, rel=1e-4)


def test_the_table_counts_what_the_record_of_forecasts_takes_off_the_input():
    # A push that turns every fifteen steps: many forecasts have the wrong sign.
    push = 0.6 * (2.0 * (torch.arange(60).reshape(-1, 1) // 15 % 2) - 1)
    residual = push + 0.1 * autocorrelated(4, 60, 1, 0.0)
    recorded, whole = (
        calibrate(
            L1Config.robust(0.02, skill_forgetting=forgetting, **BOUNDS),
            residual,
            torch.ones(4, 60, 1, 1),
            0.01 * torch.eye(1),
            inflations=[1.0],
        ).table
        for forgetting in (0.99, 1.0)
    )
    for one, other in zip(recorded, whole, strict=True):
        assert one["consistency"] == pytest.approx(other["consistency"])
        assert one["error"] < 0.98 * other["error"]


@pytest.mark.parametrize(
    ("residual", "jacobian", "words"),
    [
        (torch.zeros(2, 19, 1), torch.ones(2, 19, 1, 1), "at least 20 steps"),
        (torch.zeros(2, 30, 2), torch.ones(2, 30, 1, 1), "as the Jacobian"),
        (torch.full((2, 30, 1), torch.nan), torch.ones(2, 30, 1, 1), "finite"),
    ],
)
def test_what_cannot_be_calibrated_is_refused(residual, jacobian, words):
    with pytest.raises(ValueError, match=words):
        calibrate(L1Config.robust(0.02), residual, jacobian, torch.eye(1))


@pytest.mark.parametrize(
    "covariance", [torch.zeros(2, 2), torch.diag(torch.tensor([1.0, 0.0])), torch.ones(2)]
)
def test_a_covariance_that_is_none_is_refused(covariance):
    residual, jacobian = torch.ones(2, 30, 2), torch.ones(2, 30, 2, 1)
    with pytest.raises(ValueError, match=r"positive definite covariance of the shape \(2, 2\)"):
        calibrate(L1Config.robust(0.02, **BOUNDS), residual, jacobian, covariance)


def test_a_covariance_of_each_step_is_that_of_its_residual():
    generator = torch.Generator().manual_seed(3)
    residual = 0.1 * autocorrelated(4, 30, 3, 0.5)
    jacobian = torch.randn(4, 30, 3, 2, generator=generator)
    # In other units at each step, all of it says the same.
    units = 0.5 + torch.rand(4, 30, 1, generator=generator)
    config, covariance = L1Config.robust(0.02, **BOUNDS), 0.01 * torch.eye(3)
    expected = calibrate(config, residual, jacobian, covariance).table
    varying = units[..., None].square() * covariance
    found = calibrate(config, units * residual, units[..., None] * jacobian, varying).table
    for one, other in zip(found, expected, strict=True):
        assert one == pytest.approx(other, rel=1e-3)


def test_the_smallest_inflation_is_found_in_any_order():
    residual, jacobian = 0.1 * autocorrelated(8, 40, 1, 0.0), torch.full((8, 40, 1, 1), 0.5)
    config = L1Config.robust(0.02, **BOUNDS)
    found = [
        calibrate(config, residual, jacobian, 0.01 * torch.eye(1), inflations=tried).inflation
        for tried in ((1.0, 4.0, 16.0), (16.0, 1.0, 4.0))
    ]
    assert found[0] == found[1]


@pytest.mark.parametrize("action", [0.0, 0.8, 1.0])
def test_of_a_disturbance_put_in_at_a_bound_only_what_comes_through_is_found(action):
    config = L1Config.robust(0.02, initial_deviation=0.5, forgetting=1.0, dead_zone=0.0, **BOUNDS)
    errors = []
    for executed in (action, -action):
        # One stretch, disturbed from its reset on: outwards under one of the two, inwards at the
        # other. The model misses nothing.
        found = calibrate(
            config,
            torch.zeros(1, 40, 1),
            torch.full((1, 40, 1, 1), 0.5),
            1e-8 * torch.eye(1),
            action=torch.full((1, 40, 1), executed),
            inflations=[1.0],
            process_noises=[0.001],
        )
        errors.append(found.table[0]["error"])
    cut_off = max(0.0, 0.5 - (1.0 - action))
    # Half of the replays have no disturbance, and none that is not there is found.
    assert sorted(errors) == pytest.approx([0.0, cut_off * math.sqrt(0.5)], abs=2e-3)


def test_a_replay_knows_what_was_executed():
    config = L1Config.robust(
        0.02, initial_deviation=0.5, process_noise=0.1, inflation=1.0, forgetting=1.0, **BOUNDS
    )
    # At either bound the same push, as of a load: outwards it may be one, and says nothing. What
    # has been found is cut off at a bound, and no less there for it.
    action = torch.tensor([[1.0] * 5, [-1.0] * 5, [0.0, 0.0, 1.0, 1.0, 1.0]]).unsqueeze(-1)
    push = 0.5 * torch.tensor([[0.3] * 5, [0.3] * 5, [0.3, 0.3, 0.0, 0.0, 0.0]]).unsqueeze(-1)
    statistics = ResidualStatistics(1e-8 * torch.eye(1))
    _, mean, variance = replay(config, push, torch.full((3, 5, 1, 1), 0.5), action, statistics)
    assert not mean[0, 0].any()
    walked = 0.5**2 + 0.1**2 * torch.arange(1.0, 6.0)
    torch.testing.assert_close(variance[0, 0, :, 0], walked)
    torch.testing.assert_close(mean[0, 1:], torch.full((2, 5, 1), 0.3), atol=1e-4, rtol=0)
