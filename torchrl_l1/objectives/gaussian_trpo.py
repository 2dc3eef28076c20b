"""TRPO for Gaussian policies on tanh networks, whose derivatives are known in closed form."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor, nn

from torchrl_l1.objectives.trpo import TRPOConfig, TRPOReport, fisher_stride, take_step


def is_tanh_network(network: nn.Module) -> bool:
    """Whether a module is a sequence of linear layers with biases and a tanh between each two."""
    if not isinstance(network, nn.Sequential) or len(network) % 2 == 0:
        return False
    layers, activations = list(network)[::2], list(network)[1::2]
    return all(type(layer) is nn.Linear and layer.bias is not None for layer in layers) and all(
        type(activation) is nn.Tanh for activation in activations
    )


def is_frozen(parameter: Tensor) -> bool:
    """Whether it is a parameter that is not to be trained; other tensors are never frozen."""
    return isinstance(parameter, nn.Parameter) and not parameter.requires_grad


@torch.no_grad()
def gaussian_trpo_step(
    mean: nn.Sequential,
    log_std: Tensor,
    inputs: Tensor,
    action: Tensor,
    advantage: Tensor,
    config: TRPOConfig,
) -> TRPOReport:
    r"""The step of :func:`trpo_step` for a normal distribution with independent entries.

    With the network's mean :math:`\mu(x)`, its Jacobian :math:`J` with respect to the weights, and
    the standard deviations :math:`\sigma`, the gradient of the surrogate is that of the
    advantage-weighted log-likelihood, and the Fisher matrix has the two blocks

    .. math::
        \mathbb{E}\,[J^\top \mathrm{diag}(\sigma^{-2}) J] \quad \text{and} \quad 2 I,

    for the weights and for :math:`\log \sigma`. A product with the first block takes one forward
    pass of tangents and one backward pass: the same numbers as from differentiating the KL
    divergence twice, up to rounding, in a fraction of the time.

    All parameters are changed: a policy with frozen parameters needs :func:`trpo_step`.

    Args:
        mean: the network, see :func:`is_tanh_network`; changed in place.
        log_std: logarithm of the standard deviations ``(m,)``; changed in place.
        inputs: the network's inputs ``(B, n)``.
        action: samples ``(B, m)``.
        advantage: advantages of the samples ``(B, 1)``.
        config: see :class:`TRPOConfig`.

    Raises:
        NonFiniteAdvantages: if the advantages are not finite.
        ValueError: if the network is of another kind, a parameter is frozen, or shapes do not fit.

    Examples:
        >>> import torch
        >>> torch.manual_seed(0)  # doctest: +ELLIPSIS
        <torch._C.Generator object at ...>
        >>> mean, log_std = nn.Sequential(nn.Linear(3, 1)), torch.zeros(1)
        >>> x = torch.randn(500, 3)
        >>> u = mean(x) + torch.randn(500, 1)
        >>> report = gaussian_trpo_step(mean, log_std, x, u, u * x[:, :1], TRPOConfig())
        >>> report.accepted, 0 < report.kl <= 0.01
        (True, True)
    """
    if not is_tanh_network(mean):
        raise ValueError(
            "gaussian_trpo_step takes linear layers with tanh in between; use trpo_step for others"
        )
    owned = {**dict(mean.named_parameters()), "log_std": log_std}
    frozen = [name for name, part in owned.items() if is_frozen(part)]
    if frozen:
        raise ValueError(
            f"gaussian_trpo_step changes all parameters, but {frozen[0]} is frozen; use trpo_step"
        )
    problem = _GaussianProblem(mean, log_std, inputs, action, advantage, config)
    return take_step(problem, advantage, config)


class _GaussianProblem:
    """See :class:`~torchrl_l1.objectives.trpo.TrustRegionProblem`."""

    def __init__(
        self,
        mean: Iterable[nn.Module],
        log_std: Tensor,
        inputs: Tensor,
        action: Tensor,
        advantage: Tensor,
        config: TRPOConfig,
    ) -> None:
        layers = [layer for layer in mean if isinstance(layer, nn.Linear)]
        rows, n, m = inputs.shape[0], layers[0].in_features, layers[-1].out_features
        for name, value, expected in (
            ("inputs", inputs, (rows, n)),
            ("action", action, (rows, m)),
            ("advantage", advantage, (rows, 1)),
            ("log_std", log_std, (m,)),
        ):
            if value.shape != expected:
                raise ValueError(
                    f"gaussian_trpo_step: {name} has shape {tuple(value.shape)}, expected "
                    f"{expected} for this network and these inputs"
                )
        self.weights = [layer.weight.detach() for layer in layers]
        self.biases = [layer.bias.detach() for layer in layers]
        self.log_std = log_std.detach()
        network = [part for pair in zip(self.weights, self.biases, strict=True) for part in pair]
        # They share memory with the network's parameters: a step changes those.
        self.parameters = [self.log_std, *network]
        self.shapes = [parameter.shape for parameter in self.parameters]
        self.action, self.advantage = action, advantage.reshape(-1)
        self.units = _forward(inputs, self.weights, self.biases)
        self.loc = self.units.pop()
        self.old_weights = [weight.clone() for weight in self.weights]
        self.old_log_std = self.log_std.clone()
        self.std = self.log_std.exp()
        self.error = (action - self.loc) / self.std
        stride = fisher_stride(config)
        self.states = [units[::stride].contiguous() for units in self.units]
        self.slopes = [1 - units.square() for units in self.states[1:]]
        self.precision = self.std.pow(-2) / self.states[0].shape[0]

    def gradient(self) -> Tensor:
        weight = (self.advantage / self.advantage.shape[0])[:, None]
        weighted = self.error * weight
        by_log_std = (self.error * weighted).sum(0) - weight.sum()
        return torch.cat([by_log_std, *_pull(weighted / self.std, self.old_weights, self.units)])

    def fisher_product(self, vector: Tensor) -> Tensor:
        sizes = [shape.numel() for shape in self.shapes]
        parts = [
            part.view(shape) for part, shape in zip(vector.split(sizes), self.shapes, strict=True)
        ]
        tangent = _push(parts[1::2], parts[2::2], self.old_weights, self.states, self.slopes)
        pulled = _pull(tangent * self.precision, self.old_weights, self.states)
        return torch.cat([2 * parts[0], *pulled])

    def evaluate(self) -> tuple[Tensor, Tensor]:
        loc = _forward(self.units[0], self.weights, self.biases)[-1]
        growth, std = self.log_std - self.old_log_std, self.log_std.exp()
        squares = self.error.square() - ((self.action - loc) / std).square_()
        log_ratio = squares.sum(-1).mul_(0.5).sub_(growth.sum())
        improvement = (log_ratio.expm1_() * self.advantage).mean()
        moved = ((loc - self.loc) / std).square_().sum(-1).mean()
        return improvement, 0.5 * moved + (growth + 0.5 * torch.expm1(-2 * growth)).sum()


def _forward(inputs: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> list[Tensor]:
    """Inputs, hidden units and outputs."""
    units = [inputs]
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        units.append(torch.addmm(bias, units[-1], weight.t()))
        if layer < len(weights) - 1:
            units[-1].tanh_()
    return units


def _push(
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    at: Sequence[Tensor],
    units: Sequence[Tensor],
    slopes: Sequence[Tensor],
) -> Tensor:
    """First-order change of the outputs when weights and biases change, at weights ``at``."""
    tangent = torch.addmm(biases[0], units[0], weights[0].t())
    for layer, slope in enumerate(slopes, 1):
        tangent = tangent.mul_(slope) @ at[layer].t()
        tangent.addmm_(units[layer], weights[layer].t()).add_(biases[layer])
    return tangent


def _pull(by_output: Tensor, at: Sequence[Tensor], units: Sequence[Tensor]) -> list[Tensor]:
    """Gradients of weights and biases from those of the outputs, flat, in the network's order."""
    gradients: list[Tensor] = []
    for layer in range(len(at) - 1, -1, -1):
        gradients += [by_output.sum(0), (by_output.t() @ units[layer]).flatten()]
        if layer:
            # Multiplied by the tanh's slope, in one pass.
            by_output = torch.ops.aten.tanh_backward(by_output @ at[layer], units[layer])
    return gradients[::-1]
