"""Random shooting: the best of uniformly drawn action sequences."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_l1.planning.sequences import (
    Evaluate,
    Plan,
    checked_bounds,
    checked_mean,
    evaluated,
    keep_best,
    require,
)


@dataclass
class ShootingConfig:
    """Settings of random shooting.

    Attributes:
        horizon: actions in a sequence, H.
        candidates: sequences drawn per environment, C.
    """

    horizon: int = 25
    candidates: int = 2000

    def __post_init__(self) -> None:
        """Refuse settings that could only fail later.

        Raises:
            ValueError: naming the setting.
        """
        require(self, horizon=(1, math.inf), candidates=(1, math.inf))


@torch.no_grad()
def plan(
    evaluate: Evaluate,
    mean: Tensor,
    low: Tensor | float,
    high: Tensor | float,
    config: ShootingConfig,
    generator: torch.Generator | None = None,
) -> Plan:
    """The best of the given mean and of sequences uniform between the bounds.

    Arguments and errors are those of :func:`torchrl_l1.planning.cem.plan`; the mean is the
    first candidate.

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
    low, high = checked_bounds(low, high, mean)
    mean = torch.minimum(torch.maximum(checked_mean(mean, config.horizon), low), high)
    shape = (mean.shape[0], config.candidates, *mean.shape[1:])
    uniform = torch.rand(shape, dtype=mean.dtype, device=mean.device, generator=generator)
    sequences = low + uniform * (high - low)
    sequences[:, 0] = mean
    returns = evaluated(evaluate, sequences)
    worst = torch.full_like(mean[:, 0, 0], -torch.inf)
    best, best_return = keep_best(mean, worst, sequences, returns)
    variance = ((high - low).square() / 12).expand_as(mean)
    return Plan(best, mean, variance, best, best_return)
