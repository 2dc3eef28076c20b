"""Statistics of returns: the paper's rule, interquartile means, and intervals of means."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from scipy.stats import bootstrap, t, trim_mean

from torchrl_l1.algorithms.facts import WINDOW

MIN_SAMPLES = 3
"""With fewer values there is no interval: the values themselves are more informative."""

MIN_INTERQUARTILE = 5
"""With fewer values there is no interquartile mean."""

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
        returns: mean returns ``(..., T)`` of T outer iterations; all are used if T < 3.

    Examples:
        >>> float(final_return(np.array([9.0, 1.0, 2.0, 3.0])))
        2.0
    """
    return returns[..., -WINDOW:].mean(axis=-1)


def published_spread(returns: np.ndarray) -> float:
    """The paper's ``±``: population standard deviation over seeds, averaged over iterations.

    The standard deviation is taken in each of the last three outer iterations separately. The
    rule is not in the paper; from the authors' released logs, it reproduces Table 1 of
    arXiv 2403.14860 for four of the five tasks.

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

    Student's t for fewer than ten values, for which a bootstrap covers too little: its intervals of
    three to five values contain the mean some four times in five. From ten values on, the
    bias-corrected and accelerated bootstrap, or the percentile one where that is undefined. The
    resampling has a fixed seed: the same values give the same interval.

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
        the interval, or ``None`` for fewer than five values: for three, the interquartile mean is
        the mean itself, and for four, the mean of two.
    """
    if len(values) < MIN_INTERQUARTILE:
        return None
    return _bootstrap(values, interquartile_mean, "percentile")


def mean_summary(name: str, values: Sequence[float]) -> dict[str, Any]:
    """Mean and, for three or more values, its interval."""
    result = {f"{name}_mean": float(np.mean(values))}
    interval = mean_interval(values)
    if interval is not None:
        result |= {f"{name}_low": interval.low, f"{name}_high": interval.high}
    return result


def difference_summary(differences: Sequence[float]) -> dict[str, Any]:
    """Mean and, for five or more, interquartile mean, with intervals; and the differences."""
    if not differences:
        return {}
    result = mean_summary("difference", differences)
    interval = interquartile_interval(differences)
    if interval is not None:
        result["iqm"] = float(interquartile_mean(differences))
        result |= {"iqm_low": interval.low, "iqm_high": interval.high}
    result["differences"] = " ".join(f"{value:.6g}" for value in differences)
    return result


@dataclass(frozen=True)
class Recovery:
    """The share of an oracle's gain that a controller recovers.

    Attributes:
        gap: mean return with the oracle less that without control.
        gap_interval: interval of the gap.
        share: share of the gap by which the controller is better than none: 1 is as good as the
            oracle, 0 as no control. ``None`` if the interval of the gap includes 0: there is
            nothing to recover, or too little to distinguish from chance.
        interval: interval of the share.
        policies: number of policies that the intervals are over; with one, they are over its
            episodes alone and say nothing about other trainings.
    """

    gap: float
    gap_interval: Interval
    share: float | None
    interval: Interval | None
    policies: int


def recovered(
    off: Sequence[np.ndarray], on: Sequence[np.ndarray], oracle: Sequence[np.ndarray]
) -> Recovery:
    r"""The share :math:`(\bar R_{on} - \bar R_{off}) / (\bar R_{oracle} - \bar R_{off})`.

    Its 95 % interval is that of a paired percentile bootstrap in two stages: policies are drawn
    with replacement, and within each one its episodes; the same draws are used for all three. Every
    policy has the same weight. The resampling has a fixed seed.

    With fewer than three episodes in total, the interval of the gap is unbounded, and there is no
    share. With few policies both intervals are too narrow, as for any bootstrap of few values: for
    an oracle that gains nothing on average, with 25 episodes each of policies that differ, a share
    is found in 24 of 100 cases with three policies, and in 11 with ten.

    If the disturbance increases the return, the gap is negative, and 1 still means that its effect
    is fully undone.

    Args:
        off: returns of the episodes ``(E,)`` of each policy without control.
        on: returns with the controller, of the same policies and from the same resets.
        oracle: returns with the oracle.

    Raises:
        ValueError: if there are no episodes, or their numbers differ.

    Examples:
        >>> off, oracle = np.array([0.0, 1.0, 2.0]), np.array([10.0, 11.0, 12.0])
        >>> recovery = recovered([off], [(off + oracle) / 2], [oracle])
        >>> round(recovery.share, 6), round(recovery.gap_interval.low, 6)
        (0.5, 10.0)
        >>> recovered([off], [oracle], [off]).share is None
        True
    """
    sizes = tuple(map(len, off))
    if not sizes or 0 in sizes or {sizes} != {tuple(map(len, one)) for one in (on, oracle)}:
        raise ValueError("recovered() needs the same episodes of the same policies three times")
    weights = _paired_weights(sizes)
    plain, gain, gap = (
        weights @ np.concatenate([np.asarray(one, dtype=np.float64) for one in returns])
        for returns in (off, on, oracle)
    )
    gain, gap = gain - plain, gap - plain
    # Resamples of one or two values tell nothing about other possible values.
    known = sum(sizes) >= MIN_SAMPLES
    gap_interval = _percentiles(gap[1:]) if known else Interval(-np.inf, np.inf)
    found = Recovery(float(gap[0]), gap_interval, None, None, len(sizes))
    if gap_interval.low <= 0 <= gap_interval.high:
        return found
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = gain / gap
    interval = _percentiles(shares[1:][np.isfinite(shares[1:])])
    return replace(found, share=float(shares[0]), interval=interval)


@cache
def _paired_weights(sizes: tuple[int, ...]) -> np.ndarray:
    """Weights of all episodes: the first row gives the mean, the others resampled means.

    Args:
        sizes: number of episodes of each policy.
    """
    rng = np.random.default_rng(0)
    policies = len(sizes)
    times = rng.multinomial(policies, [1 / policies] * policies, size=_RESAMPLES)
    blocks = []
    for index, size in enumerate(sizes):
        # A policy drawn k times contributes k resamples of its episodes.
        drawn = rng.multinomial(times[:, index] * size, [1 / size] * size)
        blocks.append(np.vstack([np.ones((1, size)), drawn]) / (size * policies))
    return np.hstack(blocks)


def _percentiles(values: np.ndarray) -> Interval:
    low, high = np.quantile(values, [0.025, 0.975])
    return Interval(float(low), float(high))


def _bootstrap(
    values: Sequence[float], statistic: Callable[..., Any], method: str
) -> Interval | None:
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        # An undefined BCa interval shows in its result.
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
