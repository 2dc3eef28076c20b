"""What the last layer of an ensemble member means: the head turns it into a prediction."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor, nn


class Head(Protocol):
    """Meaning of a member's raw output for targets of ``dim`` columns.

    The predicted mean must be the first ``dim`` columns of the raw output, unchanged, so that
    the Jacobian of the mean is that of those columns.
    """

    def out_features(self, dim: int) -> int:
        """Width of the raw output."""
        ...

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        """Training loss per sample, ``(..., out)`` and ``(..., dim)`` to ``(...,)``."""
        ...


class DeterministicHead(nn.Module):
    """The raw output is the predicted mean; trained with the mean squared error."""

    def out_features(self, dim: int) -> int:
        """Width of the raw output: that of the target."""
        return dim

    def loss(self, raw: Tensor, target: Tensor) -> Tensor:
        """Squared error averaged over the target's columns (arXiv 2403.14860, section 3.1)."""
        return (raw - target).square().mean(-1)
