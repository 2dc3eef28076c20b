"""The matched part of an estimate: batched least squares that cannot fail."""

from __future__ import annotations

import torch
from torch import Tensor

RANK_TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-10}
"""Smallest squared pivot of the scaled normal equations that counts as full rank, by dtype.

A squared pivot is one minus the squared multiple correlation of a column with those before it,
so columns within about 0.2 degrees (float32) or 0.0006 degrees (float64) of dependence, and no
others, are flagged.
"""

DAMPING = 1e-3
"""Levenberg damping of flagged systems, relative to columns of unit length.

It bounds the gain along a nearly dependent direction to 16 per unit column and biases the
remaining directions by about 0.1 percent.
"""

_SMALLEST_RELATIVE_COLUMN = 1e-3
"""Columns are scaled to unit length, but by no more than this times the longest column.

Undamped least squares does not depend on the scaling. Shorter columns lose pivot, so that an
action without effect is flagged instead of being given an enormous estimate.
"""


def solve_matched(jacobian: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    r"""Least-squares solution of ``jacobian @ x = residual``, damped where that is ill posed.

    Column-equilibrated normal equations by Cholesky decomposition: for tall, thin Jacobians
    this is the cheapest batched solver, raises nothing and compiles. One action has a closed
    form.

    Args:
        jacobian: ``(..., n, m)``.
        residual: ``(..., n)``.

    Returns:
        the solution ``(..., m)``, always finite, and flags ``(..., 1)``, true where the
        Jacobian is rank deficient, ill conditioned (see :data:`RANK_TOLERANCE`) or not finite.
        A Jacobian or residual that is not finite gives zeros.

    Examples:
        >>> jacobian = torch.tensor([[1.0, 0.0], [0.0, 2.0], [0.0, 0.0]])
        >>> solution, flagged = solve_matched(jacobian, torch.tensor([3.0, 4.0, 5.0]))
        >>> solution, flagged
        (tensor([3., 2.]), tensor([False]))
    """
    if jacobian.shape[-1] == 1:
        solution, ill_conditioned = _solve_one_column(jacobian, residual)
        return torch.where(solution.isfinite(), solution, 0.0), ill_conditioned
    solution, ill_conditioned = _solve_columns(jacobian, residual)
    finite = solution.isfinite().all(-1, keepdim=True)
    return torch.where(finite, solution, 0.0), ill_conditioned


def _solve_one_column(jacobian: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    column = jacobian.squeeze(-1)
    square = column.square().sum(-1, keepdim=True)
    # A comparison with what is not a number is false.
    usable = (square > torch.finfo(square.dtype).tiny) & (square < torch.inf)
    projection = (column * residual).sum(-1, keepdim=True)
    return projection / torch.where(usable, square, torch.inf), ~usable


def _solve_columns(jacobian: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    dtype = jacobian.dtype
    length = torch.linalg.vector_norm(jacobian, dim=-2)
    longest = length.amax(-1, keepdim=True)
    floor = (longest * _SMALLEST_RELATIVE_COLUMN).clamp_min(_smallest_length(dtype))
    scale = torch.maximum(length, floor)
    columns = jacobian / scale.unsqueeze(-2)
    gram = columns.mT @ columns
    damping = DAMPING * torch.eye(gram.shape[-1], dtype=dtype, device=gram.device)
    # Both systems in one call: choosing between them by a branch would not batch.
    factor, info = torch.linalg.cholesky_ex(torch.stack([gram, gram + damping]))
    projected = (columns.mT @ residual.unsqueeze(-1)).expand(2, *scale.shape, 1)
    plain, damped = torch.cholesky_solve(projected, factor).squeeze(-1).unbind(0)
    pivots = factor[0].diagonal(dim1=-2, dim2=-1).square().amin(-1, keepdim=True)
    tolerance = RANK_TOLERANCE.get(dtype, RANK_TOLERANCE[torch.float32])
    # Written so that a pivot that is not a number is flagged.
    well_conditioned = (pivots > tolerance) & (info[0].unsqueeze(-1) == 0) & longest.isfinite()
    return torch.where(well_conditioned, plain, damped) / scale, ~well_conditioned


def _smallest_length(dtype: torch.dtype) -> float:
    # Its square must not underflow.
    return float(torch.finfo(dtype).tiny) ** 0.5
