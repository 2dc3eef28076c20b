from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from torchrl_l1.control import L1Config
from torchrl_l1.dynamics import EnsembleDynamics, fit_dynamics
from torchrl_l1.dynamics.heads import GaussianHead
from torchrl_l1.dynamics.residuals import (
    Residuals,
    calibrate_filter,
    shrunk_covariance,
    stretches,
)
from torchrl_l1.dynamics.validation import one_step_residuals


def test_many_residuals_have_the_covariance_that_they_were_drawn_from():
    rng = np.random.default_rng(0)
    factor = rng.normal(size=(4, 4)) * np.array([[0.01], [0.1], [1.0], [3.0]])
    rows = torch.as_tensor(rng.normal(size=(20_000, 4)) @ factor.T)
    found = shrunk_covariance(rows).numpy()
    expected = factor @ factor.T
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=0.04)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(1, 30),
    n=st.integers(1, 12),
    idle=st.integers(0, 3),
    scale=st.floats(1e-4, 1e4),
)
def test_the_covariance_is_positive_definite_whatever_the_residuals(seed, count, n, idle, scale):
    generator = torch.Generator().manual_seed(seed)
    rows = scale * torch.randn(count, n, generator=generator)
    rows[:, : min(idle, n)] = 0.0
    covariance = shrunk_covariance(rows)
    assert covariance.isfinite().all() and torch.linalg.cholesky_ex(covariance).info == 0
    torch.testing.assert_close(covariance, covariance.T)


def test_correlations_of_few_residuals_are_shrunk_as_schaefer_and_strimmer_do():
    rows = np.random.default_rng(0).normal(size=(8, 4)) @ np.array(
        [[1.0, 0.8, 0.0, 0.0], [0.0, 0.6, 0.0, 0.5], [0.0, 0.0, 3.0, 0.0], [0.0, 0.0, 0.0, 0.1]]
    )
    deviation = np.sqrt((rows**2).mean(0))
    products = np.einsum("ki,kj->kij", rows / deviation, rows / deviation)
    correlation = products.mean(0)
    uncertainty = products.var(0, ddof=1) / 8  # of each correlation
    off = ~np.eye(4, dtype=bool)
    intensity = uncertainty[off].sum() / (correlation[off] ** 2).sum()
    assert 0.1 < intensity < 0.9
    expected = np.where(off, (1 - intensity) * correlation, 1.0) * np.outer(deviation, deviation)
    np.testing.assert_allclose(shrunk_covariance(torch.as_tensor(rows)), expected)


def test_the_covariance_does_not_depend_on_the_units_of_the_states():
    generator = torch.Generator().manual_seed(0)
    rows = 0.1 * torch.randn(1000, 4, generator=generator)
    change = torch.randn(1000, 4, generator=generator)
    rows[:, 3] = 0.0  # known exactly
    units = torch.tensor([1e3, 1e3, 1e-3, 1e-4])
    expected = shrunk_covariance(rows, change)
    np.testing.assert_allclose(expected.diag(), [0.01, 0.01, 0.01, 1e-6], rtol=0.15)
    found = shrunk_covariance(rows * units, change * units)
    torch.testing.assert_close(found / torch.outer(units, units), expected)
    # A state that stays as it is has no unit of its own.
    change[:, 3] = 0.0
    assert shrunk_covariance(rows, change)[3, 3].item() == pytest.approx(1e-8, rel=0.15)


def test_fits_and_calibrations_measure_small_units_as_well_as_large_ones():
    units = torch.tensor([1e3, 1e3, 1e-2])
    data = episodes([20] * 8)
    seen, following = data["observation"] * units, data["next", "observation"] * units
    data["observation"], data["next", "observation"] = seen, following

    def in_units(observation, action):
        change, jacobian = known(observation, action)
        return change * units, jacobian * units.unsqueeze(-1)

    residuals = Residuals(3)
    config = L1Config.robust(0.05, action_low=-1.0, action_high=1.0)
    calibrate_filter(residuals, in_units, data, config)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the model is too poor")
        model = fit_dynamics(data, hidden=(8,), members=2, max_epochs=2, batch_size=64)
    change = (following - seen).square().mean(0)
    for measured in (residuals, model.residuals):
        assert (measured.covariance.diag() < 3 * change).all()


def test_a_constant_error_counts():
    assert shrunk_covariance(torch.full((10, 1), 2.0)).item() == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("residual", "words"),
    [
        (torch.zeros(0, 3), "at least 1"),
        (torch.zeros(5, 2), r"\(N, 3\)"),
        (torch.full((5, 3), torch.nan), "not finite"),
    ],
)
def test_residuals_that_say_nothing_are_refused(residual, words):
    residuals = Residuals(3)
    with pytest.raises(ValueError, match=words):
        residuals.measure(residual)
    assert not residuals.measured and torch.equal(residuals.covariance, torch.eye(3))


def test_older_checkpoints_load_and_newer_ones_keep_what_was_measured():
    torch.manual_seed(0)
    model = EnsembleDynamics(3, 1, members=2, hidden=(4,))
    model.residuals.measure(torch.randn(50, 3))
    state = model.state_dict()
    copy = EnsembleDynamics(3, 1, members=2, hidden=(4,))
    copy.load_state_dict(state)
    assert copy.residuals.measured
    assert torch.equal(copy.residuals.covariance, model.residuals.covariance)
    older = {key: value for key, value in state.items() if not key.startswith("residuals.")}
    copy.load_state_dict(older)
    assert not copy.residuals.measured


def test_sources_of_the_covariance_add_up():
    torch.manual_seed(1)
    model = EnsembleDynamics(3, 2, members=4, hidden=(8,), head=GaussianHead(3))
    model.set_elites([0, 2, 3])
    model.residuals.measure(torch.randn(200, 3))
    x, u = torch.randn(6, 3), torch.randn(6, 2)
    known = model.residual_covariance(x, u)
    heads, apart, total = (
        model.residual_covariance(x, u, source) for source in ("heads", "disagreement", "sum")
    )
    torch.testing.assert_close(total, heads + apart + (1 - 0.02) * known)
    changes = model.member_changes(x, u)[[0, 2, 3]]
    expected = torch.stack([torch.cov(changes[:, row].T) for row in range(6)])
    torch.testing.assert_close(apart - 0.01 * known, expected, atol=1e-6, rtol=1e-4)
    assert torch.linalg.cholesky_ex(apart).info.eq(0).all()
    with pytest.raises(ValueError, match="source"):
        model.residual_covariance(x, u, "guess")


def test_one_step_residuals_are_what_the_mean_misses():
    torch.manual_seed(2)
    model = EnsembleDynamics(3, 1, members=2, hidden=(4,))
    x, u, missed = torch.randn(7, 3), torch.randn(7, 1), torch.randn(7, 3)
    with torch.no_grad():
        following = x + model.mean_change(x, u) + missed
    data = TensorDict(
        {"observation": x, "action": u, "next": {"observation": following}}, batch_size=[7]
    )
    torch.testing.assert_close(one_step_residuals(model, data, chunk=3), missed)


def episodes(lengths: list[int], *, seed: int = 0) -> TensorDict:
    """Transitions of a noisy integrator, one episode after the other ``[N]``."""
    generator = torch.Generator().manual_seed(seed)
    parts = []
    for length in lengths:
        action = torch.randn(length, 1, generator=generator)
        change = 0.1 * action + 0.01 * torch.randn(length, 1, generator=generator)
        states = torch.cat([torch.randn(1, 1, generator=generator), change]).cumsum(0)
        parts.append(
            TensorDict(
                {
                    "observation": states[:-1],
                    "action": action,
                    "next": {"observation": states[1:]},
                },
                batch_size=[length],
            )
        )
    return torch.cat(parts)


def known(observation, action):
    """Value and Jacobian of what :func:`episodes` does, but for its noise."""
    return 0.1 * action, torch.full((*action.shape, 1), 0.1)


def test_stretches_lie_within_episodes_and_are_the_last_ones():
    data = episodes([250, 99, 30, 410])
    rows = stretches(data)
    assert rows.tolist() == [
        list(range(first, first + 100)) for first in (0, 100, 379, 479, 579, 679)
    ]
    many = stretches(episodes([1000] * 5))
    assert many.shape == (32, 100) and many[-1, -1] == 4999
    assert stretches(episodes([60, 60, 45])).tolist() == [list(range(60)), list(range(60, 120))]
    assert stretches(episodes([19, 5, 12])) is None and stretches(data[:1]) is None


def test_calibration_sets_what_the_controller_is_told():
    residuals = Residuals(1)
    residuals.measure(torch.tensor([[0.01], [-0.01]]))
    config = L1Config.robust(0.05, action_low=-1.0, action_high=1.0)
    found = calibrate_filter(residuals, known, episodes([400] * 8), config)
    assert residuals.inflation == found.inflation == 1
    assert residuals.process_noise == pytest.approx(found.process_noise)
    # Too short: nothing changes.
    assert calibrate_filter(residuals, known, episodes([10]), config) is None
    assert residuals.inflation == 1


def test_a_missing_force_inflates_the_covariance():
    def lacking(observation, action):
        # Knows nothing of what pulls the state back to zero for many steps.
        return torch.zeros_like(action), torch.full((*action.shape, 1), 0.1)

    data = episodes([400] * 8)
    slow = torch.sin(torch.arange(data.shape[0] + 1) / 40).unsqueeze(-1)
    data["observation"], data["next", "observation"] = slow[:-1], slow[1:]
    residuals = Residuals(1)
    residuals.measure(slow[1:] - slow[:-1])
    config = L1Config.robust(0.05, action_low=-1.0, action_high=1.0)
    found = calibrate_filter(residuals, lacking, data, config)
    assert found.inflation >= 8


def test_a_model_of_ones_own_data_is_calibrated_with_the_range_of_its_actions():
    data = episodes([200] * 4).double()
    settings = {"hidden": (8,), "members": 2, "max_epochs": 2, "batch_size": 64}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the model is too poor")
        model = fit_dynamics(data, **settings)
        short = fit_dynamics(episodes([15] * 40), **settings)
    found = model.residuals.inflation.clone(), model.residuals.process_noise.clone()
    bounds = {"action_low": data["action"].amin(0), "action_high": data["action"].amax(0)}
    known = L1Config.robust(0.05, **bounds)
    expected = calibrate_filter(model.residuals, model.value_and_jacobian, data, known)
    assert model.residuals.calibrated
    assert found == pytest.approx((expected.inflation, expected.process_noise))
    assert not short.residuals.calibrated  # no episode has 20 steps


def test_a_table_in_double_precision_calibrates_a_model_in_single_precision():
    torch.manual_seed(0)
    model, data = EnsembleDynamics(1, 1, members=2, hidden=(4,)), episodes([400] * 2)
    model.residuals.measure(one_step_residuals(model, data))
    config = L1Config.robust(0.05, action_low=-1.0, action_high=1.0)
    found = [
        calibrate_filter(model.residuals, model.value_and_jacobian, rows, config)
        for rows in (data.float(), data.float().double())
    ]
    assert found[0] == found[1] is not None


def test_calibration_is_of_the_covariance_that_the_controller_is_told_to_take():
    def honest(observation, action, source):
        assert source == "sum"
        return torch.full((*observation.shape, 1), 1e-4)

    residuals, data = Residuals(1), episodes([400] * 8)
    residuals.measure(torch.tensor([[0.0025], [-0.0025]]))  # a quarter of the noise
    measured, told = (
        L1Config.robust(0.05, covariance=source, action_low=-1.0, action_high=1.0)
        for source in ("residuals", "sum")
    )
    assert calibrate_filter(residuals, known, data, measured).inflation > 4
    found = calibrate_filter(residuals, known, data, told, residual_covariance=honest)
    assert found.inflation == residuals.inflation == 1
    with pytest.raises(ValueError, match=r"residual_covariance=model\.residual_covariance"):
        calibrate_filter(residuals, known, data, told)


def test_calibration_measures_the_residuals_that_no_fit_has_measured():
    residuals, data = Residuals(1), episodes([400] * 8)
    config = L1Config.robust(0.05, action_low=-1.0, action_high=1.0)
    found = calibrate_filter(residuals, known, data, config)
    assert residuals.measured and residuals.calibrated
    assert residuals.covariance.sqrt().item() == pytest.approx(0.01, rel=0.05)
    assert found.inflation == 1


def test_residuals_measured_anew_are_those_of_a_model_that_nobody_has_calibrated():
    residuals, fresh = Residuals(1), Residuals(1)
    data = torch.tensor([[0.01], [-0.01]])
    fresh.measure(data)
    residuals.inflation.fill_(8.0)
    residuals.process_noise.fill_(0.001)
    residuals.calibrated.fill_(True)
    residuals.measure(data)
    assert dict(residuals.named_buffers()) == dict(fresh.named_buffers())
