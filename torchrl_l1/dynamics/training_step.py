"""Losses of an ensemble on a batch and their gradients: the inner loop of a fit."""

from __future__ import annotations

from typing import Literal, Protocol

import torch
from torch import Tensor

from torchrl_l1.dynamics.ensemble import ACTIVATIONS, EnsembleMLP
from torchrl_l1.dynamics.heads import Head


class Members(Protocol):
    """What a fit trains: the networks of an ensemble, and the head that says what they mean.

    Attributes:
        network: all members.
        head: theirs; its parameters are trained too.
        affine_in_action: whether :meth:`raw_from_output` changes what the networks give.
    """

    network: EnsembleMLP
    head: Head
    affine_in_action: bool

    @property
    def device(self) -> torch.device:
        """Where they are."""

    def network_inputs(self, inputs: Tensor) -> Tensor:
        """What the networks read of normalised inputs."""

    def raw_from_output(self, output: Tensor, inputs: Tensor) -> Tensor:
        """What the head makes sense of, from what the networks give."""


class TrainingStep:
    """Losses of all members on a batch, and the gradients of what a fit minimises.

    The objective is that of :class:`~torchrl_l1.dynamics.EnsembleDynamicsLoss`, computed faster,
    and the decay: see ``test_the_objective_is_that_of_the_loss`` in ``test_training_step.py``.
    The network's derivatives are written out here, those of the head are its own business. In
    ``bfloat16`` the products between hidden layers and from the last one, forward and back, and
    what is between them are of that precision; parameters, gradients, sums over a batch, the
    input layer, and what the head sees stay float32.

    Args:
        model: the ensemble. Its parameters keep the gradients in ``grad``, always in the same
            memory.
        precision: ``"bfloat16"``, or ``"float32"`` for that of the parameters.
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
        self._activation = ACTIVATIONS[network.activation]
        self._weights = [weight.detach() for weight in network.weights]
        self._biases = [bias.detach() for bias in network.biases]
        full = self._weights[0].dtype
        low = torch.bfloat16 if precision == "bfloat16" else full
        self._dtypes = [full] + [low] * (len(self._weights) - 1)
        for parameter in network.parameters():
            parameter.grad = torch.zeros_like(parameter) if parameter.requires_grad else None
        self._by_weights = [_gradient(weight) for weight in network.weights]
        self._by_biases = [_gradient(bias) for bias in network.biases]

    @torch.no_grad()
    def __call__(self, inputs: Tensor, target: Tensor) -> Tensor:
        """Set the gradients of the model's parameters.

        Args:
            inputs: normalised, of each member's own batch ``(E, B, n + m)``.
            target: normalised changes ``(E, B, n)``.

        Returns:
            the members' losses ``(E,)``, without penalties.
        """
        weights = [w.to(dtype) for w, dtype in zip(self._weights, self._dtypes, strict=True)]
        operands, sums = [self.model.network_inputs(inputs)], []
        last = len(weights) - 1
        for layer, (weight, bias) in enumerate(zip(weights, self._biases, strict=True)):
            z = torch.bmm(operands[layer], weight)
            if layer == last:
                z = z.to(bias.dtype)
            sums.append(z.add_(bias.to(z.dtype)))
            if layer < last:
                operands.append(self._activation.value(z).to(self._dtypes[layer + 1]))
        losses, gradient = self._head(sums.pop(), inputs, target)
        for layer in range(last, -1, -1):
            by_weight = self._by_weights[layer]
            torch.sum(gradient, 1, True, dtype=by_weight.dtype, out=self._by_biases[layer])
            gradient = gradient.to(self._dtypes[layer])
            if gradient.dtype == by_weight.dtype:
                torch.bmm(operands[layer].mT, gradient, out=by_weight)
            else:
                by_weight.copy_(torch.bmm(operands[layer].mT, gradient))
            if layer:
                z, units = sums[layer - 1], operands.pop()
                gradient = torch.bmm(gradient, weights[layer].mT).to(z.dtype)
                gradient = self._activation.backward(gradient, z, units.to(z.dtype))
        for coefficient, by_weight, weight in zip(
            self.decay, self._by_weights, self._weights, strict=False
        ):
            by_weight.add_(weight, alpha=coefficient)
        return losses

    def _head(self, output: Tensor, inputs: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """The members' losses and the gradient by the network's output ``(E, B, out)``."""
        model = self.model
        if not model.affine_in_action:
            return model.head.loss_and_gradient(output, target)
        with torch.enable_grad():
            output.requires_grad_()
            raw = model.raw_from_output(output, inputs)
        losses, by_raw = model.head.loss_and_gradient(raw.detach(), target)
        (gradient,) = torch.autograd.grad(raw, output, by_raw)
        return losses, gradient


def _gradient(parameter: Tensor) -> Tensor:
    """Where the gradient goes: for a frozen parameter, nowhere that an optimizer looks."""
    return torch.empty_like(parameter) if parameter.grad is None else parameter.grad
