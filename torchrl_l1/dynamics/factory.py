"""Makes the model that a recipe names, at a size that makes models comparable."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from torchrl_l1.checks import check_choice
from torchrl_l1.dynamics.control_affine import ControlAffineDynamics
from torchrl_l1.dynamics.heads import Head, make_head
from torchrl_l1.dynamics.model import EnsembleDynamics

MODEL_FORMS = ("nonlinear", "affine")


def make_dynamics(
    observation_dim: int,
    action_dim: int,
    form: str = "nonlinear",
    hidden: Sequence[int] = (256, 256),
    head: str | Head = "deterministic",
    **settings: Any,
) -> EnsembleDynamics:
    """An ensemble of the given form, with the size that ``hidden`` sets for every form.

    Args:
        observation_dim: number of observations, n.
        action_dim: number of actions, m.
        form: ``"nonlinear"`` for an :class:`EnsembleDynamics`, ``"affine"`` for a
            :class:`ControlAffineDynamics` matched to it by parameter count, see
            :func:`matched_hidden`.
        hidden: widths of the nonlinear model's hidden layers.
        head: ``"deterministic"`` or ``"gaussian"``, see :func:`make_head`, or a :class:`Head`.
        settings: further arguments of :class:`EnsembleDynamics`.

    Raises:
        ValueError: for an unknown form or head.

    Examples:
        >>> make_dynamics(4, 1, "affine", hidden=(128, 128)).network.weights[0].shape
        torch.Size([5, 4, 127])
    """
    check_choice("form", form, MODEL_FORMS)
    if isinstance(head, str):
        head = make_head(head, observation_dim)
    settings = {**settings, "head": head}
    if form == "affine":
        outputs = head.out_features(observation_dim)
        hidden = matched_hidden(observation_dim, action_dim, hidden, outputs)
        return ControlAffineDynamics(observation_dim, action_dim, hidden=hidden, **settings)
    return EnsembleDynamics(observation_dim, action_dim, hidden=hidden, **settings)


def matched_hidden(
    observation_dim: int, action_dim: int, hidden: Sequence[int], outputs: int | None = None
) -> list[int]:
    """Hidden widths of a control-affine network with as many parameters as a nonlinear one.

    The control-affine network has 1 + m times the outputs and m fewer inputs. All widths are scaled
    by the one factor that brings the number of weights and biases closest to that of a network from
    n + m inputs through ``hidden`` to the outputs.

    Args:
        observation_dim: number of observations, n.
        action_dim: number of actions, m.
        hidden: widths of the nonlinear network's hidden layers.
        outputs: width of the nonlinear network's output; n, that of the deterministic head, if
            ``None``.

    Examples:
        >>> matched_hidden(18, 6, [256, 256])
        [213, 213]
    """
    n, m = observation_dim, action_dim
    if not hidden:
        return []
    out = n if outputs is None else outputs
    target = _parameters([n + m, *hidden, out])

    def scaled(widest: int) -> list[int]:
        return [max(1, round(width * widest / max(hidden))) for width in hidden]

    def difference(widest: int) -> int:
        return abs(_parameters([n, *scaled(widest), out * (1 + m)]) - target)

    # The number of parameters grows with the width, so the difference has a single minimum.
    widest = 1
    while difference(widest + 1) < difference(widest):
        widest += 1
    return scaled(widest)


def _parameters(widths: Sequence[int]) -> int:
    return sum((fan_in + 1) * fan_out for fan_in, fan_out in pairwise(widths))
