"""Triangular factors and solves, unrolled over the few rows of a state: ONNX has none."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

_aten = torch.ops.aten


def cholesky(matrix: Tensor, *_: object, **__: object) -> tuple[Tensor, Tensor]:
    """``torch.linalg.cholesky_ex`` in elementary operations.

    Examples:
        >>> matrix = torch.tensor([[4.0, 2.0], [2.0, 5.0]])
        >>> cholesky(matrix)[0]
        tensor([[2., 0.],
                [1., 2.]])
    """
    columns: list[Tensor] = []
    for j in range(matrix.shape[-1]):
        column = matrix[..., j:, j]
        for known in columns:
            column = column - known[..., j:] * known[..., j : j + 1]
        column = column / column[..., :1].sqrt()
        columns.append(torch.cat([torch.zeros_like(matrix[..., :j, j]), column], -1))
    factor = torch.stack(columns, -1)
    diagonal = torch.stack([known[..., j] for j, known in enumerate(columns)], -1)
    failed = ~(diagonal > 0).all(-1)
    return factor, failed.to(torch.int32)


def solve_triangular(
    matrix: Tensor, right: Tensor, *, upper: bool, left: bool = True, unitriangular: bool = False
) -> Tensor:
    """``torch.linalg.solve_triangular`` from the left in elementary operations.

    Examples:
        >>> matrix = torch.tensor([[2.0, 0.0], [1.0, 2.0]])
        >>> solve_triangular(matrix, torch.tensor([[2.0], [5.0]]), upper=False).squeeze(-1)
        tensor([1., 2.])
    """
    assert left and not unitriangular
    size = matrix.shape[-1]
    rows: dict[int, Tensor] = {}
    for i in reversed(range(size)) if upper else range(size):
        row = right[..., i, :]
        for k, known in rows.items():
            row = row - matrix[..., i, k, None] * known
        rows[i] = row / matrix[..., i, i, None]
    return torch.stack([rows[i] for i in range(size)], -2)


def cholesky_solve(right: Tensor, factor: Tensor, upper: bool = False) -> Tensor:
    """``torch.cholesky_solve`` of a lower factor in elementary operations."""
    assert not upper
    lower = solve_triangular(factor, right, upper=False)
    return solve_triangular(factor.mT, lower, upper=True)


UNROLLED: dict[Any, Callable[..., Any]] = {
    _aten.linalg_cholesky_ex.default: cholesky,
    _aten.linalg_solve_triangular.default: solve_triangular,
    _aten.cholesky_solve.default: cholesky_solve,
}
"""Replacements by the torch operation that each stands for."""
