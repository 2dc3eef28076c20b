from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from torchrl_l1.control import ActionJacobian, L1Config, L1State, ResidualStatistics, init, step
from torchrl_l1.control.affine import augment, make_step
from torchrl_l1.control.kalman import (
    Posterior,
    doubt,
    measurement_update,
    noise_ratio,
    significant,
    summary,
)
from torchrl_l1.control.kalman_law import Reach
from torchrl_l1.control.least_squares import solve_matched, whitened

BOUNDS = {"action_low": -1.0, "action_high": 1.0}


def random_covariance(rng: np.random.Generator, n: int) -> np.ndarray:
    """Standard deviations over three orders of magnitude, correlated."""
    basis = np.linalg.qr(rng.normal(size=(n, n)))[0]
    correlated = basis @ np.diag(rng.uniform(0.3, 1.0, n)) @ basis.T
    scale = 10.0 ** rng.uniform(-2, 1, n)
    return correlated * np.outer(scale, scale)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 9), excess=st.integers(0, 6))
def test_weighted_least_squares_has_the_textbook_solution(seed, n, excess):
    m = max(1, n - excess)
    rng = np.random.default_rng(seed)
    covariance, jacobian = random_covariance(rng, n), rng.normal(size=(n, m))
    residual = rng.normal(size=n)
    assume(np.linalg.cond(np.linalg.solve(np.linalg.cholesky(covariance), jacobian)) < 1e4)
    columns, white = whitened(*map(torch.as_tensor, (covariance, jacobian, residual[:, None])))
    found, flagged = solve_matched(columns, white.squeeze(-1))
    assert not flagged
    information = jacobian.T @ np.linalg.solve(covariance, jacobian)
    score = jacobian.T @ np.linalg.solve(covariance, residual)
    np.testing.assert_allclose(information @ found.numpy(), score, rtol=1e-5, atol=1e-5)


def test_a_batch_of_covariances_is_that_of_its_rows():
    rng = np.random.default_rng(0)
    covariance = torch.as_tensor(np.stack([random_covariance(rng, 4) for _ in range(3)]))
    columns = torch.as_tensor(rng.normal(size=(3, 4, 2)))
    together = whitened(covariance, columns)[0]
    for row in range(3):
        torch.testing.assert_close(together[row], whitened(covariance[row], columns[row])[0])


def test_a_covariance_that_is_not_positive_definite_gives_nothing_finite():
    assert not whitened(-torch.eye(2), torch.ones(2, 1))[0].isfinite().any()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 8), m=st.integers(1, 5))
def test_the_update_is_that_of_kalman(seed, n, m):
    rng = np.random.default_rng(seed)
    prior, jacobian = random_covariance(rng, m), rng.normal(size=(n, m))
    mean, innovation = rng.normal(size=m), rng.normal(size=n)
    found = measurement_update(
        Posterior(torch.as_tensor(mean), torch.as_tensor(prior)),
        torch.as_tensor(jacobian),
        torch.as_tensor(innovation),
    )
    gain = prior @ jacobian.T @ np.linalg.inv(jacobian @ prior @ jacobian.T + np.eye(n))
    np.testing.assert_allclose(found.mean, mean + gain @ innovation, rtol=1e-6, atol=1e-7)
    left = np.eye(m) - gain @ jacobian
    joseph = left @ prior @ left.T + gain @ gain.T
    np.testing.assert_allclose(found.covariance, joseph, rtol=1e-6, atol=1e-8)


def test_single_precision_keeps_the_posterior_positive():
    torch.manual_seed(0)
    posterior = Posterior(torch.zeros(64, 3), torch.eye(3).expand(64, 3, 3) * 0.09)
    # One direction is seen perfectly, another never.
    jacobian = torch.tensor([[1e3, 0.0, 0.0], [0.0, 1.0, 0.0]]).expand(64, 2, 3)
    for _ in range(2000):
        posterior = measurement_update(posterior, jacobian, torch.randn(64, 2))
    assert torch.linalg.eigvalsh(posterior.covariance).min() > -1e-9
    assert posterior.mean.isfinite().all()
    torch.testing.assert_close(
        posterior.covariance[:, 2, 2], torch.full((64,), 0.09), rtol=0.01, atol=0
    )


def simulate(
    config: L1Config,
    residuals: ResidualStatistics,
    jacobian: torch.Tensor,
    disturbance: torch.Tensor,
    noise: torch.Tensor,
) -> tuple[L1State, torch.Tensor, torch.Tensor]:
    """The loop on ``x + J (u + d) + noise``: last state, estimates and inputs ``[T, N, m]``."""
    steps, batch, n = noise.shape
    m = jacobian.shape[-1]
    state = init([batch], n, m, config, dtype=noise.dtype)
    x, zero = noise.new_zeros(batch, n), noise.new_zeros(batch, n)
    matrix = jacobian.expand(batch, n, m)
    estimates, inputs = [], []
    for t in range(steps):
        u, state, _ = step(
            config, state, x, noise.new_zeros(batch, m), zero, matrix, None, residuals
        )
        x = x + ((u + disturbance) @ jacobian.T) + noise[t]
        estimates.append(state.sigma_m)
        inputs.append(u)
    return state, torch.stack(estimates), torch.stack(inputs)


def test_the_posterior_settles_at_the_solution_of_riccatis_equation():
    rng = np.random.default_rng(1)
    covariance, jacobian, q = random_covariance(rng, 5), rng.normal(size=(5, 2)), 0.03
    config = L1Config.robust(
        0.05, process_noise=q, inflation=1.0, forgetting=1.0, dead_zone=0.0, **BOUNDS
    )
    state, *_ = simulate(
        config,
        ResidualStatistics(torch.as_tensor(covariance)),
        torch.as_tensor(jacobian),
        torch.zeros(1, 2, dtype=torch.float64),
        torch.zeros(3000, 1, 5, dtype=torch.float64),
    )
    prior = scipy.linalg.solve_discrete_are(np.eye(2), jacobian.T, q**2 * np.eye(2), covariance)
    gain = prior @ jacobian.T @ np.linalg.inv(jacobian @ prior @ jacobian.T + covariance)
    posterior = prior - gain @ jacobian @ prior
    found = state.covariance.reshape(2, 2).numpy()
    np.testing.assert_allclose(found, posterior, rtol=1e-6)
    # The gain that the filter has is that of its posterior.
    np.testing.assert_allclose(found @ jacobian.T @ np.linalg.inv(covariance), gain, rtol=1e-6)


def test_the_estimate_reaches_the_cramer_rao_bound_where_least_squares_does_not():
    generator = torch.Generator().manual_seed(0)
    batch, steps, m = 400, 50, 2
    deviation = torch.tensor([0.004, 0.05, 0.6, 1.2], dtype=torch.float64)
    covariance = torch.diag(deviation.square())
    jacobian = torch.randn(4, m, generator=generator, dtype=torch.float64)
    noise = torch.randn(steps, batch, 4, generator=generator, dtype=torch.float64) * deviation
    disturbance = torch.tensor([0.3, -0.2], dtype=torch.float64).expand(batch, m)
    # Without process noise and with a wide prior the filter is the estimator of a constant.
    shared = {"process_noise": 0.0, "inflation": 1.0, "forgetting": 1.0, "dead_zone": 0.0}
    config = L1Config.robust(0.05, initial_deviation=100.0, **shared)
    statistics = ResidualStatistics(covariance)
    _, weighted, _ = simulate(config, statistics, jacobian, disturbance, noise)
    _, ordinary, _ = simulate(
        L1Config.robust(0.05, initial_deviation=100.0, estimator="least_squares", **shared),
        statistics, jacobian, disturbance, noise,
    )  # fmt: skip
    bound = torch.linalg.inv(jacobian.T @ torch.linalg.inv(covariance) @ jacobian) / (steps - 1)
    for entry in range(m):
        error = weighted[-1, :, entry] - disturbance[:, entry]
        ratio = error.square().mean() / bound[entry, entry]
        # 400 squares scatter by seven per cent.
        assert 0.8 < ratio < 1.2
        plain = ordinary[-1, :, entry] - disturbance[:, entry]
        assert plain.square().mean() > 2 * bound[entry, entry]


@pytest.mark.parametrize("scale", [1e-4, 3e3, 1e6])
def test_the_units_of_an_action_do_not_matter(scale):
    generator, found = torch.Generator().manual_seed(1), []
    noise = 0.05 * torch.randn(100, 20, 3, generator=generator)
    jacobian = torch.tensor([[0.1, 0.02], [0.05, -0.1], [0.0, 0.1]])
    for unit in (1.0, scale):
        units = torch.tensor([1.0, unit])
        bounds = {"action_low": (-1.0, -unit), "action_high": (1.0, unit)}
        config = L1Config.robust(0.05, process_noise=0.003, **bounds)
        state, _, inputs = simulate(
            config,
            ResidualStatistics(0.05**2 * torch.eye(3)),
            jacobian / units,
            torch.tensor([0.3, -0.4]) * units,
            noise,
        )
        deviation = state.covariance.unflatten(-1, (2, 2)).diagonal(dim1=-2, dim2=-1).sqrt()
        found.append(torch.stack([inputs[-1] / units, deviation / units]))
    torch.testing.assert_close(*found, atol=1e-3, rtol=1e-3)
    assert found[0][0].abs().min() > 0.1


def test_nothing_is_done_within_the_dead_zone_and_everything_far_beyond():
    posterior = Posterior(torch.tensor([0.19, -0.19, 2.0, 0.0]), 0.01 * torch.eye(4))
    acted = significant(posterior, 2.0)
    torch.testing.assert_close(acted, torch.tensor([0.0, 0.0, 1.98, 0.0]))
    assert torch.equal(significant(posterior, 0.0), posterior.mean)


def test_what_is_left_unexplained_is_doubted_by_hand():
    columns, innovation = torch.tensor([[1.0], [0.0]]), torch.tensor([0.0, 6.0])
    assert doubt(columns, innovation, torch.zeros(1)).item() == 18.0
    assert doubt(columns, torch.tensor([6.0, 1.0]), torch.tensor([6.0])).item() == 1.0


def test_a_posterior_is_summed_up_by_hand():
    posterior = Posterior(torch.tensor([1.0, -3.0]), torch.tensor([[0.04, 0.05], [0.05, 0.25]]))
    norm, significance = summary(posterior)
    assert norm.item() == pytest.approx(0.29**0.5)
    assert significance.item() == pytest.approx(6.0)


def test_a_bias_is_cancelled_and_its_absence_left_alone():
    generator = torch.Generator().manual_seed(3)
    deviation = torch.tensor([0.01, 0.1, 1.0])
    jacobian = torch.tensor([[0.02, 0.0], [0.1, 0.1], [0.5, -0.5]])
    noise = torch.randn(300, 200, 3, generator=generator) * deviation
    config = L1Config.robust(0.05, inflation=1.0, process_noise=0.003, **BOUNDS)
    statistics = ResidualStatistics(torch.diag(deviation.square()))
    bias = torch.tensor([0.3, -0.3]).expand(200, 2)
    _, _, inputs = simulate(config, statistics, jacobian, bias, noise)
    torch.testing.assert_close(inputs[-1].mean(0), -bias[0], atol=0.1, rtol=0)
    _, _, idle = simulate(config, statistics, jacobian, torch.zeros(200, 2), noise)
    assert (idle == 0).float().mean() > 0.85


def test_a_sensor_that_becomes_noisy_is_noticed_and_a_disturbance_is_not_taken_for_noise():
    generator = torch.Generator().manual_seed(4)
    deviation = torch.tensor([0.01, 0.02, 0.02, 0.02])
    jacobian = torch.tensor([[0.1], [0.05], [0.0], [0.0]])
    covariance = torch.diag(deviation.square())
    white = torch.randn(400, 100, 4, generator=generator) * deviation
    config = L1Config.robust(0.05, **BOUNDS)
    noisy = white * torch.tensor([10.0, 1.0, 1.0, 1.0])
    zero = torch.zeros(100, 1)
    state, wary, _ = simulate(config, ResidualStatistics(covariance), jacobian, zero, noisy)
    assert state.noise[:, 0].median() > 10 and state.noise[:, 1:].median() < 2
    fixed = L1Config.robust(0.05, forgetting=1.0, **BOUNDS)
    _, trusting, _ = simulate(fixed, ResidualStatistics(covariance), jacobian, zero, noisy)
    # Once it is known, its noise moves the estimate little.
    moved, followed = (one[-1] - one[-101] for one in (wary, trusting))
    assert moved.std() < 0.5 * followed.std()
    bias = torch.full((100, 1), 0.9)
    state, estimates, _ = simulate(config, ResidualStatistics(covariance), jacobian, bias, white)
    assert state.noise.median() < 2
    torch.testing.assert_close(estimates[-1].mean(), torch.tensor(0.9), atol=0.05, rtol=0)


def test_the_ratio_has_mean_one_where_the_expectation_is_right():
    generator = torch.Generator().manual_seed(5)
    covariance = torch.as_tensor(random_covariance(np.random.default_rng(2), 5)).float()
    jacobian = torch.randn(5, 2, generator=generator).expand(50_000, 5, 2)
    prior = torch.tensor([[0.09, 0.02], [0.02, 0.05]])
    disturbance = torch.randn(50_000, 2, generator=generator) @ torch.linalg.cholesky(prior).T
    noise = torch.randn(50_000, 5, generator=generator) @ torch.linalg.cholesky(covariance).T
    residual = noise + (jacobian @ disturbance.unsqueeze(-1)).squeeze(-1)
    columns, white = whitened(covariance, jacobian, residual.unsqueeze(-1))
    before = Posterior(torch.zeros(50_000, 2), prior.expand(50_000, 2, 2))
    posterior = measurement_update(before, columns, white.squeeze(-1))
    left = residual - (jacobian @ posterior.mean.unsqueeze(-1)).squeeze(-1)
    ratio = noise_ratio(covariance, jacobian, posterior, left)
    torch.testing.assert_close(ratio.mean(0), torch.ones(5), atol=0.03, rtol=0)


def model_with_residuals() -> ActionJacobian:
    class Model:
        def mean_change(self, observation, action):
            return 0.1 * observation + 0.2 * action.sin() @ torch.ones(1, 3)

        def residual_covariance(self, observation, action):
            return 0.01 * torch.eye(3)

    return ActionJacobian(Model())


def test_the_model_is_expanded_at_the_executed_input():
    config = L1Config.robust(0.05, **BOUNDS)
    state = init([5], 3, 1, config)
    torch.manual_seed(0)
    for t in range(4):
        x, u_rl = torch.randn(5, 3), torch.rand(5, 1)
        u, state, diagnostics = augment(config, model_with_residuals(), state, x, u_rl)
        assert torch.equal(state.u_bar, u)
        expected = x + 0.1 * x + 0.2 * u.sin()
        jacobian = 0.2 * u.cos().expand(5, 3)
        torch.testing.assert_close(state.jacobian, jacobian)
        torch.testing.assert_close(state.x_hat, expected + jacobian * state.sigma_m)
        assert (diagnostics.affinization_error == 0).all()
        assert state.n_switch.unique().tolist() == [t]


def test_compiled_is_eager():
    config = L1Config.robust(0.05, **BOUNDS)
    model = model_with_residuals()
    torch.manual_seed(1)
    inputs = [(torch.randn(4, 3), torch.rand(4, 1)) for _ in range(5)]

    def trajectory(mode):
        state, out = init([4], 3, 1, config), []
        advance = make_step(config, model, mode)
        for x, u_rl in inputs:
            u, state, _ = advance(state, x, u_rl)
            out.append(u)
        return torch.stack(out)

    torch.testing.assert_close(trajectory(True), trajectory(False), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("which", range(4))
def test_what_is_not_finite_stays_in_its_environment(which, value):
    config = L1Config.robust(0.05, **BOUNDS)
    generator = torch.Generator().manual_seed(6)

    def inputs():
        shapes = [(5, 3), (5, 2), (5, 3), (5, 3, 2)]
        return [torch.randn(*shape, generator=generator).clamp(-1, 1) for shape in shapes]

    state = init([5], 3, 2, config)
    for _ in range(3):
        _, state, _ = step(config, state, *inputs())
    good = inputs()
    bad = [tensor.clone() for tensor in good]
    bad[which][1] = value
    u_good, state_good, _ = step(config, state, *good)
    u, following, diagnostics = step(config, state, *bad)
    if which != 1 or value != float("inf"):  # an infinite action is clipped to its bound
        assert diagnostics.non_finite.squeeze(-1).tolist() == [False, True, False, False, False]
        assert not following.started[1]
    others = [0, 2, 3, 4]
    torch.testing.assert_close(u[others], u_good[others])
    for name, entry in following.entries().items():
        assert entry.isfinite().all(), name
        torch.testing.assert_close(entry[others], state_good.entries()[name][others])
    assert all(entry.isfinite().all() for entry in diagnostics)
    for _ in range(2):
        u, following, _ = step(config, following, *inputs())
    assert following.started.all() and u.isfinite().all()


@pytest.mark.parametrize(
    ("made_for", "used_with"), [(None, "residuals"), ("residuals", "sum"), ("sum", "residuals")]
)
def test_a_state_of_other_settings_is_refused(made_for, used_with):
    made = None if made_for is None else L1Config.robust(0.05, covariance=made_for)
    state = init([2], 3, 1, made)
    inputs = torch.zeros(2, 3), torch.zeros(2, 1), torch.zeros(2, 3), torch.ones(2, 3, 1)
    with pytest.raises(ValueError, match=r"other settings: make it with init\(.*config\)"):
        step(L1Config.robust(0.05, covariance=used_with), state, *inputs)


def test_residuals_of_which_nothing_is_known_are_white():
    rng, estimates = np.random.default_rng(3), []
    inputs = [
        [torch.as_tensor(rng.normal(size=shape)) for shape in ((2, 3), (2, 1), (2, 3), (2, 3, 1))]
        for _ in range(4)
    ]
    for covariance in ("residuals", "sum"):
        config = L1Config.robust(0.05, covariance=covariance)
        state = init([2], 3, 1, config, dtype=torch.float64)
        for each in inputs:
            _, state, _ = step(config, state, *each)
        estimates.append(state.sigma_m)
    torch.testing.assert_close(*estimates)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"alpha": 0.1}, "low-pass"),
        ({"cutoff": 1.0}, "low-pass"),
        ({"on_switch": "reset"}, "keeps its state at a switch"),
        ({"dead_zone": -1.0}, "dead_zone"),
        ({"inflation": 0.0}, "inflation"),
        ({"process_noise": -0.1}, "process_noise"),
        ({"initial_deviation": 0.0}, "initial_deviation"),
        ({"forgetting": 0.0}, "forgetting"),
        ({"skill_forgetting": 0.0}, "skill_forgetting"),
        ({"covariance": "none"}, "covariance"),
        ({"estimator": "other"}, "estimator"),
        ({"filter": "other"}, "filter"),
    ],
)
def test_settings_out_of_their_domain_are_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        L1Config.robust(0.05, **settings)


def test_what_lies_beyond_the_bounds_is_neither_noise_nor_news():
    config = L1Config.robust(0.05, action_low=-1.0, action_high=1.0)
    posterior = Posterior(torch.tensor([0.3, 0.3, -0.3, 0.0]), 0.01 * torch.eye(4))
    reach = Reach.of(config, torch.tensor([0.5, 0.9, 1.0, 1.0]), posterior)
    torch.testing.assert_close(reach.passed, torch.tensor([0.3, 0.1, -0.3, 0.0]))
    assert reach.within.tolist() == [True, False, True, False]
    torch.testing.assert_close(reach.deviation, torch.tensor([0.0, 0.05**0.5, 0.0, 0.1]))
    unbounded = Reach.of(L1Config.robust(0.05), torch.ones(4), posterior)
    torch.testing.assert_close(unbounded.passed, posterior.mean)
    assert unbounded.within.all() and not unbounded.deviation.any()


@pytest.mark.parametrize("cut_off", [True, False], ids=["motor command", "load"])
def test_a_disturbance_of_actuators_at_their_bounds_is_found_whether_cut_off_or_not(cut_off):
    generator = torch.Generator().manual_seed(5)
    batch, steps, n, m = 50, 400, 4, 2
    # It estimates only: input that cancels the bias keeps the sum within the bounds.
    config = L1Config.robust(0.05, action_low=-1.0, action_high=1.0, dead_zone=1e6)
    deviation = torch.tensor([0.02, 0.02, 0.1, 0.1])
    statistics = ResidualStatistics(torch.diag(deviation.square()), 1.0, 0.003)
    state = init([batch], n, m, config)
    x, bias = torch.zeros(batch, n), torch.tensor([0.4, -0.4])
    for _ in range(steps):
        jacobian = 0.1 * torch.randn(batch, n, m, generator=generator)
        # At a bound in two thirds of the steps, as policies of fast gaits are.
        u_rl = (3 * torch.randn(batch, m, generator=generator)).clamp(-1, 1)
        u, state, _ = step(
            config, state, x, u_rl, torch.zeros_like(x), jacobian, residuals=statistics
        )
        force = (u + bias).clamp(-1, 1) if cut_off else u + bias
        noise = deviation * torch.randn(batch, n, generator=generator)
        x = x + (jacobian @ force.unsqueeze(-1)).squeeze(-1) + noise
    torch.testing.assert_close(state.sigma_m.mean(0), bias, atol=0.05, rtol=0)
    assert state.noise.mean() < 1.5


def test_a_push_inwards_counts_where_it_is_beyond_noise():
    reach = Reach.of(
        L1Config.robust(0.05, **BOUNDS),
        torch.tensor([1.0, 1.0, 1.0, -1.0, -1.0, 0.0]),
        Posterior(torch.tensor([0.3, 0.3, 0.3, -0.3, 0.0, 0.3]), 0.01 * torch.eye(6)),
    )
    assert reach.within.tolist() == [False] * 5 + [True]
    pushes = torch.tensor([-1.1, -0.9, 5.0, 1.1, -5.0, -5.0])  # standard deviations
    for length in (1e-3, 1.0, 1e3):
        counted = reach.counting(length * torch.eye(6), pushes)
        assert counted.within.tolist() == [True, False, False, True, False, True]
        assert counted.deviation.bool().tolist() == (~counted.within).tolist()
        torch.testing.assert_close(counted.passed, reach.passed)
    nothing = reach.counting(torch.zeros(6, 6), torch.full((6,), torch.nan))
    assert nothing.within.equal(reach.within)


@pytest.mark.parametrize("first", [0.4, -0.4])
@pytest.mark.parametrize("law", ["dead zone", "gain"])
def test_actuators_that_push_too_little_at_both_bounds_do_not_mislead(law, first):
    generator = torch.Generator().manual_seed(6)
    batch, steps, n = 20, 600, 3
    config = L1Config.robust(0.05, **BOUNDS, dead_zone=1e6)
    statistics = ResidualStatistics(0.02**2 * torch.eye(n), 1.0, 0.003)
    state = init([batch], n, 1, config)
    x = torch.zeros(batch, n)
    for index in range(steps):
        jacobian = 0.1 * torch.randn(batch, n, 1, generator=generator)
        # At both bounds in nine steps of ten.
        u_rl = (10 * torch.randn(batch, 1, generator=generator)).clamp(-1, 1)
        u, state, _ = step(
            config, state, x, u_rl, torch.zeros_like(x), jacobian, residuals=statistics
        )
        if index < 50:  # a bias comes first, in whose sign the estimate is sure
            force = u + first
        elif law == "gain":
            force = 0.6 * u
        else:
            force = u.sign() * (u.abs() - 0.3).clamp_min(0)
        noise = 0.02 * torch.randn(batch, n, generator=generator)
        x = x + (jacobian @ force.unsqueeze(-1)).squeeze(-1) + noise
    # The mean over both bounds is zero, the push of 0.3 or 0.4 at either is what may mislead.
    assert state.sigma_m.mean().abs() < 0.15


@pytest.mark.parametrize("bound", [1e12, 3e38, float("inf")])
def test_bounds_beyond_all_reach_are_none(bound):
    def trajectory(**bounds):
        config = L1Config.robust(0.05, **bounds)
        state = init([1], 3, 1, config)
        torch.manual_seed(0)
        for _ in range(9):
            x, u_rl = torch.randn(1, 3), torch.rand(1, 1)
            u, state, diagnostics = augment(config, model_with_residuals(), state, x, u_rl)
        assert not diagnostics.non_finite.any()
        return u, state.sigma_m

    torch.testing.assert_close(trajectory(action_low=-bound, action_high=bound), trajectory())
