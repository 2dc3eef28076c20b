"""The cross-entropy method over bounded action sequences, batched over environments."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_l1.checks import check_counts, check_not_negative, check_positive, check_within
from torchrl_l1.dynamics.functions import finite_bounds
from torchrl_l1.planning.sequences import (
    Evaluate,
    Plan,
    checked_mean,
    evaluated,
    initial_variance,
    keep_best,
    select,
)


@dataclass
class CEMConfig:
    """Settings of the cross-entropy method; the defaults are those of arXiv 1805.12114.

    Attributes:
        horizon: actions in a sequence, H.
        candidates: sequences drawn per iteration and environment, C.
        elites: best sequences to which the distribution is fitted.
        iterations: rounds of drawing and fitting, at most.
        momentum: weight of the old mean and variance in the new ones. The more iterations there
            are, the higher it may be: the variance then shrinks more slowly, and less often before
            the mean has arrived.
        initial_variance: initial variance of the actions, action units squared; ``None`` for the
            square of a quarter of each action's range.
        minimum_variance: an environment stops after an iteration in which all its variances are at
            most this, action units squared; 0 runs all iterations.
        return_best: execute the best sequence ever drawn instead of the final mean.
    """

    horizon: int = 25
    candidates: int = 400
    elites: int = 40
    iterations: int = 5
    momentum: float = 0.1
    initial_variance: float | None = None
    minimum_variance: float = 0.001
    return_best: bool = False

    def __post_init__(self) -> None:
        check_counts(self, "horizon", "candidates", "elites", "iterations", prefix="cem.")
        if self.elites >= self.candidates:
            raise ValueError(
                f"cem.elites ({self.elites}) must be fewer than cem.candidates "
                f"({self.candidates}), or returns decide nothing"
            )
        # At 1 nothing would ever be learnt.
        check_within("cem.momentum", self.momentum, "[0, 1)")
        if self.initial_variance is not None:
            check_positive("cem.initial_variance", self.initial_variance)
        check_not_negative("cem.minimum_variance", self.minimum_variance)


@torch.no_grad()
def plan(
    evaluate: Evaluate,
    mean: Tensor,
    low: Tensor | float,
    high: Tensor | float,
    config: CEMConfig,
    generator: torch.Generator | None = None,
) -> Plan:
    """Maximise returns over action sequences.

    Sequences whose return is not finite are never elites; if that holds for all sequences of an
    iteration, mean and variance stay as they are.

    Args:
        evaluate: returns ``(N, C)`` of sequences ``(N, C, H, m)``.
        mean: initial mean ``(N, H, m)``, for example a previous plan, shifted.
        low: lower bounds of the actions, ``(m,)`` or one number.
        high: upper bounds, likewise.
        config: the settings.
        generator: source of randomness; torch's global one if ``None``.

    Raises:
        ValueError: for bounds that are empty, infinite or of the wrong width, a mean or returns
            of the wrong shape, or a ``minimum_variance`` that the first iteration falls below.

    Examples:
        >>> target = torch.tensor([0.5, -0.25])
        >>> result = plan(
        ...     lambda u: -(u - target).square().sum((-2, -1)),
        ...     mean=torch.zeros(1, 3, 2),
        ...     low=-1.0,
        ...     high=1.0,
        ...     config=CEMConfig(horizon=3, iterations=20, minimum_variance=0.0),
        ...     generator=torch.Generator().manual_seed(0),
        ... )
        >>> result.actions[0, 0].round(decimals=2)
        tensor([ 0.5000, -0.2500])
    """
    low, high = finite_bounds(low, high, mean)
    mean = checked_mean(mean, config.horizon, low, high)
    variance = initial_variance(config.initial_variance, low, high, mean)
    widest = variance.max().item()
    if config.iterations > 1 and not config.minimum_variance < widest:
        raise ValueError(
            f"cem.minimum_variance ({config.minimum_variance:g}) must be below the variance that "
            f"plans start from ({widest:g}), or all of them end after one iteration: scale it with "
            "the square of the action's range"
        )
    best, best_return = mean, torch.full_like(mean[:, 0, 0], -torch.inf)
    unfinished = torch.ones_like(best_return, dtype=torch.bool)
    for _ in range(config.iterations):
        sequences = sample_around(mean, variance, low, high, config.candidates, generator)
        returns = evaluated(evaluate, sequences)
        # Further iterations for the rest of the batch must not change a plan that is done.
        returns = torch.where(unfinished[:, None], returns, -torch.inf)
        best, best_return = keep_best(best, best_return, sequences, returns)
        values, index = returns.topk(config.elites, dim=1)
        finite = torch.isfinite(values)
        fitted_mean, fitted_variance = _moments(select(sequences, index), finite)
        update = (unfinished & finite.any(1))[:, None, None]
        keep = config.momentum
        mean = torch.where(update, keep * mean + (1 - keep) * fitted_mean, mean)
        variance = torch.where(update, keep * variance + (1 - keep) * fitted_variance, variance)
        unfinished = unfinished & (variance.amax((1, 2)) > config.minimum_variance)
        if not unfinished.any():
            break
    # Rounding of the sum with momentum may exceed a bound.
    mean = torch.minimum(torch.maximum(mean, low), high)
    actions = best if config.return_best else mean
    return Plan(actions, mean, variance, best, best_return)


def sample_around(
    mean: Tensor,
    variance: Tensor,
    low: Tensor,
    high: Tensor,
    candidates: int,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Sequences ``(N, C, H, m)`` around a mean ``(N, H, m)``, all within the bounds.

    Normal, truncated at two standard deviations, which are first narrowed until they fit between
    the mean and the nearer bound (as in the code of arXiv 1805.12114). The variance of a sample is
    therefore at most 0.774 times the one given.
    """
    room = torch.minimum(mean - low, high - mean).clamp_min(0) / 2
    std = torch.minimum(variance.sqrt(), room).unsqueeze(1)
    shape = (mean.shape[0], candidates, *mean.shape[1:])
    # The inverse of the distribution function; P(|z| < 2) = erf(sqrt 2).
    uniform = torch.rand(shape, dtype=mean.dtype, device=mean.device, generator=generator)
    normal = uniform.mul_(2).sub_(1).mul_(math.erf(math.sqrt(2))).erfinv_().mul_(math.sqrt(2))
    sequences = torch.addcmul(mean.unsqueeze(1), std, normal)
    return torch.minimum(torch.maximum(sequences, low), high)


def _moments(elites: Tensor, counted: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance ``(N, H, m)`` of the elites ``(N, K, H, m)`` that count ``(N, K)``."""
    weight = counted.to(elites.dtype) / counted.sum(1, keepdim=True).clamp_min(1)
    weight = weight[:, :, None, None]
    mean = (weight * elites).sum(1)
    return mean, (weight * (elites - mean.unsqueeze(1)).square()).sum(1)
