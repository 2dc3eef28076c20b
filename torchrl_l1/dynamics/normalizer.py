"""Affine normalisation of model inputs and targets, and the box that holds the data."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_l1.checks import check_not_negative, check_positive


class Normalizer(nn.Module):
    """Shift and scale that give the data it was fitted to zero mean and unit variance.

    Statistics are accumulated in float64 and stored in the module's dtype. The standard deviation
    never falls below ``std_floor``: a state that hardly moves would otherwise turn rounding errors
    into large normalised values, and its reciprocal into a large Jacobian. Code that differentiates
    through the normaliser must use :attr:`std` as it is, floor included (arXiv 2403.14860,
    appendix, technical remarks on METRPO).

    Args:
        dim: width of the vectors.
        std_floor: smallest standard deviation used, in the data's own units.

    Examples:
        >>> import torch
        >>> normalizer = Normalizer(2)
        >>> normalizer.fit(torch.tensor([[0.0, 5.0], [2.0, 5.0]]))
        >>> normalizer.normalize(torch.tensor([[2.0, 5.0]]))
        tensor([[1., 0.]])
    """

    mean: Tensor
    std: Tensor

    def __init__(self, dim: int, std_floor: float = 1e-4) -> None:
        super().__init__()
        check_positive("std_floor", std_floor)
        self.std_floor = std_floor
        self.register_buffer("mean", torch.zeros(dim))
        self.register_buffer("std", torch.ones(dim))

    @torch.no_grad()
    def fit(self, data: Tensor) -> None:
        """Set mean and standard deviation from ``data`` of shape ``(..., dim)``.

        Raises:
            ValueError: if ``data`` is empty, not finite or of the wrong width.
        """
        if data.shape[-1] != self.mean.shape[-1]:
            raise ValueError(
                f"the normaliser holds {self.mean.shape[-1]} columns, the data {data.shape[-1]}"
            )
        flat = data.reshape(-1, data.shape[-1]).double()
        if flat.shape[0] == 0:
            raise ValueError("cannot fit a normaliser to no data")
        if not torch.isfinite(flat).all():
            columns = (~torch.isfinite(flat)).any(0).nonzero().flatten().tolist()
            raise ValueError(f"cannot fit a normaliser: non-finite values in columns {columns}")
        std, mean = torch.std_mean(flat, dim=0, correction=0)
        self.mean.copy_(mean)
        self.std.copy_(std.clamp_min(self.std_floor))

    @torch.no_grad()
    def ignore(self, columns: Tensor) -> None:
        """Normalise some columns to zero until the next fit.

        Args:
            columns: the columns, ``(dim,)`` bool. Their standard deviation becomes infinite.
        """
        self.std.masked_fill_(columns, torch.inf)

    def normalize(self, data: Tensor) -> Tensor:
        """Raw ``(..., dim)`` to normalised ``(..., dim)``."""
        return (data - self.mean) / self.std

    def denormalize(self, data: Tensor) -> Tensor:
        """Normalised ``(..., dim)`` to raw ``(..., dim)``."""
        return data * self.std + self.mean


class DataBox(nn.Module):
    """Axis-aligned box around the observations seen so far, widened by a margin.

    It represents the compact state set of the paper's MDP: outside it, the model can only guess,
    and an episode that leaves it has failed (arXiv 2403.14860, section 2.1).

    Args:
        dim: width of the observations.
        margin: widening on each side, as a fraction of the data's range in that dimension.
    """

    low: Tensor
    high: Tensor

    def __init__(self, dim: int, margin: float = 0.5) -> None:
        super().__init__()
        check_not_negative("margin", margin)
        self.margin = margin
        self.register_buffer("low", torch.full((dim,), -torch.inf))
        self.register_buffer("high", torch.full((dim,), torch.inf))

    @torch.no_grad()
    def fit(self, observation: Tensor) -> None:
        """Fit the box to observations of shape ``(..., dim)``."""
        flat = observation.reshape(-1, observation.shape[-1])
        low, high = flat.amin(0), flat.amax(0)
        slack = self.margin * (high - low)
        self.low.copy_(low - slack)
        self.high.copy_(high + slack)

    @property
    def fixed(self) -> Tensor:
        """Entries that never varied in the data, ``(dim,)`` bool."""
        return self.low == self.high

    def hold(self, before: Tensor, after: Tensor) -> Tensor:
        """A prediction ``(..., dim)`` with entries that never varied kept at their previous values.

        A model that never saw them change knows nothing about them, and the box has no room for its
        errors there. Non-finite values stay non-finite.
        """
        return torch.where(self.fixed & after.isfinite(), before, after)

    def contains(self, observation: Tensor) -> Tensor:
        """Whether each observation ``(..., dim)`` lies inside; NaN does not. Shape ``(...,)``."""
        return ((observation >= self.low) & (observation <= self.high)).all(-1)
