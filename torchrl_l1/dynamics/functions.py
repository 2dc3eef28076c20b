"""Functions supplied by users, and bounds of actions: their types and checks."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchrl_l1.checks import LARGEST_BOUND

RewardFunction = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Observation ``(..., n)``, action ``(..., m)`` and next observation to rewards ``(...)``."""

Termination = Callable[[Tensor], Tensor]
"""Next observation ``(..., n)`` to whether the task ends there ``(...)``, bool."""


def checked_bounds(
    low: Tensor | float | Sequence[float], high: Tensor | float | Sequence[float], like: Tensor
) -> tuple[Tensor, Tensor]:
    """Bounds of the action as ``(m,)``, with the dtype and device of actions ``(..., m)``.

    Raises:
        ValueError: if they have another width, or leave no action between them.
    """
    width, bounds = like.shape[-1], []
    for name, bound in (("low", low), ("high", high)):
        tensor = torch.as_tensor(bound, dtype=like.dtype, device=like.device)
        if tensor.dim() > 1 or tensor.numel() not in (1, width):
            raise ValueError(
                f"the action bound {name} has shape {tuple(tensor.shape)}, expected ({width},)"
            )
        bounds.append(tensor.expand(width))
    if not (bounds[0] < bounds[1]).all():
        raise ValueError(
            "the action bounds are empty: low must be below high, got "
            f"{bounds[0].tolist()} and {bounds[1].tolist()}"
        )
    return bounds[0], bounds[1]


def finite_bounds(
    low: Tensor | float | Sequence[float], high: Tensor | float | Sequence[float], like: Tensor
) -> tuple[Tensor, Tensor]:
    """As :func:`checked_bounds`, for code that draws actions between them.

    Raises:
        ValueError: also if they are infinite, or so large that they stand for it.
    """
    low, high = checked_bounds(low, high, like)
    for name, bound in (("low", low), ("high", high)):
        if not (bound.abs() < LARGEST_BOUND).all():
            raise ValueError(
                f"the action bound {name} must be finite, got {bound.tolist()}: give numbers "
                "between which to look for actions"
            )
    return low, high


def one_each(function: Callable[..., Tensor], name: str, *inputs: Tensor) -> Tensor:
    """The result of a reward or termination, which must be ``(...)`` for inputs ``(..., width)``.

    Raises:
        ValueError: naming the function; also if it writes to its inputs.
    """
    values, batch = untouched(function, name, *inputs), tuple(inputs[0].shape[:-1])
    found = tuple(values.shape) if isinstance(values, Tensor) else type(values).__name__
    if found != batch:
        raise ValueError(
            f"the {name} function must return shape (...) for inputs of shape (..., width), got "
            f"{found} for inputs of shape {batch} + (width,)"
        )
    return values


def untouched(function: Callable[..., Tensor], name: str, *inputs: Tensor) -> Tensor:
    """The result of a function that must not modify its inputs, since they are used again.

    Raises:
        ValueError: naming the function, if it writes to one of them.
    """
    before = _writes(inputs)
    values = function(*inputs)
    if _writes(inputs) != before:
        raise ValueError(
            f"the {name} function writes to its inputs, which are used afterwards: "
            "let it work on a copy"
        )
    return values


def _writes(tensors: Sequence[Tensor]) -> list[int]:
    """Write counts of tensors; those in inference mode do not count."""
    return [0 if tensor.is_inference() else tensor._version for tensor in tensors]
