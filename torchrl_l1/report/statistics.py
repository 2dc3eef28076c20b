"""The figures of merit: the paper's rule, interquartile means, and intervals of means."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import bootstrap, t, trim_mean

from torchrl_l1.algorithms.facts import WINDOW

MIN_SAMPLES = 3
"""With fewer values than this there is no interval: the values themselves say more."""

MIN_INTERQUARTILE = 5
"""With fewer values than this there is no interquartile mean."""

_MIN_BOOTSTRAP = 10
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


def mean_interval(values: Sequence[float]) -> Interval | None:
    """95 % interval of the mean.

    Student's t for fewer than ten values, where a bootstrap covers too little: resamples of
    three to five values hold the mean some four times in five. From ten on the bias-corrected
    and accelerated bootstrap, or the percentile one where that is not defined. The resampling
    has a fixed seed: the same values give the same interval.

    Args:
        values: one value per seed.

    Returns:
        the interval, or ``None`` for fewer than three values.

    Examples:
        >>> mean_interval([1.0, 2.0]) is None
        True
        >>> interval = mean_interval([1.0, 2.0, 3.0])
        >>> round(interval.low, 2), round(interval.high, 2)
        (-0.48, 4.48)
    """
    count = len(values)
    if count < MIN_SAMPLES:
        return None
    if count >= _MIN_BOOTSTRAP:
        return _bootstrap(values, np.mean, "BCa") or _bootstrap(values, np.mean, "percentile")
    mean, half = np.mean(values), t.ppf(0.975, count - 1) * np.std(values, ddof=1) / count**0.5
    return Interval(float(mean - half), float(mean + half))


def interquartile_interval(values: Sequence[float]) -> Interval | None:
    """95 % percentile bootstrap interval of the interquartile mean, as in arXiv 2108.13264.

    Args:
        values: one value per seed.

    Returns:
        the interval, or ``None`` for fewer than five values: of three the interquartile mean is
        the mean itself, of four the mean of two.
    """
    if len(values) < MIN_INTERQUARTILE:
        return None
    return _bootstrap(values, interquartile_mean, "percentile")


def mean_summary(name: str, values: Sequence[float]) -> dict[str, Any]:
    """Mean and, of three values or more, its interval."""
    result = {f"{name}_mean": float(np.mean(values))}
    interval = mean_interval(values)
    if interval is not None:
        result |= {f"{name}_low": interval.low, f"{name}_high": interval.high}
    return result


def difference_summary(differences: Sequence[float]) -> dict[str, Any]:
    """Mean and, of five or more, interquartile mean, with intervals; and the differences."""
    if not differences:
        return {}
    result = mean_summary("difference", differences)
    interval = interquartile_interval(differences)
    if interval is not None:
        result["iqm"] = float(interquartile_mean(differences))
        result |= {"iqm_low": interval.low, "iqm_high": interval.high}
    result["differences"] = " ".join(f"{value:.6g}" for value in differences)
    return result


def _bootstrap(
    values: Sequence[float], statistic: Callable[..., Any], method: str
) -> Interval | None:
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
    if not (np.isfinite(interval.low) and np.isfinite(interval.high)):
        return None
    return Interval(float(interval.low), float(interval.high))
