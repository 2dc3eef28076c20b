"""What a fitted model misses: the covariance of its one-step residuals."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn


class Residuals(nn.Module):
    """Statistics of the one-step residuals of a model on data that it was not trained on.

    Args:
        dim: width of the observation, n.

    Attributes:
        covariance: second moments of the residuals, shrunk, ``(n, n)``, state units squared; the
            identity until they are measured.
        measured: whether the covariance is of data, ``()``, bool.
    """

    covariance: Tensor
    measured: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("covariance", torch.eye(dim))
        self.register_buffer("measured", torch.tensor(False))

    @torch.no_grad()
    def measure(self, residual: Tensor) -> None:
        """Take over the covariance of residuals ``(N, n)``.

        Raises:
            ValueError: for residuals that are not finite, of the wrong width, or none.
        """
        n = self.covariance.shape[0]
        if residual.ndim != 2 or residual.shape[0] < 1 or residual.shape[1] != n:
            raise ValueError(
                f"residuals must have shape (N, {n}) with N at least 1, got {tuple(residual.shape)}"
            )
        if not residual.isfinite().all():
            raise ValueError("residuals have entries that are not finite: leave them out first")
        self.covariance.copy_(shrunk_covariance(residual))
        self.measured.fill_(True)

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        # Older checkpoints have none of this.
        fresh = Residuals(self.covariance.shape[0])
        for name, value in fresh.named_buffers():
            state_dict.setdefault(prefix + name, value)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def shrunk_covariance(residual: Tensor) -> Tensor:
    r"""Second moments of residuals ``(N, n)``, not centred, with shrunk correlations: ``(n, n)``.

    A constant error of the model is an error too. Correlations are shrunk towards zero with the
    optimal intensity (Schäfer and Strimmer, 2005), states that never missed get a variance of
    a millionth of the median one: the result is positive definite.

    Examples:
        >>> shrunk_covariance(torch.tensor([[1.0, 0.0], [-1.0, 0.0]]))
        tensor([[1.0000e+00, 0.0000e+00],
                [0.0000e+00, 1.0000e-06]])
    """
    # Sums of squares of many rows lose digits in single precision.
    rows = residual.to(torch.float64)
    count, n = rows.shape
    variance = rows.square().mean(0)
    least = 1e-6 * variance[variance > 0].median() if bool((variance > 0).any()) else 1e-12
    deviation = variance.clamp_min(least).sqrt()
    scaled = rows / deviation
    correlation = scaled.T @ scaled / count
    if count > 1:
        # Variance of each correlation, of products of standardised residuals.
        products = (scaled.square().T @ scaled.square()) / count - correlation.square()
        off = ~torch.eye(n, dtype=torch.bool, device=rows.device)
        signal = correlation[off].square().sum()
        noise = products[off].sum() / (count - 1)
        intensity = (noise / signal).clamp(0, 1) if bool(signal > 0) else signal.new_ones(())
    else:
        intensity = rows.new_ones(())
    # Never exactly singular, whatever the data.
    intensity = intensity.clamp_min(1e-3)
    eye = torch.eye(n, dtype=rows.dtype, device=rows.device)
    correlation = torch.lerp(correlation, eye, intensity)
    correlation.diagonal().fill_(1.0)
    return (correlation * torch.outer(deviation, deviation)).to(residual.dtype)
