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
    model: ActionJacobian,
    observation: Tensor,
    u_bar: Tensor,
    action: Tensor,
    epsilon: float,
) -> tuple[Tensor, Tensor]:
    r"""Whether the affine model around ``u_bar`` is too inaccurate at ``action``.

    arXiv 2403.14860, switching condition in section 3.2:
    :math:`\|\hat f^a(x, u; \bar u) - \hat f(x, u)\| > \epsilon`, Euclidean norm in raw state
    units. An error that is not a number does not switch.

    The affine model is compared at one input only, which takes one directional derivative; the
    Jacobian is evaluated once per step, at the operating point that this law selects.

    Args:
        model: the learned dynamics.
        observation: ``(..., n)``, raw units.
        u_bar: the operating input ``(..., m)``.
        action: the tested input ``(..., m)``.
        epsilon: tolerance, state units.

    Returns:
        switch ``(..., 1)`` (bool) and the error ``(..., 1)``.
    """
    remainder = model.taylor_remainder(observation, u_bar, action)
    error = torch.linalg.vector_norm(remainder, dim=-1, keepdim=True)
    return error > epsilon, error
