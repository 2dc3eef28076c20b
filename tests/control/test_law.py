from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_l1.control import ActionJacobian, L1Config, L1State, augment, init, step
from torchrl_l1.control.law import project, respond, saturate
from torchrl_l1.control.least_squares import solve_matched


def well_conditioned(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Random tall matrices whose singular values lie between 0.5 and 1.5."""
    u, _, vt = np.linalg.svd(rng.normal(size=shape), full_matrices=False)
    return u * rng.uniform(0.5, 1.5, size=(*shape[:-2], 1, shape[-1])) @ vt


def tensors(*arrays: np.ndarray) -> list[torch.Tensor]:
    return [torch.as_tensor(array) for array in arrays]


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    n=st.integers(1, 9),
    excess=st.integers(0, 8),
    dt=st.floats(1e-3, 0.1),
    alpha=st.floats(0.0, 1.0),
    filter_input=st.sampled_from(["current", "previous"]),
    bound=st.sampled_from([None, 0.5]),
    scalar_rate=st.booleans(),
    projected=st.booleans(),
)
def test_agrees_with_the_formulas_of_the_paper(
    numpy_l1, seed, n, excess, dt, alpha, filter_input, bound, scalar_rate, projected
):
    m = max(1, n - excess)
    rng = np.random.default_rng(seed)
    rates = -rng.uniform(0.05, 12.0, size=n)
    if scalar_rate:
        rates = np.full(n, rates[0])
    config = L1Config(
        dt,
        alpha=alpha,
        a_s=float(rates[0]) if scalar_rate else tuple(rates.tolist()),
        filter_input=filter_input,
        action_low=None if bound is None else -bound,
        action_high=bound,
        project=projected,
    )
    limits = {} if bound is None else {"low": -bound, "high": bound}
    oracle = numpy_l1(dt, alpha / dt, rates, filter_input=filter_input, project=projected, **limits)
    state = init([], n, m, dtype=torch.float64)
    for t in range(8):
        x, drift, u_rl = rng.normal(size=n), rng.normal(size=n), rng.normal(size=m)
        jac = well_conditioned(rng, n, m)
        restart = t in (0, 5)
        u_rl_clipped = np.clip(u_rl, oracle.low, oracle.high)
        if restart:
            oracle.start(x, m)
        missed = oracle.x_hat - x
        expected = oracle.control(x, u_rl_clipped, drift, jac)
        u, state, diagnostics = step(
            config, state, *tensors(x, u_rl, drift, jac), torch.tensor([restart])
        )
        np.testing.assert_allclose(u, expected, atol=1e-9, rtol=1e-9)
        np.testing.assert_allclose(state.sigma_m, oracle.sigma_m, atol=1e-9, rtol=1e-9)
        np.testing.assert_allclose(state.x_hat, oracle.x_hat, atol=1e-9, rtol=1e-9)
        np.testing.assert_allclose(
            diagnostics.unmatched.item(), np.linalg.norm(oracle.sigma_um), atol=1e-7, rtol=1e-9
        )
        for found, vector in ((diagnostics.prediction_error, missed), (diagnostics.u_a, oracle.q)):
            np.testing.assert_allclose(found.item(), np.linalg.norm(vector), atol=1e-8, rtol=1e-9)
        assert not diagnostics.ill_conditioned


def test_float32_agrees_with_float64():
    rng = np.random.default_rng(0)
    x, drift, u_rl, jac = (
        torch.as_tensor(a)
        for a in (
            rng.normal(size=(9, 5)),
            rng.normal(size=(9, 5)),
            rng.normal(size=(9, 2)),
            well_conditioned(rng, 9, 5, 2),
        )
    )
    config = L1Config(0.04)
    results = []
    for dtype in (torch.float64, torch.float32):
        state = init([9], 5, 2, dtype=dtype)
        for k in range(5):
            u, state, _ = step(
                config, state, *(v.to(dtype) for v in (x + 0.1 * k, u_rl, drift, jac))
            )
        assert u.dtype == dtype and all(
            v.dtype == dtype for v in (state.x_hat, state.q, state.sigma_m)
        )
        results.append((u, state.x_hat))
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(b.double(), a, atol=2e-5, rtol=2e-5)


@pytest.mark.parametrize("batch", [(), (1,), (3,), (2, 3)])
def test_environments_do_not_interact(batch):
    rng = np.random.default_rng(1)
    n, m = 4, 2
    x, drift = rng.normal(size=(6, *batch, n)), rng.normal(size=(*batch, n))
    u_rl, jac = rng.normal(size=(*batch, m)), well_conditioned(rng, *batch, n, m)
    config = L1Config(0.05, action_low=-1.0, action_high=1.0)

    def run(index: tuple[int, ...] | None) -> torch.Tensor:
        def pick(a: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(a if index is None else a[index])

        state = init([] if index is not None else batch, n, m, dtype=torch.float64)
        for k in range(6):
            u, state, _ = step(config, state, pick(x[k]), pick(u_rl), pick(drift), pick(jac))
        return u

    together = run(None)
    assert together.shape == (*batch, m)
    for index in np.ndindex(*batch):
        torch.testing.assert_close(together[index], run(index), atol=1e-13, rtol=1e-13)


def random_step(seed: int, batch: int = 5, n: int = 4, m: int = 2):
    rng = np.random.default_rng(seed)
    return tensors(
        rng.normal(size=(batch, n)),
        rng.normal(size=(batch, m)),
        rng.normal(size=(batch, n)),
        well_conditioned(rng, batch, n, m),
    )


def started_state(config: L1Config, batch: int = 5, n: int = 4, m: int = 2) -> L1State:
    state = init([batch], n, m, dtype=torch.float64)
    for seed in range(3):
        _, state, _ = step(config, state, *random_step(seed, batch, n, m))
    return state


def test_restart_concerns_its_environment_only():
    config = L1Config(0.05)
    state = started_state(config)
    inputs = random_step(7)
    one = torch.zeros(5, 1, dtype=torch.bool)
    one[2] = True
    u_kept, kept, _ = step(config, state, *inputs)
    u, mixed, _ = step(config, state, *inputs, one)
    u_fresh, fresh, _ = step(config, init([5], 4, 2, dtype=torch.float64), *inputs)
    others = [0, 1, 3, 4]
    for mixed_value, kept_value, fresh_value in (
        (u, u_kept, u_fresh),
        (mixed.x_hat, kept.x_hat, fresh.x_hat),
        (mixed.q, kept.q, fresh.q),
        (mixed.sigma_m, kept.sigma_m, fresh.sigma_m),
    ):
        torch.testing.assert_close(mixed_value[others], kept_value[others], atol=0, rtol=0)
        torch.testing.assert_close(mixed_value[2], fresh_value[2], atol=0, rtol=0)
    assert not torch.equal(kept.x_hat[2], fresh.x_hat[2])
    # A restart is what the first step is, whatever the state held.
    unstarted = state._replace(started=~one)
    torch.testing.assert_close(step(config, unstarted, *inputs)[0], u, atol=0, rtol=0)


@pytest.mark.parametrize("bounded", [True, False])
def test_state_does_not_alias_the_inputs(bounded):
    bounds = {"action_low": -1.0, "action_high": 1.0} if bounded else {}
    config = L1Config(0.05, **bounds)
    state = started_state(config)
    inputs = random_step(11)
    before = [value.clone() for value in state.entries().values()]
    u, following, _ = step(config, state, *inputs)
    expected = [u.clone(), *(value.clone() for value in following.entries().values())]
    for value in inputs:
        value.zero_()
    for value, old in zip(state.entries().values(), before, strict=True):
        torch.testing.assert_close(value, old, atol=0, rtol=0)
    u_rl = inputs[1]
    assert u.data_ptr() != u_rl.data_ptr()
    for value, old in zip([u, *following.entries().values()], expected, strict=True):
        torch.testing.assert_close(value, old, atol=0, rtol=0)


@pytest.mark.parametrize("which", ["observation", "u_rl", "drift", "jacobian"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_data_that_are_not_finite_stay_in_their_environment(which, value):
    config = L1Config(0.05)
    state = started_state(config)
    good = random_step(3)
    bad = [tensor.clone() for tensor in good]
    bad[["observation", "u_rl", "drift", "jacobian"].index(which)][1] = value
    u_good, state_good, _ = step(config, state, *good)
    u, following, diagnostics = step(config, state, *bad)
    assert diagnostics.non_finite.squeeze(-1).tolist() == [False, True, False, False, False]
    others = [0, 2, 3, 4]
    torch.testing.assert_close(u[others], u_good[others], atol=0, rtol=0)
    torch.testing.assert_close(following.x_hat[others], state_good.x_hat[others], atol=0, rtol=0)
    # L1 stands aside and begins again at the next step.
    torch.testing.assert_close(u[1], bad[1][1], equal_nan=True, atol=0, rtol=0)
    assert not following.started[1] and following.started[others].all()
    for entry in following.entries().values():
        assert entry.isfinite().all()
    for entry in diagnostics:
        assert entry.isfinite().all()
    again = random_step(4)
    u, recovered, diagnostics = step(config, following, *again)
    assert recovered.started.all() and not diagnostics.non_finite.any()
    torch.testing.assert_close(u[1], again[1][1])


def test_the_estimate_is_bounded_by_the_disturbance():
    # |x_err| obeys e' = (1 - gain) e - J d, so |sigma_m| <= kappa |d| / (1 - |1 - gain|).
    config = L1Config(0.05)
    rng = np.random.default_rng(5)
    jac = torch.as_tensor(well_conditioned(rng, 1, 4, 1))
    state = init([1], 4, 1, dtype=torch.float64)
    x = torch.zeros(1, 4, dtype=torch.float64)
    drift = torch.zeros_like(x)
    u_rl = torch.zeros(1, 1, dtype=torch.float64)
    bound = config.adaptation_gain / (1 - abs(1 - config.predictor_gain))
    largest = 0.0
    for _ in range(500):
        u, state, _ = step(config, state, x, u_rl, drift, jac)
        d = torch.as_tensor(rng.choice([-1.0, 1.0], size=(1, 1)))
        x = x + (jac @ (u + d).unsqueeze(-1)).squeeze(-1)
        largest = max(largest, state.sigma_m.abs().item(), state.q.abs().item())
    assert 0.5 < largest <= bound * (1 + 1e-9)


@pytest.mark.parametrize("filter_input", ["current", "previous"])
def test_projection_bounds_the_filter_where_actions_have_almost_no_effect(filter_input):
    def largest(**settings) -> tuple[float, L1State, torch.Tensor]:
        config = L1Config(0.05, filter_input=filter_input, **settings)
        jac = torch.full((1, 1, 1), 1e-6, dtype=torch.float64)
        state = init([1], 1, 1, dtype=torch.float64)
        zero, x = torch.zeros(1, 1, dtype=torch.float64), torch.zeros(1, 1, dtype=torch.float64)
        most = 0.0
        for _ in range(50):
            _, state, diagnostics = step(config, state, x, zero, zero, jac)
            x = x + 0.1  # a disturbance that the model does not know
            most = max(most, state.q.abs().item(), state.sigma_m.abs().item())
        assert diagnostics.non_finite.item() is False
        return most, state, diagnostics.matched + diagnostics.unmatched

    bounds = {"action_low": -1.0, "action_high": 2.0}
    projected, state, rates = largest(**bounds)
    assert 2.9 < projected <= 3.0
    free, free_state, free_rates = largest(**bounds, project=False)
    assert free > 5e4
    # Predictor and diagnostics take in the whole estimate either way.
    torch.testing.assert_close(state.x_hat, free_state.x_hat)
    torch.testing.assert_close(rates, free_rates)
    for open_bounds in ({}, {"action_low": -1.0}, {"action_low": -1.0, "action_high": np.inf}):
        assert largest(**open_bounds)[0] > 5e4
    assert largest(action_low=(-1.0,), action_high=(2.0,))[0] == projected


def test_projection_uses_each_entrys_own_range():
    config = L1Config(0.05, action_low=(-1.0, -0.5), action_high=(0.5, np.inf))
    assert config.matched_bound == (1.5, np.inf)
    sigma_m = torch.tensor([[9.0, 9.0], [-9.0, 1.0]])
    assert project(config, sigma_m).tolist() == [[1.5, 9.0], [-1.5, 1.0]]


def test_bounds_apply_to_the_policy_and_to_the_executed_input():
    config = L1Config(0.05, action_low=(-1.0, -0.5), action_high=0.5)
    state = started_state(config)
    x, _, drift, jac = random_step(3)
    u_rl = torch.full((5, 2), 10.0, dtype=torch.float64)
    u, following, diagnostics = step(config, state, x, u_rl, drift, jac)
    low, high = torch.tensor([-1.0, -0.5]), torch.tensor([0.5, 0.5])
    assert (u >= low).all() and (u <= high).all()
    torch.testing.assert_close(u, torch.clamp(0.5 - following.q, low.double(), high.double()))
    cut = (u != 0.5 - following.q).double().mean(-1, keepdim=True)
    torch.testing.assert_close(diagnostics.saturation, cut)
    # The predictor sees the saturated input.
    unsaturated = step(L1Config(0.05), state, x, u_rl, drift, jac)[1].x_hat
    assert not torch.allclose(unsaturated, following.x_hat)


def test_saturate_without_bounds_changes_nothing():
    action = torch.tensor([1e9, -1e9])
    assert torch.equal(saturate(L1Config(0.1), action), action)
    assert saturate(L1Config(0.1, action_low=-1.0), action).tolist() == [1e9, -1.0]
    assert saturate(L1Config(0.1, action_high=(1.0, 2.0)), action).tolist() == [1.0, -1e9]


def test_zero_bandwidth_estimates_without_acting():
    config = L1Config(0.05, alpha=0.0)
    state = started_state(config)
    inputs = random_step(3)
    u, following, _ = step(config, state, *inputs)
    torch.testing.assert_close(u, inputs[1], atol=0, rtol=0)
    assert following.sigma_m.abs().min() > 0


def test_shapes_that_do_not_fit_are_named():
    config = L1Config(0.05)
    state = init([3], 4, 2)
    good = {
        "observation": torch.zeros(3, 4),
        "u_rl": torch.zeros(3, 2),
        "drift": torch.zeros(3, 4),
        "jacobian": torch.zeros(3, 4, 2),
        "restart": torch.zeros(3, 1, dtype=torch.bool),
    }
    step(config, state, **good)
    bad = {
        "observation": torch.zeros(3, 5),
        "u_rl": torch.zeros(2),
        "drift": torch.zeros(1, 4),
        "jacobian": torch.zeros(3, 2, 4),
        "restart": torch.zeros(3, dtype=torch.bool),
    }
    for name, value in bad.items():
        with pytest.raises(ValueError, match=f"^{name} has shape"):
            step(config, state, **(good | {name: value}))
    good["change"], good["u_bar"] = good.pop("drift"), torch.zeros(3, 2)
    with pytest.raises(ValueError, match=r"^change has shape"):
        respond(config, state, **(good | {"change": bad["drift"]}))


DTYPES = [torch.float32, torch.float64]


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    n=st.integers(1, 20),
    m=st.integers(1, 6),
    log_scale=st.floats(-4, 4),
)
def test_agrees_with_lstsq_where_well_posed(seed, n, m, log_scale):
    rng = np.random.default_rng(seed)
    m = min(n, m)
    u, _, vt = np.linalg.svd(rng.normal(size=(3, n, m)), full_matrices=False)
    jac = 10**log_scale * (u * rng.uniform(0.3, 2.0, size=(3, 1, m))) @ vt
    # Actions in different units.
    jac = jac * 10 ** rng.uniform(-1, 1, size=m)
    residual = rng.normal(size=(3, n))
    expected = np.stack(
        [np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(jac, residual, strict=True)]
    )
    solution, flagged = solve_matched(torch.as_tensor(jac), torch.as_tensor(residual))
    assert not flagged.any()
    scale = np.abs(expected).max()
    np.testing.assert_allclose(solution / scale, expected / scale, atol=1e-11)
    # Float32 with its own tolerance, and unflagged too.
    solution, flagged = solve_matched(
        torch.as_tensor(jac).float(), torch.as_tensor(residual).float()
    )
    assert not flagged.any()
    np.testing.assert_allclose(solution / scale, expected / scale, atol=2e-3)


def degenerate(kind: str, dtype: torch.dtype) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    jac = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    if kind == "zero":
        jac.zero_()
    elif kind == "zero column":
        jac[:, 1] = 0
    elif kind == "equal columns":
        jac[:, 2] = jac[:, 0]
    elif kind == "dependent columns":
        jac[:, 2] = jac[:, 0] - 2 * jac[:, 1]
    elif kind == "nearly dependent":
        jac[:, 2] = jac[:, 0] + 1e-9 * jac[:, 2]
    elif kind == "tiny":
        jac *= 1e-40
    elif kind == "tiny column":
        jac[:, 1] *= 1e-12
    elif kind == "rank one":
        jac = jac[:, :1] @ jac[:1]
    elif kind == "nan":
        jac[2, 1] = torch.nan
    elif kind == "inf":
        jac[0, 0] = torch.inf
    return jac.to(dtype)


KINDS = ["zero", "zero column", "equal columns", "dependent columns", "nearly dependent", "tiny",
         "tiny column", "rank one", "nan", "inf"]  # fmt: skip

ILL_POSED = [
    (kind, dtype)
    for dtype in DTYPES
    for kind in KINDS
    if (kind, dtype) != ("tiny", torch.float64)  # 1e-40 is an ordinary number there
]


@pytest.mark.parametrize(("kind", "dtype"), ILL_POSED)
def test_ill_posed_systems_are_flagged_finite_and_bounded(kind, dtype):
    good = degenerate("none", dtype)
    jac = torch.stack([good, degenerate(kind, dtype), good])
    residual = torch.randn(3, 5, generator=torch.Generator().manual_seed(1)).to(dtype)
    solution, flagged = solve_matched(jac, residual)
    assert flagged.squeeze(-1).tolist() == [False, True, False]
    assert solution.isfinite().all()
    # Damping bounds the gain along a lost direction; the neighbours are not touched.
    assert solution[1].abs().max() < 100 * residual[1].norm()
    expected, _ = solve_matched(jac[:1], residual[:1])
    torch.testing.assert_close(solution[:1], expected, atol=0, rtol=0)


@pytest.mark.parametrize("dtype", DTYPES)
def test_equal_actuators_share_the_work(dtype):
    column = torch.tensor([[1.0], [2.0], [0.5]], dtype=dtype)
    jac = column.expand(3, 2)
    solution, flagged = solve_matched(jac, 3 * column.squeeze(-1))
    assert flagged
    torch.testing.assert_close(solution, torch.full((2,), 1.5, dtype=dtype), rtol=2e-3, atol=0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("value", [0.0, float("nan"), float("inf")])
def test_one_action(dtype, value):
    jac = torch.tensor([[[1.0], [2.0]], [[value], [0.0]]], dtype=dtype)
    solution, flagged = solve_matched(jac, torch.ones(2, 2, dtype=dtype))
    torch.testing.assert_close(solution, torch.tensor([[0.6], [0.0]], dtype=dtype))
    assert flagged.squeeze(-1).tolist() == [False, True]


def test_one_short_column_is_an_ordinary_system():
    jac = torch.full((2, 1), 1e-15)
    solution, flagged = solve_matched(jac, torch.full((2,), 3e-15))
    torch.testing.assert_close(solution, torch.tensor([3.0]))
    assert not flagged


@pytest.mark.parametrize("m", [1, 2])
def test_a_residual_that_is_not_finite_gives_zeros(m):
    jac = torch.eye(3)[:, :m].expand(2, 3, m)
    residual = torch.tensor([[1.0, 2.0, 3.0], [torch.nan, 1.0, 1.0]])
    solution, _ = solve_matched(jac, residual)
    torch.testing.assert_close(solution, torch.stack([residual[0, :m], torch.zeros(m)]))


def test_more_actions_than_observations_are_flagged_and_still_solve():
    jac = torch.tensor([[1.0, 1.0, 0.0], [0.0, 0.0, 2.0]], dtype=torch.float64)
    residual = torch.tensor([2.0, 4.0], dtype=torch.float64)
    solution, flagged = solve_matched(jac, residual)
    assert flagged
    torch.testing.assert_close(jac @ solution, residual, rtol=2e-3, atol=0)


@pytest.mark.parametrize("filter", ["low_pass", "kalman"])
@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"a_s": (-1.0,) * 3}, "a_s has 3 entries"),
        ({"action_low": (-1.0,) * 2}, "action_low has 2"),
    ],
)
def test_settings_of_other_widths_are_named(filter, wrong, words):
    config = L1Config(0.05, filter=filter, **wrong)
    state, x, u = init([2], 1, 1, config), torch.zeros(2, 1), torch.zeros(2, 1)
    with pytest.raises(ValueError, match=words):
        step(config, state, x, u, x, torch.ones(2, 1, 1))
    with pytest.raises(ValueError, match=words):
        augment(config, ActionJacobian(lambda x, u: x + u), state, x, u)
