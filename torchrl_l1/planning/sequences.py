"""What the optimisers of action sequences share: their contract, checks of arguments, sampling."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from torchrl_l1.dynamics.imagination import untouched

Evaluate = Callable[[Tensor], Tensor]
"""Returns ``(N, C)`` of candidate action sequences ``(N, C, H, m)``."""


class Plan(NamedTuple):
    """Outcome of an optimisation for N environments.

    Attributes:
        actions: the sequence to execute ``(N, H, m)``: either ``mean`` or ``best``.
        mean: mean of the final distribution ``(N, H, m)``.
        variance: its variance ``(N, H, m)``, action units squared.
        best: best of all candidates ``(N, H, m)``; the initial mean where no return was finite.
        best_return: return of ``best`` ``(N,)``; minus infinity where no return was finite.
    """

    actions: Tensor
    mean: Tensor
    variance: Tensor
    best: Tensor
    best_return: Tensor


class SequenceOptimizer(Protocol):
    """What looks for the sequence of the highest return, such as ``plan_cem``.

    Its settings tell the policy which one to use; they have a ``horizon`` and ``candidates``.
    """

    def __call__(
        self,
        evaluate: Evaluate,
        mean: Tensor,
        low: Tensor | float,
        high: Tensor | float,
        config: Any,
        generator: torch.Generator | None = None,
    ) -> Plan:
        """See :func:`torchrl_l1.planning.cem.plan`."""


def checked_bounds(
    low: Tensor | float, high: Tensor | float, mean: Tensor
) -> tuple[Tensor, Tensor]:
    """Action bounds as ``(m,)``, in type and place those of the mean.

    Raises:
        ValueError: if they are of another width, not finite, or leave no action between them.
    """
    width = mean.shape[-1]
    bounds = []
    for name, bound in (("low", low), ("high", high)):
        tensor = torch.as_tensor(bound, dtype=mean.dtype, device=mean.device)
        if tensor.dim() > 1 or tensor.numel() not in (1, width):
            raise ValueError(
                f"the action bound {name} has shape {tuple(tensor.shape)}, expected ({width},)"
            )
        if not torch.isfinite(tensor).all():
            raise ValueError(f"the action bound {name} must be finite, got {tensor.tolist()}")
        bounds.append(tensor.expand(width))
    if (bounds[0] >= bounds[1]).any():
        raise ValueError(
            "the action bounds are empty: low must be below high, got "
            f"{bounds[0].tolist()} and {bounds[1].tolist()}"
        )
    return bounds[0], bounds[1]


def checked_mean(mean: Tensor, horizon: int, low: Tensor, high: Tensor) -> Tensor:
    """The initial mean within the bounds; it must be ``(N, H, m)``.

    Raises:
        ValueError: for another shape.
    """
    if mean.dim() != 3 or mean.shape[1] != horizon:
        raise ValueError(
            f"mean must have shape (environments, {horizon}, actions) with the horizon of the "
            f"settings, got {tuple(mean.shape)}"
        )
    return torch.minimum(torch.maximum(mean, low), high)


def evaluated(evaluate: Evaluate, sequences: Tensor) -> Tensor:
    """Returns of the sequences ``(N, C)``, minus infinity for all that are not finite.

    Raises:
        ValueError: if ``evaluate`` returns another shape, or writes to the sequences.
    """
    returns = untouched(evaluate, "evaluate", sequences)
    if returns.shape != sequences.shape[:2]:
        raise ValueError(
            f"evaluate returned shape {tuple(returns.shape)} for candidates of shape "
            f"{tuple(sequences.shape)}, expected {tuple(sequences.shape[:2])}"
        )
    return torch.where(torch.isfinite(returns), returns, -torch.inf)


def select(sequences: Tensor, index: Tensor) -> Tensor:
    """Sequences ``(N, C, H, m)`` at index ``(N, K)``: ``(N, K, H, m)``."""
    return sequences[torch.arange(index.shape[0], device=index.device)[:, None], index]


def keep_best(
    best: Tensor, best_return: Tensor, sequences: Tensor, returns: Tensor
) -> tuple[Tensor, Tensor]:
    """The best sequence ``(N, H, m)`` and its return ``(N,)``, so far and among new ones."""
    value, index = returns.max(dim=1)
    better = value > best_return
    champion = select(sequences, index[:, None])[:, 0]
    return (
        torch.where(better[:, None, None], champion, best),
        torch.where(better, value, best_return),
    )


def sample_around(
    mean: Tensor,
    variance: Tensor,
    low: Tensor,
    high: Tensor,
    candidates: int,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Sequences ``(N, C, H, m)`` around a mean ``(N, H, m)``, all within the bounds.

    Normal, truncated at two standard deviations, which are first narrowed until they fit
    between the mean and the nearer bound (as in the code of arXiv 1805.12114). The variance of
    a sample is therefore 0.774 of the one given, or less.
    """
    room = torch.minimum(mean - low, high - mean).clamp_min(0) / 2
    std = torch.minimum(variance.sqrt(), room).unsqueeze(1)
    shape = (mean.shape[0], candidates, *mean.shape[1:])
    # The inverse of the distribution function; P(|z| < 2) = erf(sqrt 2).
    uniform = torch.rand(shape, dtype=mean.dtype, device=mean.device, generator=generator)
    normal = uniform.mul_(2).sub_(1).mul_(math.erf(math.sqrt(2))).erfinv_().mul_(math.sqrt(2))
    sequences = torch.addcmul(mean.unsqueeze(1), std, normal)
    return torch.minimum(torch.maximum(sequences, low), high)


def initial_variance(given: float | None, low: Tensor, high: Tensor, like: Tensor) -> Tensor:
    """The variance to start from, by default that of a standard deviation of range / 4."""
    value = (high - low).square() / 16 if given is None else torch.full_like(low, given)
    return value.expand_as(like).clone()
