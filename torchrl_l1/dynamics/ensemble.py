"""An ensemble of multi-layer perceptrons evaluated as one batched network."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchrl_l1.checks import check_choice


def _relu(z: Tensor) -> tuple[Tensor, Tensor]:
    value = z.relu()
    # Not a comparison, whose conversion to numbers takes ten times as long.
    return value, value.sign()


def _tanh(z: Tensor) -> tuple[Tensor, Tensor]:
    value = z.tanh()
    return value, 1 - value * value


def _silu(z: Tensor) -> tuple[Tensor, Tensor]:
    gate = z.sigmoid()
    value = z * gate
    return value, gate + value * (1 - gate)


class Activation(NamedTuple):
    """An activation with its derivative and in-place variants.

    Attributes:
        value: the activation.
        value_and_derivative: the activation and its derivative.
        in_place: the activation, overwriting its argument. At the sizes used in planning, a new
            tensor costs as much as the activation.
        into: the activation, written into the second tensor.
        one: an input that it maps to one, in bfloat16 too.
        backward: the gradient with respect to the input, overwriting the gradient with respect to
            the output; takes the latter, the input and the output.
    """

    value: Callable[[Tensor], Tensor]
    value_and_derivative: Callable[[Tensor], tuple[Tensor, Tensor]]
    in_place: Callable[[Tensor], Tensor]
    into: Callable[[Tensor, Tensor], Tensor]
    one: float
    backward: Callable[[Tensor, Tensor, Tensor], Tensor]


ALIGNMENT = 16
"""Widths of hidden layers are padded to multiples of this where padding is used."""

ACTIVATIONS: dict[str, Activation] = {
    "relu": Activation(
        torch.relu,
        _relu,
        torch.relu_,
        lambda z, out: torch.clamp_min(z, 0, out=out),
        one=1.0,
        backward=lambda g, z, units: torch.ops.aten.threshold_backward.grad_input(
            g, z, 0, grad_input=g
        ),
    ),
    "tanh": Activation(
        torch.tanh,
        _tanh,
        torch.tanh_,
        lambda z, out: torch.tanh(z, out=out),
        one=20.0,
        backward=lambda g, z, units: torch.ops.aten.tanh_backward.grad_input(
            g, units.to(g.dtype), grad_input=g
        ),
    ),
    "silu": Activation(
        nn.functional.silu,
        _silu,
        lambda z: nn.functional.silu(z, inplace=True),
        lambda z, out: torch.ops.aten.silu.out(z, out=out),
        one=1.2784645,
        backward=lambda g, z, units: torch.ops.aten.silu_backward.grad_input(g, z, grad_input=g),
    ),
}
"""The activations that hidden layers may have."""


def _entries(parameters: nn.ParameterList) -> list[Tensor]:
    return [parameter for parameter in parameters._parameters.values() if parameter is not None]


class EnsembleMLP(nn.Module):
    """``members`` perceptrons of equal shape, with weights stacked along a leading dimension.

    All members are evaluated by one batched matrix product per layer. Hidden layers share an
    activation; the output is linear. Weights start Glorot-uniform and biases at zero, each member
    with its own draw.

    Args:
        in_features: input width.
        out_features: output width.
        hidden: widths of the hidden layers.
        members: number of networks, E.
        activation: one of :data:`ACTIVATIONS`: ``"relu"``, ``"tanh"`` or ``"silu"``.

    Raises:
        ValueError: for an unknown activation or a width below one.
    """

    def __init__(
        self,
        in_features: int,
        out_features: int,
        hidden: Sequence[int],
        members: int,
        activation: str = "relu",
    ) -> None:
        super().__init__()
        check_choice("activation", activation, tuple(ACTIVATIONS))
        widths = [in_features, *hidden, out_features]
        if members < 1 or min(widths) < 1:
            raise ValueError(f"members and widths must be positive, got {members} and {widths}")
        self.members = members
        self.activation = activation
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for fan_in, fan_out in pairwise(widths):
            bound = math.sqrt(6 / (fan_in + fan_out))
            weight = torch.empty(members, fan_in, fan_out).uniform_(-bound, bound)
            self.weights.append(nn.Parameter(weight))
            self.biases.append(nn.Parameter(torch.zeros(members, 1, fan_out)))

    def forward(self, x: Tensor) -> Tensor:
        """All members on shared ``(B, in)`` or their own ``(E, B, in)`` inputs: ``(E, B, out)``."""
        if x.dim() == 2:
            x = x.expand(self.members, *x.shape)
        activation = ACTIVATIONS[self.activation].value
        last = len(self.weights) - 1
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            # Not baddbmm, which first copies the bias to every row.
            x = torch.bmm(x, weight).add_(bias)
            if layer < last:
                x = activation(x)
        return x

    def forward_member(self, x: Tensor, member: int) -> Tensor:
        """One member alone: ``(B, in)`` to ``(B, out)``."""
        activation = ACTIVATIONS[self.activation].value
        last = len(self.weights) - 1
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = torch.addmm(bias[member], x, weight[member])
            if layer < last:
                x = activation(x)
        return x

    def value_and_directional_derivatives(
        self, x: Tensor, first: int, last: int
    ) -> tuple[Tensor, Tensor]:
        """Outputs and their derivatives with respect to the input columns ``first:last``.

        In the first layer, the tangent of an input column is a row of the weights, whatever the
        sample. From there on the ``d = last - first`` tangents of a sample pass through each
        layer's matrix product together with its value, so the cost is that of about ``1 + d``
        forward passes without the first layer.

        Args:
            x: inputs ``(B, in)``.
            first: first column differentiated.
            last: one past the last column differentiated.

        Returns:
            outputs ``(E, B, out)`` and derivatives ``(E, B, d, out)``.
        """
        batch, directions = x.shape[0], last - first
        activation = ACTIVATIONS[self.activation].value_and_derivative
        shared = x.expand(self.members, *x.shape)
        z = torch.baddbmm(self.biases[0], shared, self.weights[0])
        tangent = self.weights[0][:, None, first:last, :].expand(-1, batch, -1, -1)
        for weight, bias in zip(list(self.weights)[1:], list(self.biases)[1:], strict=True):
            value, derivative = activation(z)
            stacked = torch.cat([value[:, :, None], tangent * derivative[:, :, None]], dim=2)
            stacked = torch.bmm(stacked.flatten(1, 2), weight)
            stacked = stacked.unflatten(1, (batch, 1 + directions))
            z = stacked[:, :, 0] + bias
            tangent = stacked[:, :, 1:]
        return z, tangent

    def taylor_remainder(self, x: Tensor, step: Tensor) -> Tensor:
        """Error of the tangent at ``x`` for ``x + step``: the first-order Taylor remainder.

        The input layer is linear, so its output at ``x + step`` is a sum of two outputs that are
        needed anyway; the output layer is linear, so it acts on the remainder of the last hidden
        layer. In between, value, tangent and displaced value pass through together: three forward
        passes without those two layers.

        Args:
            x: inputs ``(B, in)``.
            step: displacements ``(B, in)``.

        Returns:
            ``f(x + step) - f(x) - Df(x) step``, ``(E, B, out)``.
        """
        activation, batch = ACTIVATIONS[self.activation].value_and_derivative, x.shape[0]
        displaced_activation = ACTIVATIONS[self.activation].value
        both = torch.cat([x, step]).expand(self.members, -1, -1) @ self.weights[0]
        z, tangent = both[:, :batch] + self.biases[0], both[:, batch:]
        displaced = z + tangent
        for weight, bias in zip(self.weights[1:-1], self.biases[1:-1], strict=True):
            value, derivative = activation(z)
            stacked = torch.cat([value, derivative * tangent, displaced_activation(displaced)], 1)
            stacked = torch.bmm(stacked, weight)
            z = stacked[:, :batch] + bias
            tangent = stacked[:, batch : 2 * batch]
            displaced = stacked[:, 2 * batch :] + bias
        if len(self.weights) == 1:
            return displaced - z - tangent
        value, derivative = activation(z)
        remainder = displaced_activation(displaced) - value - derivative * tangent
        return torch.bmm(remainder, self.weights[-1])

    def expansion(
        self, x: Tensor, first: int, last: int
    ) -> tuple[Tensor, Callable[[Tensor], tuple[Tensor, Tensor]]]:
        """First-order expansion at one of two inputs, tested at a third.

        The three pass through the network together, with the tangent from the first to the last.
        The derivatives are only those at the selected input, and reuse its activations.

        Args:
            x: the input of the expansion, its alternative and the tested one, ``(3, B, in)``; they
                may differ only in the columns ``first:last``.
            first: first column differentiated.
            last: one past the last column differentiated.

        Returns:
            the error of the expansion at the first input for the third ``(E, B, out)``, and a
            function of a mask ``(B,)``, true where the second is selected, which gives outputs
            ``(E, B, out)`` and derivatives ``(E, B, d, out)`` there.
        """
        activation, batch = ACTIVATIONS[self.activation].value_and_derivative, x.shape[1]
        # Once each: reading a ParameterList entry takes as long as a small sum.
        weights, biases = _entries(self.weights), _entries(self.biases)
        thirds = [batch, batch, batch]
        hidden = x.flatten(0, 1).expand(weights[0].shape[0], -1, -1)
        derivatives: list[Tensor] = []
        for layer, (weight, bias) in enumerate(zip(weights[:-1], biases[:-1], strict=True)):
            if layer == 0:
                z = torch.bmm(hidden, weight).add_(bias)
                first_z, _, tested_z = z.split_with_sizes(thirds, 1)
                tangent = tested_z - first_z
            else:
                stacked = torch.bmm(torch.cat([hidden, tangent], 1), weight)
                z, tangent = stacked.split_with_sizes([3 * batch, batch], 1)
                z = z.add_(bias)
            hidden, derivative = activation(z)
            derivatives.append(derivative)
            tangent.mul_(derivative[:, :batch])
        at_first, _, at_tested = hidden.split_with_sizes(thirds, 1)
        remainder = at_tested - at_first
        # Without hidden layers the tangent is exact.
        remainder = remainder - (tangent if derivatives else remainder)

        def at(moved: Tensor) -> tuple[Tensor, Tensor]:
            if batch == 1:
                rows = moved.long()
            else:
                rows = torch.arange(batch, device=x.device) + batch * moved
            value = torch.bmm(hidden.index_select(1, rows), weights[-1]).add_(biases[-1])
            tangents = weights[0][:, None, first:last].expand(-1, batch, -1, -1)
            for layer, (derivative, weight) in enumerate(
                zip(derivatives, weights[1:], strict=True)
            ):
                slopes = derivative.index_select(1, rows)[:, :, None]
                tangents = tangents.mul_(slopes) if layer else tangents * slopes
                tangents = torch.bmm(tangents.flatten(1, 2), weight)
                tangents = tangents.unflatten(1, (batch, last - first))
            return value, tangents

        return torch.bmm(remainder, weights[-1]), at
