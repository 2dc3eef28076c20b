from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_l1.control.law import solve_matched

DTYPES = [torch.float32, torch.float64]


@settings(max_examples=60, deadline=None)
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


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("kind", KINDS)
def test_ill_posed_systems_are_flagged_finite_and_bounded(kind, dtype):
    if kind == "tiny" and dtype == torch.float64:
        return  # 1e-40 is an ordinary number there
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
