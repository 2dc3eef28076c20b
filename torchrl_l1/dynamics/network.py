"""A frozen copy of an ensemble in the fastest precision, for planning and imagination."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from itertools import accumulate
from math import inf, prod
from time import perf_counter
from typing import Any, Literal

import torch
from torch import Tensor

from torchrl_l1.dynamics.control_affine import (
    ControlAffineDynamics,
    affine_coefficients,
    affine_output,
)
from torchrl_l1.dynamics.ensemble import ACTIVATIONS, ALIGNMENT
from torchrl_l1.dynamics.heads import DeterministicHead
from torchrl_l1.dynamics.model import EnsembleDynamics
from torchrl_l1.dynamics.training_step import Members

Precision = Literal["auto", "float32", "bfloat16"]

# For narrower layers, conversion and calls cost more than the products save.
_LEAST_WIDTH = 192

# Methods that turn weights and statistics into predictions.
_PREDICTIONS = (
    "normalize_inputs",
    "network_inputs",
    "raw",
    "raw_member",
    "raw_from_output",
    "member_changes",
    "member_change",
    "mean_change",
    "forward",
)


def resolve_precision(
    precision: str,
    device: torch.device | str = "cpu",
    width: int = _LEAST_WIDTH,
    name: str = "precision",
) -> Literal["float32", "bfloat16"]:
    """Resolve ``"auto"`` to ``"bfloat16"`` for wide layers on processors that multiply it faster.

    Processors with AMX do, by far. Of those with AVX-512 alone, some multiply it at twice the rate
    of float32 and some at half, so two small products are timed once per process.

    Args:
        precision: ``"auto"``, or the value to return.
        device: device that computes the products.
        width: width of the narrowest hidden layer.
        name: name of the setting, for the error.

    Raises:
        ValueError: for an unknown precision.
    """
    if precision == "float32":
        return "float32"
    if precision == "bfloat16":
        return "bfloat16"
    if precision != "auto":
        raise ValueError(f"{name} must be 'auto', 'float32' or 'bfloat16', got {precision!r}")
    if torch.device(device).type != "cpu" or width < _LEAST_WIDTH:
        return "float32"
    # Only recent versions of torch report them.
    tell: Callable[[], dict[str, Any]] = getattr(torch.cpu, "get_capabilities", dict)
    capabilities = tell()
    faster = capabilities.get("amx_bf16") or (
        capabilities.get("avx512_bf16") and _multiplies_bfloat16_faster()
    )
    return "bfloat16" if faster else "float32"


@cache
def _multiplies_bfloat16_faster() -> bool:
    """Whether a product of hidden units takes clearly less time in bfloat16 than in float32."""
    seconds = {torch.float32: inf, torch.bfloat16: inf}
    for _ in range(10):
        for dtype, least in seconds.items():
            factor = torch.ones(256, 256, dtype=dtype)
            start = perf_counter()
            torch.mm(factor, factor)
            seconds[dtype] = min(least, perf_counter() - start)
    return seconds[torch.bfloat16] < 0.8 * seconds[torch.float32]


def model_precision(model: Members, precision: str) -> Literal["float32", "bfloat16"]:
    """The precision that a model's ``precision`` stands for, see :func:`resolve_precision`."""
    widths = [weight.shape[2] for weight in model.network.weights[:-1]]
    return resolve_precision(precision, model.device, min(widths, default=0))


@dataclass(frozen=True)
class PlanningNetwork:
    """Weights of an ensemble's elites, copied once per plan or imagination.

    The products of hidden units, nearly all of the work, run in the requested precision; input
    layer, statistics and states stay float32. The statistics of the inputs are folded into the
    weights. Each hidden layer has one more unit, which is always one: its weights are the biases of
    the next layer. Further units, always zero, pad the widths to what suits processors. Members are
    numbered by their position among the elites.

    Attributes:
        weights: per layer ``(k, in, out)``, with padded widths.
        bias: bias of the first layer ``(k, out)``.
        observation_dim: number of observations, n.
        action_dim: number of actions, m.
        change_mean: mean of the change of state ``(n,)``, raw units.
        change_std: its standard deviation, likewise.
        activation: activation of the hidden layers, in place.
        standard_deviation: maps a member's raw output to the standard deviation of its
            prediction, normalised units; ``None`` if it predicts points.
        affine_in_action: as in the ensemble.

    Examples:
        >>> model = EnsembleDynamics(3, 1, members=2, hidden=(8, 8))
        >>> network = PlanningNetwork.from_dynamics(model, "bfloat16")
        >>> [weight.dtype for weight in network.weights]
        [torch.float32, torch.bfloat16, torch.bfloat16]
        >>> network.change(torch.zeros(5, 4), member=1).shape
        torch.Size([5, 3])
    """

    weights: list[Tensor]
    bias: Tensor
    observation_dim: int
    action_dim: int
    change_mean: Tensor
    change_std: Tensor
    activation: Callable[[Tensor], Tensor]
    standard_deviation: Callable[[Tensor], Tensor] | None = None
    affine_in_action: bool = False

    @classmethod
    @torch.no_grad()
    def from_dynamics(
        cls, dynamics: EnsembleDynamics, precision: Precision = "float32"
    ) -> PlanningNetwork:
        """Copy the elites of an ensemble.

        Raises:
            TypeError: for a user-defined class that predicts in another way.
            ValueError: for an unknown precision.
        """
        _check_predicts_as_its_weights(type(dynamics))
        device = dynamics.change_normalizer.mean.device
        hidden = getattr(torch, model_precision(dynamics, precision))
        elites = dynamics.elites.to(device)
        weights = [weight[elites].double() for weight in dynamics.network.weights]
        biases = [bias[elites, 0].double() for bias in dynamics.network.biases]
        _fold_inputs(dynamics, weights, biases)
        activation = ACTIVATIONS[dynamics.network.activation]
        _fold_biases(weights, biases, activation.one)
        # Between the layers of hidden units, and from the last to an output that is a small
        # correction of the state. That of a control-affine model may be a difference of large
        # numbers.
        last = len(weights) - 1
        end = last if dynamics.affine_in_action else last + 1
        low = range(1, end) if last > 1 else range(0)
        point, head = isinstance(dynamics.head, DeterministicHead), deepcopy(dynamics.head).float()
        return cls(
            weights=[
                weight.to(hidden if layer in low else torch.float32)
                for layer, weight in enumerate(weights)
            ],
            bias=biases[0].float(),
            observation_dim=dynamics.observation_dim,
            action_dim=dynamics.action_dim,
            change_mean=dynamics.change_normalizer.mean.to(torch.float32, copy=True),
            change_std=dynamics.change_normalizer.std.to(torch.float32, copy=True),
            activation=activation.in_place,
            standard_deviation=None if point else head.standard_deviation,
            affine_in_action=dynamics.affine_in_action,
        )

    @property
    def members(self) -> int:
        """Number of elites, k."""
        return self.weights[0].shape[0]

    def raw(self, inputs: Tensor, member: int) -> Tensor:
        """One member's raw output from observations and actions ``(B, n + m)``: ``(B, out)``."""
        rows = [0] * self.members
        rows[member] = inputs.shape[0]
        return ForwardPass(self, rows)(inputs)

    def change(self, inputs: Tensor, member: int) -> Tensor:
        """One member's mean prediction, normalised: ``(B, n + m)`` to ``(B, n)``."""
        return self.raw(inputs, member)[:, : self.observation_dim]

    def sample(self, raw: Tensor, noise: Tensor | None) -> Tensor:
        """Draw from the predictions that raw outputs represent: ``(B, out)`` to ``(B, n)``.

        Args:
            raw: raw outputs.
            noise: standard normal numbers ``(B, n)``; members that predict points need none.
        """
        mean = raw[:, : self.observation_dim]
        if self.standard_deviation is None or noise is None:
            return mean
        return torch.addcmul(mean, noise, self.standard_deviation(raw))


class ForwardPass:
    """Repeated evaluation of a network's raw outputs for rows that are sorted by member.

    It goes member by member through all layers, so that the hidden units stay in the cache. They
    use the same memory each time (new tensors would soon fill that cache), and what does not depend
    on the inputs is prepared once.

    Args:
        network: the network.
        rows: number of rows per member, in order.
        shared: whether all members read the same rows, the whole input, instead of their own.
        memory: where to keep hidden units; passes that are not used at the same time may share it.
    """

    def __init__(
        self,
        network: PlanningNetwork,
        rows: Sequence[int],
        shared: bool = False,
        memory: dict[tuple[torch.dtype, int], Tensor] | None = None,
    ) -> None:
        memory = {} if memory is None else memory
        self._network, self._copies = network, len(rows) if shared else 1
        self._width = network.weights[0].shape[1]
        last = network.weights[-1]
        # Column by column in memory, since the operations from here on work on columns.
        self._out = last.new_empty(last.shape[2], sum(rows)).t()
        self._members: list[tuple[int, int, Tensor, list[_Layer]]] = []
        for member, end in enumerate(accumulate(rows)):
            if count := rows[member]:
                out = self._out[end - count : end]
                layers = _layers(network, member, out, memory)
                start = 0 if shared else end - count
                self._members.append((start, start + count, network.bias[member], layers))

    def __call__(self, inputs: Tensor) -> Tensor:
        """Raw outputs ``(sum of rows, out)``, float32, valid until the next call.

        Args:
            inputs: observations and actions ``(B, n + m)``.
        """
        read, activation = inputs[:, : self._width], self._network.activation
        for start, end, bias, layers in self._members:
            _, _, weight, out = layers[0]
            torch.addmm(bias, read[start:end], weight, out=out)
            for units, operand, weight, out in layers[1:]:
                activation(units)
                if operand is not units:
                    operand.copy_(units)
                torch.mm(operand, weight, out=out)
        raw = self._out.float()
        if not self._network.affine_in_action:
            return raw
        action = inputs[:, self._width :].repeat(self._copies, 1)
        return affine_output(*affine_coefficients(raw, self._network.action_dim), action)


_Layer = tuple[Tensor, Tensor, Tensor, Tensor]


def _layers(
    network: PlanningNetwork,
    member: int,
    out: Tensor,
    memory: dict[tuple[torch.dtype, int], Tensor],
) -> list[_Layer]:
    """The units read, the same in the weight's precision, the weight, and where to write."""
    layers: list[_Layer] = []
    units = out  # the first layer reads inputs that are not known yet
    for layer, weights in enumerate(network.weights):
        weight, before, operand = weights[member], units, units
        if layer and before.dtype != weight.dtype:
            operand = _part(memory, weight, before.shape, 2)
        units = out
        if layer < len(network.weights) - 1:
            units = _part(memory, weight, (out.shape[0], weight.shape[1]), layer % 2)
        layers.append((before, operand, weight, units))
    return layers


def _part(
    memory: dict[tuple[torch.dtype, int], Tensor], like: Tensor, shape: Sequence[int], slot: int
) -> Tensor:
    """Uninitialised tensor in a slot of the memory, which grows as needed."""
    size = prod(shape)
    found = memory.get((like.dtype, slot))
    if found is None or found.numel() < size:
        found = memory[like.dtype, slot] = like.new_empty(size)
    return found[:size].view(*shape)


def _check_predicts_as_its_weights(kind: type[Any]) -> None:
    """Reject a class whose predictions cannot be made from a copy of weights and statistics."""
    own = ControlAffineDynamics if issubclass(kind, ControlAffineDynamics) else EnsembleDynamics
    if not issubclass(kind, own):  # the wrapper that torch.compile makes passes everything on
        return
    for name in _PREDICTIONS:
        if getattr(kind, name) is not getattr(own, name):
            raise TypeError(
                f"{kind.__name__} has a {name} of its own, which planning and imagination would "
                f"ignore, since they copy the weights of an {own.__name__}: use EnsembleModelEnv"
            )


def _fold_inputs(dynamics: EnsembleDynamics, weights: list[Tensor], biases: list[Tensor]) -> None:
    """Change the weights, in place, to take observation and action in raw units."""
    action = dynamics.action_normalizer
    parts = (dynamics.observation_normalizer, action)
    mean = torch.cat([part.mean for part in parts]).double()
    std = torch.cat([part.std for part in parts]).double()
    width = weights[0].shape[1]
    weights[0] = weights[0] / std[:width, None]
    biases[0] = biases[0] - mean[:width] @ weights[0]
    if not dynamics.affine_in_action:
        return
    for layers in (weights, biases):
        offset, gain = affine_coefficients(layers[-1], dynamics.action_dim)
        gain = gain / action.std.double()[:, None]
        offset = affine_output(offset, gain, -action.mean.double())
        layers[-1] = torch.cat([offset[..., None, :], gain], -2).flatten(-2)


def _fold_biases(weights: list[Tensor], biases: list[Tensor], one: float) -> None:
    """Change the weights, in place, to those of layers with a unit that is always one.

    ``one`` is an input that the activation maps to one. The first layer's bias remains.
    """
    last = len(weights) - 1
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        members, before, after = weight.shape
        rows = before if layer == 0 else weights[layer - 1].shape[2]
        columns = after if layer == last else -(-(after + 1) // ALIGNMENT) * ALIGNMENT
        filled = weight.new_zeros(members, rows, columns)
        filled[:, :before, :after] = weight
        constant = weight.new_zeros(members, columns)
        constant[:, :after] = bias
        if layer < last:
            constant[:, after] = one
        if layer == 0:
            biases[0] = constant
        else:
            filled[:, before] = constant
        weights[layer] = filled
