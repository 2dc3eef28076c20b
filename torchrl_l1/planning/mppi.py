"""Model-predictive path integral control: all candidates count, weighted by their returns."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_l1.checks import check_counts, check_positive
from torchrl_l1.dynamics.functions import finite_bounds
from torchrl_l1.planning.sequences import (
    Evaluate,
    Plan,
    checked_mean,
    evaluated,
    initial_variance,
    keep_best,
)


@dataclass
class MPPIConfig:
    """Settings of model-predictive path integral control.

    Attributes:
        horizon: actions in a sequence, H.
        candidates: sequences drawn per iteration and environment, C.
        iterations: rounds of drawing and averaging.
        temperature: difference in return by which a sequence's weight falls to 1/e.
        variance: variance of the actions before they are clipped, action units squared; ``None``
            for the square of a quarter of each action's range.
        return_best: execute the best sequence ever drawn instead of the final mean.
    """

    horizon: int = 25
    candidates: int = 400
    iterations: int = 1
    temperature: float = 1.0
    variance: float | None = None
    return_best: bool = False

    def __post_init__(self) -> None:
        check_counts(self, "horizon", "candidates", "iterations", prefix="mppi.")
        check_positive("mppi.temperature", self.temperature)
        if self.variance is not None:
            check_positive("mppi.variance", self.variance)


@torch.no_grad()
def plan(
    evaluate: Evaluate,
    mean: Tensor,
    low: Tensor | float,
    high: Tensor | float,
    config: MPPIConfig,
    generator: torch.Generator | None = None,
) -> Plan:
    r"""Move the mean to the average of sequences weighted by :math:`e^{R / \lambda}`.

    The information-theoretic update of arXiv 1707.02342 without its control cost, on normal samples
    that are clipped to the bounds. Arguments and errors are those of
    :func:`torchrl_l1.planning.cem.plan`. Sequences whose return is not finite have zero weight.

    Examples:
        >>> result = plan(
        ...     lambda u: -(u - 0.5).square().sum((-2, -1)),
        ...     mean=torch.zeros(1, 2, 1),
        ...     low=-1.0,
        ...     high=1.0,
        ...     config=MPPIConfig(horizon=2, iterations=20, temperature=0.01),
        ...     generator=torch.Generator().manual_seed(0),
        ... )
        >>> result.actions.sub(0.5).abs().max() < 0.05
        tensor(True)
    """
    low, high = finite_bounds(low, high, mean)
    mean = checked_mean(mean, config.horizon, low, high)
    variance = initial_variance(config.variance, low, high, mean)
    std = variance.sqrt().unsqueeze(1)
    shape = (mean.shape[0], config.candidates, *mean.shape[1:])
    best, best_return = mean, torch.full_like(mean[:, 0, 0], -torch.inf)
    for _ in range(config.iterations):
        normal = torch.randn(shape, dtype=mean.dtype, device=mean.device, generator=generator)
        sequences = torch.addcmul(mean.unsqueeze(1), std, normal)
        sequences = torch.minimum(torch.maximum(sequences, low), high)
        returns = evaluated(evaluate, sequences)
        best, best_return = keep_best(best, best_return, sequences, returns)
        highest = returns.amax(1, keepdim=True)
        found = torch.isfinite(highest)
        # Relative to the highest, so that the exponentials do not overflow.
        exponents = (returns - torch.where(found, highest, 0.0)) / config.temperature
        weights = torch.where(found, exponents, 0.0).softmax(1)
        average = (weights[:, :, None, None] * sequences).sum(1)
        mean = torch.where(found[:, :, None], average, mean)
    # Rounding of the weights' sum may exceed a bound.
    mean = torch.minimum(torch.maximum(mean, low), high)
    return Plan(best if config.return_best else mean, mean, variance, best, best_return)
