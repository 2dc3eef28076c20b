"""Random shooting: the best of uniformly drawn action sequences."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_l1.checks import check_counts
from torchrl_l1.dynamics.functions import finite_bounds
from torchrl_l1.planning.sequences import (
    Evaluate,
    Plan,
    checked_mean,
    evaluated,
    keep_best,
)


@dataclass
class ShootingConfig:
    """Settings of random shooting.

    Attributes:
        horizon: actions in a sequence, H.
        candidates: sequences drawn per environment, C.
        warm_start: whether the given mean, for example the previous plan, shifted, is one of them;
            published planners draw all of them (arXiv 1708.02596).
    """

    horizon: int = 25
    candidates: int = 2000
    warm_start: bool = True

    def __post_init__(self) -> None:
        check_counts(self, "horizon", "candidates", prefix="shooting.")
        if self.warm_start and self.candidates == 1:
            raise ValueError(
                "shooting.candidates must be at least 2 with a warm start, which is the first of "
                "them"
            )


@torch.no_grad()
def plan(
    evaluate: Evaluate,
    mean: Tensor,
    low: Tensor | float,
    high: Tensor | float,
    config: ShootingConfig,
    generator: torch.Generator | None = None,
) -> Plan:
    """The best of uniform sequences between the bounds and, with a warm start, the given mean.

    Arguments and errors are those of :func:`torchrl_l1.planning.cem.plan`. With a warm start the
    mean is the first candidate; without one it is used only if no return is finite.

    Examples:
        >>> result = plan(
        ...     lambda u: -(u - 0.5).square().sum((-2, -1)),
        ...     mean=torch.zeros(1, 1, 1),
        ...     low=-1.0,
        ...     high=1.0,
        ...     config=ShootingConfig(horizon=1),
        ...     generator=torch.Generator().manual_seed(0),
        ... )
        >>> result.actions.sub(0.5).abs().max() < 0.01
        tensor(True)
    """
    low, high = finite_bounds(low, high, mean)
    mean = checked_mean(mean, config.horizon, low, high)
    shape = (mean.shape[0], config.candidates, *mean.shape[1:])
    uniform = torch.rand(shape, dtype=mean.dtype, device=mean.device, generator=generator)
    sequences = low + uniform * (high - low)
    if config.warm_start:
        sequences[:, 0] = mean
    returns = evaluated(evaluate, sequences)
    worst = torch.full_like(mean[:, 0, 0], -torch.inf)
    best, best_return = keep_best(mean, worst, sequences, returns)
    variance = ((high - low).square() / 12).expand_as(mean)
    return Plan(best, mean, variance, best, best_return)
