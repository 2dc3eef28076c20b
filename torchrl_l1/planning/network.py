"""A frozen copy of an ensemble in the precision that plans fastest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

from torchrl_l1.dynamics import DeterministicHead, EnsembleDynamics

Precision = Literal["auto", "float32", "bfloat16"]

# In place: at the sizes of planning a fresh tensor costs as much as the activation.
_ACTIVATIONS: dict[str, Callable[[Tensor], Tensor]] = {
    "relu": torch.relu_,
    "tanh": torch.tanh_,
    "silu": lambda z: nn.functional.silu(z, inplace=True),
}


def resolve_precision(
    precision: str, device: torch.device | str = "cpu"
) -> Literal["float32", "bfloat16"]:
    """``"auto"`` becomes ``"bfloat16"`` on processors that multiply it natively.

    Raises:
        ValueError: for an unknown precision.
    """
    if precision == "float32":
        return "float32"
    if precision == "bfloat16":
        return "bfloat16"
    if precision != "auto":
        raise ValueError(f"precision must be 'auto', 'float32' or 'bfloat16', got {precision!r}")
    if torch.device(device).type != "cpu":
        return "float32"
    # Only recent versions of torch tell.
    tell: Callable[[], dict[str, Any]] = getattr(torch.cpu, "get_capabilities", dict)
    capabilities = tell()
    native = capabilities.get("amx_bf16") or capabilities.get("avx512_bf16")
    return "bfloat16" if native else "float32"


@dataclass(frozen=True)
class PlanningNetwork:
    """Weights of an ensemble's elites, copied once per plan.

    The products between hidden layers, nearly all of the work, run in the precision asked for;
    input layer, output layer, statistics and states stay float32. The statistics of the inputs
    are folded into the weights. Members are numbered by their place among the elites.

    Attributes:
        weights: per layer ``(k, in, out)``.
        biases: per layer ``(k, out)``.
        observation_dim: number of observations, n.
        action_dim: number of actions, m.
        change_mean: of the change of state ``(n,)``, raw units.
        change_std: likewise.
        activation: activation of the hidden layers, in place.
        standard_deviation: maps a member's raw output to the standard deviation of its
            prediction, normalised units; ``None`` if it predicts points.

    Examples:
        >>> model = EnsembleDynamics(3, 1, members=2, hidden=(8, 8))
        >>> network = PlanningNetwork.from_dynamics(model, "bfloat16")
        >>> [weight.dtype for weight in network.weights]
        [torch.float32, torch.bfloat16, torch.float32]
        >>> network.change(torch.zeros(5, 4), member=1).shape
        torch.Size([5, 3])
    """

    weights: list[Tensor]
    biases: list[Tensor]
    observation_dim: int
    action_dim: int
    change_mean: Tensor
    change_std: Tensor
    activation: Callable[[Tensor], Tensor]
    standard_deviation: Callable[[Tensor], Tensor] | None = None

    @classmethod
    @torch.no_grad()
    def from_dynamics(
        cls, dynamics: EnsembleDynamics, precision: Precision = "float32"
    ) -> PlanningNetwork:
        """Copy the elites of an ensemble.

        Raises:
            ValueError: for an unknown precision.
        """
        device = dynamics.change_normalizer.mean.device
        hidden = getattr(torch, resolve_precision(precision, device))
        elites = dynamics.elites.to(device)
        weights = [weight[elites].double() for weight in dynamics.network.weights]
        biases = [bias[elites, 0].double() for bias in dynamics.network.biases]
        _fold_inputs(dynamics, weights, biases)
        # A layer's product is in the hidden precision if it reads and writes hidden units.
        last = len(weights) - 1
        dtypes = [hidden if 0 < layer < last else torch.float32 for layer in range(last + 1)]
        point = isinstance(dynamics.head, DeterministicHead)
        return cls(
            weights=[weight.to(dtype) for weight, dtype in zip(weights, dtypes, strict=True)],
            biases=[bias.to(dtype) for bias, dtype in zip(biases, dtypes, strict=True)],
            observation_dim=dynamics.observation_dim,
            action_dim=dynamics.action_dim,
            change_mean=dynamics.change_normalizer.mean.to(torch.float32, copy=True),
            change_std=dynamics.change_normalizer.std.to(torch.float32, copy=True),
            activation=_ACTIVATIONS[dynamics.network.activation],
            standard_deviation=None if point else dynamics.head.standard_deviation,
        )

    @property
    def members(self) -> int:
        """Number of elites, k."""
        return self.weights[0].shape[0]

    def raw(self, inputs: Tensor, member: int) -> Tensor:
        """A member's raw output from observations and actions ``(B, n + m)``: ``(B, out)``."""
        width = self.weights[0].shape[1]
        z = inputs[:, :width]
        last = len(self.weights) - 1
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            z = torch.addmm(bias[member], z.to(weight.dtype), weight[member])
            if layer < last:
                # The activation runs in the precision of the hidden layer that follows.
                z = self.activation(z.to(self.weights[min(layer + 1, last - 1)].dtype))
        if width == inputs.shape[1]:
            return z
        # A control-affine model: the network sees the observation and gives offset and gain.
        rows = z.unflatten(1, (1 + self.action_dim, -1))
        return rows[:, 0] + (rows[:, 1:] * inputs[:, width:, None]).sum(1)

    def change(self, inputs: Tensor, member: int) -> Tensor:
        """A member's mean prediction, normalised: ``(B, n + m)`` to ``(B, n)``."""
        return self.raw(inputs, member)[:, : self.observation_dim]

    def sampled_change(
        self, inputs: Tensor, member: int, generator: torch.Generator | None = None
    ) -> Tensor:
        """A draw from a member's prediction, normalised: ``(B, n + m)`` to ``(B, n)``."""
        raw = self.raw(inputs, member)
        mean = raw[:, : self.observation_dim]
        if self.standard_deviation is None:
            return mean
        noise = torch.randn(mean.shape, generator=generator, device=mean.device)
        return torch.addcmul(mean, noise, self.standard_deviation(raw))


def _fold_inputs(dynamics: EnsembleDynamics, weights: list[Tensor], biases: list[Tensor]) -> None:
    """Change the weights, in place, to those that take observation and action in raw units."""
    action = dynamics.action_normalizer
    parts = (dynamics.observation_normalizer, action)
    mean = torch.cat([part.mean for part in parts]).double()
    std = torch.cat([part.std for part in parts]).double()
    width = weights[0].shape[1]
    weights[0] = weights[0] / std[:width, None]
    biases[0] = biases[0] - mean[:width] @ weights[0]
    if width == mean.shape[0]:
        return
    for layers in (weights, biases):
        rows = layers[-1].unflatten(-1, (1 + dynamics.action_dim, -1))
        gain = rows[..., 1:, :] / action.std.double()[:, None]
        offset = rows[..., :1, :] - (action.mean.double()[:, None] * gain).sum(-2, keepdim=True)
        layers[-1] = torch.cat([offset, gain], -2).flatten(-2)
