"""Making the model that a recipe names, at a size that makes models comparable."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from torchrl_l1.dynamics.control_affine import ControlAffineDynamics
from torchrl_l1.dynamics.model import EnsembleDynamics

MODEL_FORMS = ("nonlinear", "affine")


def make_dynamics(
    observation_dim: int,
    action_dim: int,
    form: str = "nonlinear",
    hidden: Sequence[int] = (256, 256),
    **settings: Any,
) -> EnsembleDynamics:
    """An ensemble of the given form, of a size set by ``hidden`` whatever the form.

    Args:
        observation_dim: number of observations, n.
        action_dim: number of actions, m.
        form: ``"nonlinear"`` for an :class:`EnsembleDynamics`, ``"affine"`` for a
            :class:`ControlAffineDynamics` matched to it by parameter count, see
            :func:`matched_hidden`.
        hidden: widths of the nonlinear model's hidden layers.
        settings: further arguments of :class:`EnsembleDynamics`.

    Raises:
        ValueError: for another form.

    Examples:
        >>> make_dynamics(4, 1, "affine", hidden=(128, 128)).network.weights[0].shape
        torch.Size([5, 4, 127])
    """
    if form not in MODEL_FORMS:
        allowed = " or ".join(map(repr, MODEL_FORMS))
        raise ValueError(f"form must be {allowed}, got {form!r}")
    if form == "affine":
        hidden = matched_hidden(observation_dim, action_dim, hidden)
        return ControlAffineDynamics(observation_dim, action_dim, hidden=hidden, **settings)
    return EnsembleDynamics(observation_dim, action_dim, hidden=hidden, **settings)


def matched_hidden(observation_dim: int, action_dim: int, hidden: Sequence[int]) -> list[int]:
    """Hidden widths of a control-affine network with as many parameters as a nonlinear one.

    The control-affine network has n (1 + m) outputs in place of n, and m inputs less. All
    widths are scaled by one factor, the one that brings the number of weights and biases
    closest to that of a network from n + m inputs through ``hidden`` to n outputs.

    Args:
        observation_dim: number of observations, n.
        action_dim: number of actions, m.
        hidden: widths of the nonlinear network's hidden layers.

    Examples:
        >>> matched_hidden(18, 6, [256, 256])
        [213, 213]
    """
    n, m = observation_dim, action_dim
    if not hidden:
        return []
    target = _parameters([n + m, *hidden, n])

    def scaled(widest: int) -> list[int]:
        return [max(1, round(width * widest / max(hidden))) for width in hidden]

    def difference(widest: int) -> int:
        return abs(_parameters([n, *scaled(widest), n * (1 + m)]) - target)

    # The number of parameters grows with the width, so the difference has a single minimum.
    widest = 1
    while difference(widest + 1) < difference(widest):
        widest += 1
    return scaled(widest)


def _parameters(widths: Sequence[int]) -> int:
    return sum((fan_in + 1) * fan_out for fan_in, fan_out in pairwise(widths))
