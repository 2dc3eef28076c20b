from __future__ import annotations

import pytest
import torch

from torchrl_l1.deployment.unrolled import cholesky, cholesky_solve, solve_triangular


@pytest.mark.parametrize("size", [1, 3, 6])
def test_unrolled_algebra_is_that_of_torch(size):
    torch.manual_seed(size)
    root = torch.randn(2, size, size, dtype=torch.float64)
    matrix = root @ root.mT + torch.eye(size)
    right = torch.randn(2, size, 2, dtype=torch.float64)
    factor, info = cholesky(matrix)
    torch.testing.assert_close(factor, torch.linalg.cholesky(matrix))
    assert not info.any() and cholesky(-matrix)[1].all()
    for upper in (False, True):
        triangle = factor.mT if upper else factor
        expected = torch.linalg.solve_triangular(triangle, right, upper=upper)
        torch.testing.assert_close(solve_triangular(triangle, right, upper=upper), expected)
    torch.testing.assert_close(cholesky_solve(right, factor), torch.linalg.solve(matrix, right))
