"""Least squares for the matched part of a residual, plain and weighted by a covariance."""

from __future__ import annotations

import torch
from torch import Tensor

RANK_TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-10}
"""Smallest squared pivot of the scaled normal equations that counts as full rank, by dtype.

A squared pivot is one minus the squared multiple correlation of a column with those before it.
Columns are flagged if and only if they are within about 0.2 degrees (float32) or 0.0006 degrees
(float64) of linear dependence.
"""

DAMPING = 1e-3
"""Levenberg damping of flagged systems, relative to columns of unit length.

It bounds the gain along a nearly dependent direction to 16 per unit column and biases the
remaining directions by about 0.1 percent.
"""

EFFECT_TOLERANCE = {torch.float32: 1e-7, torch.float64: 1e-8}
"""Smallest effect of an action, relative to the state, that counts as one, by dtype.

In single precision a smaller effect vanishes in the rounding of the observation; no learned model
is accurate enough to distinguish it from its own error.
"""

_SMALLEST_STATE = 1e-3
"""Smallest magnitude at which :func:`without_effect` takes a state, raw units.

Relative to a state at rest in the origin, any effect would be infinite.
"""

_SMALLEST_RELATIVE_COLUMN = 1e-3
"""Columns are scaled to unit length; those shorter than this times the longest, by that length.

Undamped least squares does not depend on the scaling. Shorter columns lose pivot, so an action
without effect is flagged instead of getting an enormous estimate.
"""


def solve_matched(
    jacobian: Tensor, residual: Tensor, ignored: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    r"""Least-squares solution of ``jacobian @ x = residual``, damped if ill posed.

    Column-equilibrated normal equations by Cholesky decomposition: for tall, thin Jacobians this is
    the cheapest batched solver, never raises and compiles. One action has a closed form.

    Args:
        jacobian: ``(..., n, m)``.
        residual: ``(..., n)``.
        ignored: columns that are treated as zero ``(..., m)``, bool; none if ``None``.

    Returns:
        the solution ``(..., m)``, always finite, and flags ``(..., 1)``, true where a column is
        ignored or the Jacobian is rank deficient, ill conditioned (see :data:`RANK_TOLERANCE`) or
        not finite. A non-finite Jacobian or residual gives zeros.

    Examples:
        >>> jacobian = torch.tensor([[1.0, 0.0], [0.0, 2.0], [0.0, 0.0]])
        >>> solution, flagged = solve_matched(jacobian, torch.tensor([3.0, 4.0, 5.0]))
        >>> solution, flagged
        (tensor([3., 2.]), tensor([False]))
    """
    dtype = jacobian.dtype
    if dtype not in EFFECT_TOLERANCE:  # the products of half-precision columns overflow
        solution, ill_conditioned = solve_matched(jacobian.float(), residual.float(), ignored)
        return solution.to(dtype), ill_conditioned
    if jacobian.shape[-1] == 1:
        return _solve_one_column(jacobian, residual, ignored)
    if ignored is not None:
        # A product keeps the strides of the Jacobian, which affect rounding.
        jacobian = jacobian * ~ignored.unsqueeze(-2)
    solution, ill_conditioned = _solve_columns(jacobian, residual)
    if ignored is not None:
        ill_conditioned = ill_conditioned | any_of(ignored)
    return solution.masked_fill(~is_finite(solution), 0.0), ill_conditioned


def without_effect(jacobian: Tensor, size: Tensor, reach: Tensor | float) -> Tensor:
    r"""Actions without a visible effect, whatever their value: ``(..., m)``, bool.

    Those for which :math:`|J_{ij}|\, h_j < \tau \max(|x_i|, 10^{-3})` in every state :math:`i`,
    with :math:`h` half the range of the actions and :math:`\tau` of :data:`EFFECT_TOLERANCE`.
    Least squares would give them estimates without bound.

    Args:
        jacobian: ``(..., n, m)``, state units per step and action unit.
        size: magnitudes of the state ``(..., n)``.
        reach: half the range of each action ``(m,)``, or a number.

    Examples:
        >>> jacobian = torch.tensor([[1.0, 1e-12], [0.0, 1e-12]])
        >>> without_effect(jacobian, torch.ones(2), 1.0)
        tensor([False,  True])
    """
    relative = jacobian / size.clamp_min(_SMALLEST_STATE).unsqueeze(-1)
    effect = torch.linalg.vector_norm(relative, torch.inf, -2)
    return effect < EFFECT_TOLERANCE[jacobian.dtype] / reach


def any_of(flags: Tensor) -> Tensor:
    """Whether any flag is set: ``(..., d)`` to ``(..., 1)``; a single one is returned as it is."""
    return flags if flags.shape[-1] == 1 else flags.any(-1, keepdim=True)


def _solve_one_column(
    jacobian: Tensor, residual: Tensor, ignored: Tensor | None
) -> tuple[Tensor, Tensor]:
    column = jacobian.squeeze(-1)
    square = column.square().sum(-1, keepdim=True)
    # Comparisons with NaN are false.
    usable = (square > torch.finfo(square.dtype).tiny) & (square < torch.inf)
    usable = usable if ignored is None else usable & ~ignored
    unusable = ~usable
    projection = (column * residual).sum(-1, keepdim=True)
    solution = projection / square.masked_fill(unusable, torch.inf)
    return solution.nan_to_num(0.0, 0.0, 0.0), unusable


def _solve_columns(jacobian: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    dtype = jacobian.dtype
    length = torch.linalg.vector_norm(jacobian, dim=-2)
    floor = length.amax(-1, keepdim=True) * _SMALLEST_RELATIVE_COLUMN
    scale = torch.maximum(length, floor.clamp_min_(_smallest_length(dtype)))
    columns = jacobian / scale.unsqueeze(-2)
    products = columns.mT @ torch.cat([columns, residual.unsqueeze(-1)], -1)
    gram, projected = products[..., :-1], products[..., -1:]
    eye = torch.eye(gram.shape[-1], dtype=dtype, device=gram.device)
    # Both systems in one call: a branch between them would not batch.
    factor, info = torch.linalg.cholesky_ex(torch.stack([gram, gram.add(eye, alpha=DAMPING)]))
    projected = projected.expand(2, *scale.shape, 1)
    plain, damped = torch.cholesky_solve(projected, factor).squeeze(-1).unbind(0)
    pivots = factor[0].diagonal(dim1=-2, dim2=-1).amin(-1, keepdim=True)
    tolerance = RANK_TOLERANCE.get(dtype, RANK_TOLERANCE[torch.float32])
    # Written so that a NaN pivot, as from an infinite column, is flagged.
    well_conditioned = (pivots > tolerance**0.5) & (info[0].unsqueeze(-1) == 0)
    return torch.where(well_conditioned, plain, damped) / scale, ~well_conditioned


def _smallest_length(dtype: torch.dtype) -> float:
    # Its square must not underflow.
    return float(torch.finfo(dtype).tiny) ** 0.5


def is_finite(vector: Tensor) -> Tensor:
    """Whether a vector's sum is finite: ``(..., d)`` to ``(..., 1)``, in half as many kernels."""
    total = vector.sum(-1, keepdim=True)
    return total - total == 0


def whitened(covariance: Tensor, *columns: Tensor) -> tuple[Tensor, ...]:
    r"""Columns in coordinates that whiten residuals of the given covariance.

    With :math:`\Lambda = L L^\top` this is :math:`L^{-1} M`: least squares on the result is
    generalised least squares on the columns.

    Args:
        covariance: ``(..., n, n)``, positive definite; shared by a batch or one for each row.
        columns: matrices ``(..., n, k)``.

    Returns:
        one matrix ``(..., n, k)`` for each. Where the covariance is not positive definite, its
        entries are not finite.

    Examples:
        >>> white, = whitened(torch.diag(torch.tensor([4.0, 0.25])), torch.ones(2, 1))
        >>> white.squeeze(-1)
        tensor([0.5000, 2.0000])
    """
    factor, info = torch.linalg.cholesky_ex(covariance)
    factor = factor.masked_fill((info != 0)[..., None, None], torch.nan)
    stacked = torch.cat(columns, -1)
    if covariance.ndim == 2:  # once for all rows: a product is cheaper than solving for each
        eye = torch.eye(factor.shape[-1], dtype=factor.dtype, device=factor.device)
        solved = torch.linalg.solve_triangular(factor, eye, upper=False) @ stacked
    else:
        solved = torch.linalg.solve_triangular(factor, stacked, upper=False)
    return solved.split([matrix.shape[-1] for matrix in columns], -1)
