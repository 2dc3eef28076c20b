"""Trust region policy optimisation: one natural-gradient step with a checked line search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torch.distributions import Distribution, kl_divergence
from torch.nn.utils import parameters_to_vector, vector_to_parameters


@dataclass
class TRPOConfig:
    """Settings of :func:`trpo_step`.

    Attributes:
        max_kl: bound on the mean KL divergence between old and new policy, in nats.
        damping: multiple of the identity added to the Fisher matrix.
        cg_iterations: conjugate gradient iterations.
        fisher_fraction: share of the samples on which the Fisher matrix is estimated.
        backtrack_ratio: factor between successive line search candidates.
        max_backtracks: number of candidates tried.
        accept_ratio: least ratio of actual to predicted improvement of the surrogate.
    """

    max_kl: float = 0.01
    damping: float = 0.1
    cg_iterations: int = 10
    fisher_fraction: float = 0.1
    backtrack_ratio: float = 0.8
    max_backtracks: int = 15
    accept_ratio: float = 0.1

    def __post_init__(self) -> None:
        for name in ("max_kl", "cg_iterations", "max_backtracks"):
            if getattr(self, name) <= 0:
                raise ValueError(f"trpo.{name} must be positive, got {getattr(self, name)}")
        if self.damping < 0:
            raise ValueError(f"trpo.damping must not be negative, got {self.damping}")
        if not 0 < self.fisher_fraction <= 1:
            raise ValueError(f"trpo.fisher_fraction must be in (0, 1], got {self.fisher_fraction}")
        if not 0 < self.backtrack_ratio < 1:
            raise ValueError(f"trpo.backtrack_ratio must be in (0, 1), got {self.backtrack_ratio}")


@dataclass
class TRPOReport:
    """What a step did: surrogate improvement, KL reached, whether and after how many trials."""

    improvement: float
    kl: float
    accepted: bool
    backtracks: int


def conjugate_gradient(
    matvec: Callable[[Tensor], Tensor], b: Tensor, iterations: int, tolerance: float = 1e-10
) -> Tensor:
    """Approximate solution of ``A x = b`` for symmetric positive definite ``A``.

    Args:
        matvec: ``v -> A v`` for vectors ``(d,)``.
        b: right-hand side ``(d,)``.
        iterations: at most this many products with ``A``.
        tolerance: stop once the squared residual falls below it.
    """
    x = torch.zeros_like(b)
    residual = b.clone()
    direction = b.clone()
    squared = residual @ residual
    for _ in range(iterations):
        if squared < tolerance:
            break
        product = matvec(direction)
        step = squared / (direction @ product)
        x = x + step * direction
        residual = residual - step * product
        previous, squared = squared, residual @ residual
        direction = residual + (squared / previous) * direction
    return x


def trpo_step(
    actor: ProbabilisticTensorDictSequential, data: TensorDictBase, config: TRPOConfig
) -> TRPOReport:
    """Take one TRPO step on ``actor`` in place (arXiv 1502.05477).

    The direction is the natural gradient of the importance-weighted surrogate; the step length
    starts at the trust region's edge and is shortened until both the surrogate improves as it
    should and the mean KL divergence stays within bounds. If no candidate passes, the
    parameters stay as they were.

    Args:
        actor: stochastic policy with a closed-form KL divergence, e.g. Gaussian.
        data: samples ``[B]`` with ``observation`` (whatever the actor reads), ``action`` and
            ``advantage`` ``(B, 1)``.
        config: see :class:`TRPOConfig`.

    Raises:
        ValueError: if the advantages are not finite.
    """
    advantage = data["advantage"].squeeze(-1)
    if not torch.isfinite(advantage).all():
        raise ValueError("TRPO: non-finite advantages; check rewards and value estimates")
    parameters = [p for p in actor.parameters() if p.requires_grad]
    with torch.no_grad():
        old = actor.get_dist(data)
        old_log_prob = old.log_prob(data["action"])

    def surrogate(new: Distribution) -> Tensor:
        return ((new.log_prob(data["action"]) - old_log_prob).exp() * advantage).mean()

    gradient = _flat_gradient(surrogate(actor.get_dist(data)), parameters).detach()
    fisher_product = _fisher_product(actor, data, parameters, config)
    direction = conjugate_gradient(fisher_product, gradient, config.cg_iterations)
    curvature = direction @ fisher_product(direction)
    if not (torch.isfinite(curvature) and curvature > 0):
        return TRPOReport(improvement=0.0, kl=0.0, accepted=False, backtracks=0)
    full_step = (2 * config.max_kl / curvature).sqrt() * direction
    start = parameters_to_vector(parameters).detach()
    expected = gradient @ full_step
    with torch.no_grad():
        before = surrogate(old)
        for trial in range(config.max_backtracks):
            ratio = config.backtrack_ratio**trial
            vector_to_parameters(start + ratio * full_step, parameters)
            new = actor.get_dist(data)
            improvement = surrogate(new) - before
            kl = kl_divergence(old, new).mean()
            # NaN fails both comparisons, so a broken candidate is never accepted.
            enough = improvement > config.accept_ratio * ratio * expected
            if enough and kl <= config.max_kl:
                return TRPOReport(improvement.item(), kl.item(), True, trial)
        vector_to_parameters(start, parameters)
    return TRPOReport(improvement=0.0, kl=0.0, accepted=False, backtracks=config.max_backtracks)


def _flat_gradient(scalar: Tensor, parameters: list[Tensor], create_graph: bool = False) -> Tensor:
    gradients = torch.autograd.grad(scalar, parameters, create_graph=create_graph)
    return torch.cat([gradient.reshape(-1) for gradient in gradients])


def _fisher_product(
    actor: ProbabilisticTensorDictSequential,
    data: TensorDictBase,
    parameters: list[Tensor],
    config: TRPOConfig,
) -> Callable[[Tensor], Tensor]:
    """``v -> (F + damping I) v``: the Hessian of the mean KL at the current parameters."""
    stride = max(1, round(1 / config.fisher_fraction))
    states = data[::stride]
    with torch.no_grad():
        fixed = actor.get_dist(states)
    divergence = kl_divergence(fixed, actor.get_dist(states)).mean()
    gradient = _flat_gradient(divergence, parameters, create_graph=True)

    def product(vector: Tensor) -> Tensor:
        hessian_vector = torch.autograd.grad(gradient @ vector, parameters, retain_graph=True)
        flat = torch.cat([part.reshape(-1) for part in hessian_vector])
        return flat + config.damping * vector

    return product
