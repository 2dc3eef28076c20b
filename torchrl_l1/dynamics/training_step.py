"""Losses of an ensemble on a batch and their gradients: the inner loop of a fit."""

from __future__ import annotations

from typing import Literal, Protocol

import torch
from torch import Tensor

from torchrl_l1.dynamics.ensemble import ACTIVATIONS, ALIGNMENT, Activation, EnsembleMLP
from torchrl_l1.dynamics.heads import Head


class Members(Protocol):
    """What a fit trains: the networks of an ensemble, and the head that interprets them.

    Attributes:
        network: all members.
        head: their head, whose parameters are trained too.
        affine_in_action: whether :meth:`raw_from_output` changes the networks' output.
    """

    network: EnsembleMLP
    head: Head
    affine_in_action: bool

    @property
    def device(self) -> torch.device:
        """Device of the networks."""

    def network_inputs(self, inputs: Tensor) -> Tensor:
        """The part of the normalised inputs that the networks read."""

    def raw_from_output(self, output: Tensor, inputs: Tensor) -> Tensor:
        """The head's input, from the networks' output."""


class TrainingStep:
    """Losses of all members on a batch, and the gradients of a fit's objective.

    The objective is that of :class:`~torchrl_l1.dynamics.EnsembleDynamicsLoss` plus the decay,
    computed faster: see ``test_the_objective_is_that_of_the_loss`` in ``test_training_step.py``.
    The network's derivatives are written out here; the head provides its own. With ``bfloat16``,
    the products between hidden layers and from the last one, forward and backward, and everything
    between them have that precision; parameters, their gradients, the input layer and the head's
    input stay float32.

    Args:
        model: the ensemble. Its parameters keep the gradients in ``grad``, always in the same
            memory.
        precision: ``"bfloat16"``, or ``"float32"`` for the precision of the parameters.
        decay: coefficients of half the squared weights, one per layer, or none.

    Examples:
        >>> from torchrl_l1.dynamics import EnsembleDynamics
        >>> model = EnsembleDynamics(3, 1, members=2, hidden=(8,))
        >>> step = TrainingStep(model)
        >>> step(torch.randn(2, 50, 4), torch.randn(2, 50, 3)).shape
        torch.Size([2])
        >>> model.network.weights[0].grad.shape
        torch.Size([2, 4, 8])
    """

    def __init__(
        self,
        model: Members,
        precision: Literal["float32", "bfloat16"] = "float32",
        decay: list[float] | None = None,
    ) -> None:
        network = model.network
        self.model, self.decay = model, decay or []
        for parameter in network.parameters():
            parameter.grad = torch.zeros_like(parameter) if parameter.requires_grad else None
        activation = ACTIVATIONS[network.activation]
        hidden = _LowLayer if precision == "bfloat16" else _Layer
        first, *others = zip(network.weights, network.biases, strict=True)
        self._layers = [_Layer(*first), *(hidden(*other, activation) for other in others)]

    @torch.no_grad()
    def __call__(self, inputs: Tensor, target: Tensor) -> Tensor:
        """Set the gradients of the model's parameters.

        Args:
            inputs: normalised inputs, a batch per member ``(E, B, n + m)``.
            target: normalised changes ``(E, B, n)``.

        Returns:
            the members' losses ``(E,)``, without penalties.
        """
        z = self.model.network_inputs(inputs)
        for layer in self._layers:
            z = layer.forward(z)
        losses, gradient = self._head(z.to(inputs.dtype), inputs, target)
        for layer in reversed(self._layers):
            gradient = layer.backward(gradient)
        for coefficient, layer in zip(self.decay, self._layers, strict=False):
            layer.by_weight.add_(layer.weight, alpha=coefficient)
        return losses

    def _head(self, output: Tensor, inputs: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """The members' losses and the gradient with respect to the output ``(E, B, out)``."""
        model = self.model
        if not model.affine_in_action:
            return model.head.loss_and_gradient(output, target)
        with torch.enable_grad():
            output.requires_grad_()
            raw = model.raw_from_output(output, inputs)
        losses, by_raw = model.head.loss_and_gradient(raw.detach(), target)
        (gradient,) = torch.autograd.grad(raw, output, by_raw)
        return losses, gradient


class _Layer:
    """A layer of all members and its gradients, in the precision of its parameters.

    Args:
        weight: ``(E, in, out)``.
        bias: ``(E, 1, out)``.
        activation: applied to the previous layer's output; ``None`` for the inputs.
    """

    def __init__(self, weight: Tensor, bias: Tensor, activation: Activation | None = None) -> None:
        self.weight, self.bias, self.activation = weight.detach(), bias.detach(), activation
        self.by_weight, self.by_bias = _gradient(weight), _gradient(bias)

    def forward(self, z: Tensor) -> Tensor:
        """The previous layer's output ``(E, B, in)`` to this one's ``(E, B, out)``."""
        self._z = z
        self._units = self.activation.value(z) if self.activation else z
        return torch.bmm(self._units, self.weight).add_(self.bias)

    def backward(self, gradient: Tensor) -> Tensor:
        """Set the parameters' gradients; also that with respect to ``z``, from the output's."""
        torch.sum(gradient, 1, True, out=self.by_bias)
        torch.bmm(self._units.mT, gradient, out=self.by_weight)
        if self.activation is None:
            return gradient
        gradient = torch.bmm(gradient, self.weight.mT)
        return self.activation.backward(gradient, self._z, self._units)


class _LowLayer(_Layer):
    """As :class:`_Layer`, in bfloat16.

    The bias is the weight of one more unit, which is always one: additions and sums over the rows
    would take as long as the products.
    """

    activation: Activation

    def __init__(self, weight: Tensor, bias: Tensor, activation: Activation) -> None:
        super().__init__(weight, bias, activation)
        members, width, out = weight.shape
        filled = -(-(width + 1) // ALIGNMENT) * ALIGNMENT
        self._low = weight.new_zeros(members, filled, out, dtype=torch.bfloat16)
        self._by_low = torch.empty_like(self._low)
        self._read = self._low.new_empty(members, 0, filled)

    def forward(self, z: Tensor) -> Tensor:
        rows, width = z.shape[1:]
        if self._read.shape[1] != rows:
            self._read = self._low.new_zeros(z.shape[0], rows, self._low.shape[1])
            self._read[..., width] = 1
        self._z, self._units = z, self._read[..., :width]
        if z.dtype == self._units.dtype:
            self.activation.into(z, self._units)
        else:
            self._units.copy_(self.activation.value(z))
        self._low[:, :width] = self.weight
        self._low[:, width] = self.bias[:, 0]
        return torch.bmm(self._read, self._low)

    def backward(self, gradient: Tensor) -> Tensor:
        width, gradient = self._units.shape[-1], gradient.to(self._low.dtype)
        torch.bmm(self._read.mT, gradient, out=self._by_low)
        self.by_weight.copy_(self._by_low[:, :width])
        self.by_bias.copy_(self._by_low[:, width, None])
        gradient = torch.bmm(gradient, self._low[:, :width].mT).to(self._z.dtype)
        return self.activation.backward(gradient, self._z, self._units)


def _gradient(parameter: Tensor) -> Tensor:
    """Where the gradient goes; for a frozen parameter, where no optimizer looks."""
    return torch.empty_like(parameter) if parameter.grad is None else parameter.grad
