"""The control-affine model of the dynamics and the law by which its operating point switches."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_l1.control.jacobian import ActionJacobian


class AffineModel(NamedTuple):
    """``x' = x + drift + jacobian @ u`` around one operating point.

    Attributes:
        drift: ``(..., n)``, state units per step.
        jacobian: ``(..., n, m)``, state units per step and action unit.
    """

    drift: Tensor
    jacobian: Tensor


class Affinization(NamedTuple):
    """A model's value and derivative at the operating input.

    Attributes:
        u_bar: operating input ``(..., m)``.
        value: predicted change at ``u_bar`` ``(..., n)``.
        jacobian: its derivative with respect to the action ``(..., n, m)``.
    """

    u_bar: Tensor
    value: Tensor
    jacobian: Tensor

    def change(self, action: Tensor) -> Tensor:
        """Change of state that the affine model predicts for ``action``: ``(..., n)``."""
        return self.value + (self.jacobian @ (action - self.u_bar).unsqueeze(-1)).squeeze(-1)

    def affine(self) -> AffineModel:
        r"""Drift :math:`\hat f(x, \bar u) - J \bar u` and input matrix :math:`J`.

        arXiv 2403.14860, affinization in section 3.2.
        """
        return AffineModel(self.change(torch.zeros_like(self.u_bar)), self.jacobian)


def affinize(model: ActionJacobian, observation: Tensor, u_bar: Tensor) -> Affinization:
    """Evaluate the model and its Jacobian at ``u_bar``."""
    return Affinization(u_bar, *model.value_and_jacobian(observation, u_bar))


def switching_law(
    affinization: Affinization, action: Tensor, value: Tensor, epsilon: float
) -> tuple[Tensor, Tensor]:
    r"""Whether the affine model has become too inaccurate at ``action``.

    arXiv 2403.14860, switching condition in section 3.2:
    :math:`\|\hat f^a(x, u; \bar u) - \hat f(x, u)\| > \epsilon`, Euclidean norm in raw state
    units. An error that is not a number does not switch.

    Args:
        affinization: the affine model.
        action: the tested input ``(..., m)``.
        value: the model's own prediction at ``action`` ``(..., n)``.
        epsilon: tolerance, state units.

    Returns:
        switch ``(..., 1)`` (bool) and the error ``(..., 1)``.
    """
    error = torch.linalg.vector_norm(affinization.change(action) - value, dim=-1, keepdim=True)
    return error > epsilon, error


def reaffinize(
    model: ActionJacobian,
    observation: Tensor,
    affinization: Affinization,
    u_rl: Tensor,
    switch: Tensor,
) -> Affinization:
    """Move the operating point to ``u_rl`` where ``switch`` is set.

    The Jacobian is the dearest part of a step. On the CPU it is evaluated only for the
    environments that switched; in compiled code and on devices where looking at ``switch``
    would stall the queue it is evaluated for all and selected.
    """
    if torch.compiler.is_compiling() or observation.device.type != "cpu":
        moved = affinize(model, observation, u_rl)
        return Affinization(
            u_bar=torch.where(switch, moved.u_bar, affinization.u_bar),
            value=torch.where(switch, moved.value, affinization.value),
            jacobian=torch.where(switch.unsqueeze(-1), moved.jacobian, affinization.jacobian),
        )
    rows = switch.squeeze(-1)
    if not rows.any():
        return affinization
    if rows.all():
        return affinize(model, observation, u_rl)
    value, jacobian = model.value_and_jacobian(observation[rows], u_rl[rows])
    return Affinization(
        u_bar=torch.where(switch, u_rl, affinization.u_bar),
        value=affinization.value.index_put((rows,), value),
        jacobian=affinization.jacobian.index_put((rows,), jacobian),
    )
