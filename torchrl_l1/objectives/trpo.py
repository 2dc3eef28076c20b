"""Trust region policy optimisation: one natural-gradient step with a checked line search."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torch.distributions import Distribution, kl_divergence
from torch.nn.utils import parameters_to_vector

from torchrl_l1.checks import check_counts, check_not_negative, check_positive, check_within


@dataclass
class TRPOConfig:
    """Settings of :func:`trpo_step`.

    Attributes:
        max_kl: bound on the mean KL divergence between old and new policy, in nats.
        damping: multiple of the identity added to the Fisher matrix.
        cg_iterations: conjugate gradient iterations.
        fisher_fraction: share of the samples on which the Fisher matrix is estimated: 0.1 takes
            every tenth in the given order, which must not repeat with that period.
        backtrack_ratio: factor between successive line search candidates.
        max_backtracks: number of candidates to try.
        accept_ratio: smallest accepted ratio of actual to predicted improvement of the surrogate.
    """

    max_kl: float = 0.01
    damping: float = 0.1
    cg_iterations: int = 10
    fisher_fraction: float = 0.1
    backtrack_ratio: float = 0.8
    max_backtracks: int = 15
    accept_ratio: float = 0.1

    def __post_init__(self) -> None:
        check_positive("trpo.max_kl", self.max_kl)
        check_counts(self, "cg_iterations", "max_backtracks", prefix="trpo.")
        check_not_negative("trpo.damping", self.damping)
        check_within("trpo.fisher_fraction", self.fisher_fraction, "(0, 1]")
        check_within("trpo.backtrack_ratio", self.backtrack_ratio, "(0, 1)")
        check_not_negative("trpo.accept_ratio", self.accept_ratio)


@dataclass
class TRPOReport:
    """Outcome of a step: surrogate improvement, KL divergence, whether and after how many trials.

    The KL divergence is NaN if the curvature, or every candidate, is not finite.
    """

    improvement: float
    kl: float
    accepted: bool
    backtracks: int


class NonFiniteAdvantages(ValueError):
    """Advantages are infinite or NaN, so no step can be computed from them."""


def conjugate_gradient(
    matvec: Callable[[Tensor], Tensor], b: Tensor, iterations: int, tolerance: float = 1e-10
) -> Tensor:
    """Approximate solution of ``A x = b`` for symmetric positive definite ``A``.

    Args:
        matvec: ``v -> A v`` for vectors ``(d,)``.
        b: right-hand side ``(d,)``.
        iterations: at most this many products with ``A``.
        tolerance: stop once the squared residual falls to it, or to this share of that of ``b`` if
            ``b`` is shorter than one.
    """
    x = torch.zeros_like(b)
    residual = b.clone()
    direction = b.clone()
    squared = residual @ residual
    tolerance = tolerance * min(1.0, squared.item())
    for _ in range(iterations):
        if squared <= tolerance:
            break
        product = matvec(direction)
        step = squared / (direction @ product)
        x = x + step * direction
        residual = residual - step * product
        previous, squared = squared, residual @ residual
        direction = residual + (squared / previous) * direction
    return x


class TrustRegionProblem(Protocol):
    """What a step needs from a policy and its samples.

    Attributes:
        parameters: the parameters that a step changes, in place.
    """

    parameters: list[Tensor]

    def gradient(self) -> Tensor:
        """Gradient of the surrogate at the parameters before the step, flat ``(d,)``."""
        ...

    def fisher_product(self, vector: Tensor) -> Tensor:
        """Product of the Fisher matrix before the step and a vector ``(d,)``."""
        ...

    def evaluate(self) -> tuple[Tensor, Tensor]:
        """Improvement of the surrogate and mean KL divergence at the current parameters."""
        ...


def trpo_step(
    actor: ProbabilisticTensorDictSequential, data: TensorDictBase, config: TRPOConfig
) -> TRPOReport:
    """Take one TRPO step on ``actor`` in place (arXiv 1502.05477).

    The direction is the natural gradient of the importance-weighted surrogate. The step length
    starts at the edge of the trust region and is reduced until the surrogate improves sufficiently
    and the mean KL divergence stays within its bound. If no candidate passes, the parameters stay
    as they were. :func:`gaussian_trpo_step` does the same faster for one kind of policy.

    Args:
        actor: stochastic policy with a closed-form KL divergence, e.g. Gaussian.
        data: samples of any batch size, ``[B]`` or ``[N, T]``, with ``observation`` (or whatever
            the actor reads), ``action`` and ``advantage`` ``(..., 1)``.
        config: see :class:`TRPOConfig`.

    Raises:
        KeyError: if there is no ``action`` or ``advantage``.
        NonFiniteAdvantages: if the advantages are not finite.
        ValueError: if there is not one density per sample, or the whole actor is frozen.
    """
    for key in ("action", "advantage"):
        if data.get(key, None) is None:
            raise KeyError(
                f"TRPO found no {key!r} in the data, only {sorted(map(str, data.keys()))}: rename "
                "the entry that holds it"
            )
    return take_step(_AutogradProblem(actor, data, config), data["advantage"], config)


def take_step(problem: TrustRegionProblem, advantage: Tensor, config: TRPOConfig) -> TRPOReport:
    """The step of :func:`trpo_step` for any object with gradients and Fisher products.

    Args:
        problem: the problem, whose parameters are changed in place.
        advantage: advantages of the samples, of any shape, to be checked.
        config: settings.

    Raises:
        NonFiniteAdvantages: if the advantages are not finite.
    """
    if not torch.isfinite(advantage).all():
        raise NonFiniteAdvantages("TRPO: non-finite advantages; check rewards and value estimates")

    def product(vector: Tensor) -> Tensor:
        return problem.fisher_product(vector) + config.damping * vector

    parameters = problem.parameters
    gradient = problem.gradient()
    # The gradient's length does not affect the step's, but squares of a tiny one would be lost.
    largest = gradient.abs().max()
    unit = gradient / largest if 0 < largest < 1e-5 else gradient
    direction = conjugate_gradient(product, unit, config.cg_iterations)
    curvature = direction @ product(direction)
    if not torch.isfinite(curvature):
        return TRPOReport(improvement=0.0, kl=math.nan, accepted=False, backtracks=0)
    if not curvature > 0:
        return TRPOReport(improvement=0.0, kl=0.0, accepted=False, backtracks=0)
    full_step = (2 * config.max_kl / curvature).sqrt() * direction
    start = parameters_to_vector(parameters).detach()
    expected = gradient @ full_step
    with torch.no_grad():
        for trial in range(config.max_backtracks):
            ratio = config.backtrack_ratio**trial
            _write(start + ratio * full_step, parameters)
            improvement, kl = problem.evaluate()
            # NaN fails both comparisons, so a broken candidate is never accepted.
            enough = improvement > config.accept_ratio * ratio * expected
            if enough and kl <= config.max_kl:
                return TRPOReport(improvement.item(), kl.item(), True, trial)
        _write(start, parameters)
    # Even the shortest step gives no finite numbers: it was not merely too long.
    known = torch.isfinite(improvement) and torch.isfinite(kl)
    return TRPOReport(0.0, 0.0 if known else math.nan, False, config.max_backtracks)


def _write(vector: Tensor, parameters: list[Tensor]) -> None:
    for part, parameter in zip(
        vector.split([p.numel() for p in parameters]), parameters, strict=True
    ):
        parameter.copy_(part.view_as(parameter))


class _AutogradProblem:
    """A problem for any actor, differentiated by autograd."""

    def __init__(
        self, actor: ProbabilisticTensorDictSequential, data: TensorDictBase, config: TRPOConfig
    ) -> None:
        # How samples were drawn is not part of the surrogate. One row, from which a share is taken.
        data = data.detach().reshape(-1)
        self.actor, self.data, self.config = actor, data, config
        self.parameters = [p for p in actor.parameters() if p.requires_grad]
        if not self.parameters:
            raise ValueError("TRPO: all parameters of the actor are frozen, so nothing can change")
        with torch.no_grad():
            self.old = actor.get_dist(data)
            self.old_log_prob = self.old.log_prob(data["action"])
            wanted = data["advantage"].squeeze(-1).shape
            if self.old_log_prob.shape != wanted:
                raise ValueError(
                    f"TRPO: the actor's {type(self.old).__name__} gives log-densities of shape "
                    f"{tuple(self.old_log_prob.shape)} for advantages of {tuple(wanted)}: use one "
                    "over whole actions, such as IndependentNormal of TorchRL"
                )
            self.before = self._surrogate(self.old)
        self._divergence_gradient: Tensor | None = None

    @torch.enable_grad()
    def gradient(self) -> Tensor:
        surrogate = self._surrogate(self.actor.get_dist(self.data))
        return _flat_gradient(surrogate, self.parameters).detach()

    @torch.enable_grad()
    def fisher_product(self, vector: Tensor) -> Tensor:
        """The Hessian of the mean KL divergence, on some of the samples."""
        if self._divergence_gradient is None:
            states = self.data[:: fisher_stride(self.config)]
            with torch.no_grad():
                fixed = self.actor.get_dist(states)
            divergence = kl_divergence(fixed, self.actor.get_dist(states)).mean()
            self._divergence_gradient = _flat_gradient(
                divergence, self.parameters, create_graph=True
            )
        products = torch.autograd.grad(
            self._divergence_gradient @ vector,
            self.parameters,
            retain_graph=True,
            allow_unused=True,
            materialize_grads=True,
        )
        return torch.cat([part.reshape(-1) for part in products])

    def evaluate(self) -> tuple[Tensor, Tensor]:
        new = self.actor.get_dist(self.data)
        return self._surrogate(new) - self.before, kl_divergence(self.old, new).mean()

    def _surrogate(self, new: Distribution) -> Tensor:
        ratio = (new.log_prob(self.data["action"]) - self.old_log_prob).exp()
        return (ratio * self.data["advantage"].squeeze(-1)).mean()


def fisher_stride(config: TRPOConfig) -> int:
    """The Fisher matrix is estimated on every n-th sample."""
    return max(1, round(1 / config.fisher_fraction))


def _flat_gradient(scalar: Tensor, parameters: list[Tensor], create_graph: bool = False) -> Tensor:
    # The distribution may not depend on all, such as on the head of a value beside it.
    gradients = torch.autograd.grad(
        scalar, parameters, create_graph=create_graph, allow_unused=True, materialize_grads=True
    )
    return torch.cat([gradient.reshape(-1) for gradient in gradients])
