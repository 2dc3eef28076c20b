"""The figures of merit: the paper's rule, interquartile means, bootstrap intervals."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import bootstrap, trim_mean

__all__ = [
    "MIN_SAMPLES",
    "WINDOW",
    "Interval",
    "bootstrap_interval",
    "final_return",
    "interquartile_mean",
    "published_spread",
]

WINDOW = 3
"""Outer iterations at the end of a run that its return is the mean of, as in the paper."""

MIN_SAMPLES = 3
"""With fewer values than this there is no interval: the values themselves say more."""

_RESAMPLES = 9999


@dataclass(frozen=True)
class Interval:
    """A 95 % confidence interval."""

    low: float
    high: float


def final_return(returns: np.ndarray) -> np.ndarray:
    """Mean over the last three outer iterations.

    Args:
        returns: mean returns ``(..., T)`` of T outer iterations; all of them where T < 3.

    Examples:
        >>> float(final_return(np.array([9.0, 1.0, 2.0, 3.0])))
        2.0
    """
    return returns[..., -WINDOW:].mean(axis=-1)


def published_spread(returns: np.ndarray) -> float:
    """The paper's ``±``: population standard deviation over seeds, averaged over iterations.

    The standard deviation is taken in each of the last three outer iterations by itself. The
    rule is not in the paper; it reproduces what arXiv 2403.14860, Table 1 prints for four of the
    five tasks from the authors' released logs.

    Args:
        returns: mean returns ``(seeds, T)``.

    Examples:
        >>> published_spread(np.array([[0.0, 1.0, 2.0], [2.0, 5.0, 2.0]]))
        1.0
    """
    return float(returns[:, -WINDOW:].std(axis=0).mean())


def interquartile_mean(values: np.ndarray | Sequence[float], axis: int = 0) -> Any:
    """Mean of the middle half, arXiv 2108.13264.

    Examples:
        >>> float(interquartile_mean([-100.0, 1.0, 3.0, 100.0]))
        2.0
    """
    return trim_mean(values, 0.25, axis=axis)


def _mean(values: np.ndarray, axis: int = 0) -> Any:
    return np.mean(values, axis=axis)


def bootstrap_interval(values: Sequence[float], interquartile: bool = False) -> Interval | None:
    """Bias-corrected and accelerated bootstrap interval of the mean, 95 %.

    Where that is not defined (values that are all equal, say) the percentile interval takes its
    place. The resampling has a fixed seed: the same values give the same interval.

    Args:
        values: one value per seed.
        interquartile: the interval of the interquartile mean instead.

    Returns:
        the interval, or ``None`` for fewer than three values.

    Examples:
        >>> bootstrap_interval([1.0, 2.0]) is None
        True
        >>> bootstrap_interval([2.0, 2.0, 2.0])
        Interval(low=2.0, high=2.0)
    """
    if len(values) < MIN_SAMPLES:
        return None
    statistic = interquartile_mean if interquartile else _mean
    for method in ("BCa", "percentile"):
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            # That BCa is not defined is seen from its result.
            warnings.simplefilter("ignore")
            interval = bootstrap(
                (np.asarray(values, dtype=np.float64),),
                statistic,
                n_resamples=_RESAMPLES,
                confidence_level=0.95,
                method=method,
                vectorized=True,
                rng=np.random.default_rng(0),
            ).confidence_interval
        if np.isfinite(interval.low) and np.isfinite(interval.high):
            break
    return Interval(float(interval.low), float(interval.high))
