"""Whatever numbers come, what L1 sends is finite and within bounds, and it stays in its row."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_l1.control import (
    ActionJacobian,
    L1Config,
    ResidualStatistics,
    augment,
    init,
    step,
)
from torchrl_l1.control.least_squares import solve_matched, without_effect

DTYPES = [torch.float16, torch.bfloat16, torch.float32, torch.float64]
HALF = DTYPES[:2]
LAWS = {"low_pass": L1Config, "kalman": L1Config.robust}


def numbers(generator: torch.Generator, magnitude: float, *shape: int) -> torch.Tensor:
    """Normal numbers times a power of ten that every row has its own of, up to ``magnitude``."""
    rows = torch.rand(*shape[:1], *([1] * (len(shape) - 1)), generator=generator) * magnitude
    return torch.randn(*shape, generator=generator, dtype=torch.float64) * 10.0 ** rows.double()


magnitudes = st.floats(-30, 30)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    dtype=st.sampled_from(DTYPES),
    law=st.sampled_from(sorted(LAWS)),
    n=st.integers(1, 6),
    m=st.integers(1, 4),
    bound=st.sampled_from([1e-6, 1.0, 1e6, 1e30]),
    log_x=magnitudes,
    log_jacobian=magnitudes,
    log_drift=magnitudes,
    log_u=magnitudes,
    rank=st.integers(1, 4),
    project=st.booleans(),
)
def test_any_numbers_leave_the_action_finite_bounded_and_in_its_row(
    seed, dtype, law, n, m, bound, log_x, log_jacobian, log_drift, log_u, rank, project
):
    generator = torch.Generator().manual_seed(seed)
    config = LAWS[law](0.05, action_low=-bound, action_high=bound, project=project)
    limit = torch.finfo(dtype).max
    rows, others = 3, [0, 2]
    honest = {
        "x": numbers(generator, 0, 6, rows, n),
        "u": numbers(generator, 0, 6, rows, m),
        "drift": 0.1 * numbers(generator, 0, 6, rows, n),
        "jacobian": numbers(generator, 0, 6, rows, n, m),
    }
    wild = {name: value.clone() for name, value in honest.items()}
    logs = {"x": log_x, "u": log_u, "drift": log_drift, "jacobian": log_jacobian}
    for name, value in wild.items():
        value[:, 1] = numbers(generator, logs[name], 6, *value.shape[2:])
    thin = numbers(generator, 0, n, min(rank, m)) @ numbers(generator, 0, min(rank, m), m)
    wild["jacobian"][3:, 1] = thin * 10.0**log_jacobian  # of deficient rank
    runs = []
    for inputs in (honest, wild):
        state, found = init([rows], n, m, config, dtype=dtype), []
        for t in range(6):
            x, u_rl, drift, jacobian = (
                inputs[name][t].clamp(-limit, limit).to(dtype)
                for name in ("x", "u", "drift", "jacobian")
            )
            u, state, signals = step(config, state, x, u_rl, drift, jacobian)
            assert u.dtype == dtype and u.isfinite().all()
            assert (
                u.abs() <= torch.tensor(bound, dtype=torch.float64).clamp(max=limit).to(dtype)
            ).all()
            assert state.x_hat.dtype == state.u_bar.dtype == dtype
            for name, value in (*state.entries().items(), *signals._asdict().items()):
                assert value.isfinite().all(), name
                if value.is_floating_point() and name not in ("x_hat", "u_bar"):
                    precise = torch.promote_types(dtype, torch.float32)
                    assert value.dtype == (precise if name in state.entries() else dtype), name
            found.append((u, *state.entries().values(), *signals))
        runs.append(found)
    for before, after in zip(*runs, strict=True):
        assert all(torch.equal(a[others], b[others]) for a, b in zip(before, after, strict=True))


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    dtype=st.sampled_from(DTYPES),
    law=st.sampled_from(sorted(LAWS)),
    filter_input=st.sampled_from(["current", "previous"]),
    m=st.integers(1, 3),
    log_scale=magnitudes,
    where=st.sampled_from(["x", "output", "gain"]),
)
def test_any_model_leaves_the_action_finite_bounded_and_in_its_row(
    seed, dtype, law, filter_input, m, log_scale, where
):
    generator = torch.Generator().manual_seed(seed)
    n, rows, others = 3, 3, [0, 2]
    weight = numbers(generator, 0, m, n).to(dtype)
    kind = {} if law == "kalman" else {"filter_input": filter_input}
    config = LAWS[law](0.05, epsilon=0.1, action_low=-1.0, action_high=1.0, **kind)
    factor = min(10.0**log_scale, float(torch.finfo(dtype).max) / 10)

    def run(spoilt: bool) -> list[tuple[torch.Tensor, ...]]:
        scale = torch.ones(rows, 1, dtype=dtype)

        def model(x, u):
            effect = u.sin() @ weight
            scaled = effect * (scale if scale.shape[0] == x.shape[0] else 1.0)
            if where == "gain":
                return 0.1 * scaled - 0.1 * x
            return 0.1 * effect + (scaled - effect) - 0.1 * x if where == "output" else 0.1 * effect

        draws = torch.Generator().manual_seed(seed)
        jacobian = ActionJacobian(model)
        state, found = init([rows], n, m, config, dtype=dtype), []
        for t in range(6):
            x = numbers(draws, 0, rows, n).to(dtype)
            u_rl = numbers(draws, 0, rows, m).to(dtype)
            scale = torch.ones(rows, 1, dtype=dtype)
            if spoilt and t in (2, 3):
                scale[1] = factor
                x[1] = x[1] * (factor if where == "x" else 1.0)
            u, state, signals = augment(config, jacobian, state, x.nan_to_num(), u_rl)
            assert u.isfinite().all() and (u.abs() <= 1).all()
            for name, value in (*state.entries().items(), *signals._asdict().items()):
                assert value.isfinite().all(), name
            found.append((u, *state.entries().values(), *signals))
        return found

    for before, after in zip(run(False), run(True), strict=True):
        assert all(torch.equal(a[others], b[others]) for a, b in zip(before, after, strict=True))


@pytest.mark.parametrize("law", sorted(LAWS))
@pytest.mark.parametrize("size", [1e9, 1e12, 1e30, -1e30, math.inf, math.nan])
@pytest.mark.parametrize("where", ["observation", "output"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_wild_number_is_forgotten_within_three_time_constants(law, size, where, dtype):
    gain = torch.tensor([[0.1, 0.2]], dtype=dtype)
    config = LAWS[law](0.05, action_low=-1.0, action_high=1.0)
    spoilt = False

    def model(x, u):
        return u @ gain + (size if spoilt and where == "output" else 0.0)

    jacobian = ActionJacobian(model)
    state = init([1], 2, 1, config, dtype=dtype)
    x = torch.zeros(1, 2, dtype=dtype)
    u_rl = torch.full((1, 1), 0.3, dtype=dtype)
    constants = math.ceil(3 / 0.35)
    counted = 0
    for t in range(10 + constants):
        spoilt = t == 5
        seen = x + size if spoilt and where == "observation" else x
        u, state, signals = augment(config, jacobian, state, seen, u_rl)
        counted += int(signals.non_finite)
        assert u.isfinite().all() and u.abs() <= 1
        assert all(value.isfinite().all() for value in signals)
        if t > 5 + constants:
            torch.testing.assert_close(u, u_rl, atol=1e-3, rtol=0)
        x = x + u @ gain
    assert counted >= 1


def test_the_bound_on_the_prediction_error_can_be_set():
    x = torch.zeros(3, 2, dtype=torch.float64)
    gain = torch.ones(3, 2, 1, dtype=torch.float64)
    u_rl = torch.zeros(3, 1, dtype=torch.float64)
    for law in LAWS.values():
        for most, expected in ((0.5, [0, 1, 1]), (10.0, [0, 0, 1]), (math.inf, [0, 0, 0])):
            config = law(0.05, max_error=most)
            state = init([3], 2, 1, config, dtype=x.dtype)
            _, state, _ = step(config, state, x, u_rl, x, gain)
            moved = x + torch.tensor([[0.4], [1.0], [1e9]])
            _, state, signals = step(config, state, moved, u_rl, x, gain)
            assert signals.non_finite.flatten().int().tolist() == expected
            assert (state.started == ~signals.non_finite).all()
    for wrong in (0.0, -1.0, math.nan, "far", True):
        with pytest.raises(ValueError, match="max_error must be a positive number"):
            L1Config(0.05, max_error=wrong)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("law", sorted(LAWS))
@pytest.mark.parametrize("effects", [[1e-12], [0.5, 1e-12], [1e-12, 1e-12], [0.0, 0.5], [0.0]])
def test_an_action_without_visible_effect_is_flagged_and_not_acted_on(dtype, law, effects):
    weight = torch.tensor(effects, dtype=dtype)[:, None] * torch.tensor([[1.0, -2.0, 0.5]]).to(
        dtype
    )
    m = len(effects)
    config = LAWS[law](0.05, action_low=-1.0, action_high=1.0)
    state = init([2], 3, m, config, dtype=dtype)
    u_rl = torch.full((2, m), 0.2, dtype=dtype)
    drift, jacobian = torch.zeros(2, 3, dtype=dtype), weight.mT.expand(2, 3, m)
    for t in range(12):
        x = torch.tensor([[0.1, 0.0, 1.0], [0.0, 0.0, 0.0]], dtype=dtype) * (t + 1)
        u, state, signals = step(config, state, x, u_rl, drift, jacobian)
        assert signals.ill_conditioned.all()
        for k, effect in enumerate(effects):
            if effect < 0.1:
                assert torch.equal(u[:, k], u_rl[:, k])
    if law == "low_pass":
        assert torch.equal(u, u_rl) == (0.5 not in effects)


def test_a_residual_beyond_all_actions_is_not_matched():
    """A million times what the actions could do in a step is no disturbance of theirs."""
    gain = torch.full((2, 1, 1), 1e-3, dtype=torch.float64)
    config = L1Config(0.05, action_low=-1.0, action_high=1.0)
    state = init([2], 1, 1, dtype=torch.float64)
    zero = torch.zeros(2, 1, dtype=torch.float64)
    _, state, _ = step(config, state, zero, zero, zero, gain)
    far = torch.tensor([[0.01], [1e4]], dtype=torch.float64)
    _, state, signals = step(config, state, far, zero, zero, gain)
    assert signals.ill_conditioned.flatten().tolist() == [False, True]
    assert state.sigma_m.flatten().abs().tolist() == [2.0, 0.0]


def test_effects_are_seen_in_relation_to_state_and_range():
    jacobian = torch.tensor([[1e-3, 1e-12], [1e-9, 1e-5]], dtype=torch.float64)
    size = torch.tensor([1.0, 1e4], dtype=torch.float64)
    assert without_effect(jacobian, size, 1.0).tolist() == [False, True]
    assert without_effect(jacobian, size, torch.tensor([1e-6, 1e4])).tolist() == [True, False]
    # A state that no action reaches, as a clock's, does not hide the others.
    clock = torch.tensor([1.0, 1e12], dtype=torch.float64)
    assert without_effect(torch.tensor([[0.1], [0.0]]).double(), clock, 1.0).tolist() == [False]


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), m=st.integers(1, 4), dtype=st.sampled_from(HALF))
def test_half_precision_is_solved_in_single_precision(seed, m, dtype):
    generator = torch.Generator().manual_seed(seed)
    jacobian = (300 * torch.randn(5, 6, m, generator=generator)).to(dtype)
    residual = (300 * torch.randn(5, 6, generator=generator)).to(dtype)
    solution, flagged = solve_matched(jacobian, residual)
    expected, expected_flags = solve_matched(jacobian.float(), residual.float())
    assert solution.dtype == dtype and torch.equal(solution, expected.to(dtype))
    assert torch.equal(flagged, expected_flags)


@pytest.mark.parametrize("dtype", HALF)
@pytest.mark.parametrize("law", sorted(LAWS))
def test_a_bias_is_cancelled_in_half_precision(dtype, law):
    torch.manual_seed(0)
    weight = torch.tensor([[0.5, 0.0, 0.2], [0.0, 0.4, -0.3]], dtype=dtype)
    config = LAWS[law](0.05, action_low=-1.0, action_high=1.0)
    jacobian = ActionJacobian(lambda x, u: u @ weight)
    state = init([1], 3, 2, config, dtype=dtype)
    x, bias = torch.zeros(1, 3, dtype=dtype), torch.tensor([[0.3, -0.2]], dtype=dtype)
    for _ in range(60):
        u, state, _ = augment(config, jacobian, state, x, torch.zeros(1, 2, dtype=dtype))
        x = x + (u + bias) @ weight
    if law == "low_pass":
        assert ((u + bias).abs() < 0.05).all()
    assert u.isfinite().all()


@pytest.mark.parametrize("dtype", HALF)
@pytest.mark.parametrize(
    "config",
    [
        L1Config(0.05, alpha=0.01, a_s=-1e-3, action_low=-1.0, action_high=1.0),
        L1Config.robust(0.05, process_noise=0.001, action_low=-1.0, action_high=1.0),
    ],
)
def test_what_accumulates_in_small_steps_does_not_stall_in_half_precision(config, dtype):
    last = {}
    for kind in (dtype, torch.float32):
        state, x = init([1], 1, 1, config, dtype=kind), torch.zeros(1, 1, dtype=kind)
        u_rl, jacobian = torch.zeros(1, 1, dtype=kind), torch.ones(1, 1, 1, dtype=kind)
        residuals = ResidualStatistics(0.01 * torch.eye(1, dtype=kind))
        for _ in range(500):
            u, state, _ = step(config, state, x, u_rl, -x, jacobian, residuals=residuals)
            x = (u.float() + 0.3).to(kind)
        last[kind] = u.item()
    assert last[dtype] == pytest.approx(last[torch.float32], abs=2e-3)
    assert last[torch.float32] == pytest.approx(-0.3, abs=0.01)


def test_the_record_of_forecasts_is_forgotten_in_half_precision():
    config = L1Config.robust(0.05, skill_forgetting=0.999, action_low=-1.0, action_high=1.0)
    zero = torch.zeros(1, 1, dtype=torch.bfloat16)
    state = init([1], 1, 1, config, dtype=zero.dtype)
    _, state, _ = step(config, state, zero, zero, zero, zero.unsqueeze(-1))
    state = state._replace(skill=torch.full_like(state.skill, 100.0))
    for _ in range(300):
        _, state, _ = step(config, state, zero, zero, zero, zero.unsqueeze(-1))
    assert state.skill.flatten().tolist() == pytest.approx([100 * 0.999**300] * 2, rel=1e-4)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"dt": 1e300}, "too fast for dt"),
        ({"dt": 1e30}, "too fast for dt"),
        ({"dt": 1e-300}, "dt must be a positive time in seconds"),
        ({"dt": 0.1, "a_s": -1e300}, "too fast for dt"),
        ({"dt": 1e10, "a_s": -1e300}, "too fast for dt"),
        ({"dt": 0.1, "a_s": (-1.0, -1e9)}, "too fast for dt"),
        ({"dt": 0.1, "cutoff": 1e308}, r"cutoff \* dt must lie in"),
        ({"dt": 0.1, "dead_zone": 1e200}, "dead_zone must not exceed 1e9"),
        ({"dt": 0.1, "process_noise": 1e300}, "process_noise must not exceed 1e9"),
    ],
)
def test_settings_that_overflow_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        L1Config(**settings)


def test_settings_that_underflow_have_their_limits():
    assert L1Config(1e-12, a_s=-1e-320).adaptation_gain == 1.0
    assert L1Config(0.1, a_s=-1e-300).predictor_gain == 1.0
