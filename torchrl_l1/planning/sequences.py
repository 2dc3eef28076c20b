"""The common part of optimisers of action sequences: their contract and argument checks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from torchrl_l1.dynamics.functions import untouched

Evaluate = Callable[[Tensor], Tensor]
"""Returns ``(N, C)`` of candidate action sequences ``(N, C, H, m)``."""


class Plan(NamedTuple):
    """Outcome of an optimisation for N environments.

    Attributes:
        actions: the sequence to execute ``(N, H, m)``: either ``mean`` or ``best``.
        mean: mean of the final distribution ``(N, H, m)``.
        variance: its variance ``(N, H, m)``, action units squared.
        best: best of all candidates ``(N, H, m)``; the initial mean if no return was finite.
        best_return: return of ``best`` ``(N,)``; minus infinity if no return was finite.
    """

    actions: Tensor
    mean: Tensor
    variance: Tensor
    best: Tensor
    best_return: Tensor


class SequenceOptimizer(Protocol):
    """A search for the sequence with the highest return, such as ``plan_cem``.

    The type of the settings tells the policy which one to use; they have ``horizon`` and
    ``candidates``.
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


def checked_mean(mean: Tensor, horizon: int, low: Tensor, high: Tensor) -> Tensor:
    """The initial mean within the bounds; it must be ``(N, H, m)``.

    Raises:
        ValueError: for any other shape.
    """
    if mean.dim() != 3 or mean.shape[1] != horizon:
        raise ValueError(
            f"mean must have shape (environments, {horizon}, actions) with the horizon of the "
            f"settings, got {tuple(mean.shape)}"
        )
    return torch.minimum(torch.maximum(mean, low), high)


def evaluated(evaluate: Evaluate, sequences: Tensor) -> Tensor:
    """Returns of the sequences ``(N, C)``, minus infinity for any that is not finite.

    Raises:
        ValueError: if ``evaluate`` returns the wrong shape, or writes to the sequences.
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
    """The best sequence ``(N, H, m)`` and its return ``(N,)``, of the best so far and new ones."""
    value, index = returns.max(dim=1)
    better = value > best_return
    champion = select(sequences, index[:, None])[:, 0]
    return (
        torch.where(better[:, None, None], champion, best),
        torch.where(better, value, best_return),
    )


def initial_variance(given: float | None, low: Tensor, high: Tensor, like: Tensor) -> Tensor:
    """The initial variance, by default that of a standard deviation of range / 4."""
    value = (high - low).square() / 16 if given is None else torch.full_like(low, given)
    return value.expand_as(like).clone()
