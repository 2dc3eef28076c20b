"""Statistics of returns: the paper's rule, interquartile means, and intervals of means."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import bootstrap, t, trim_mean

from torchrl_l1.algorithms.facts import WINDOW

MIN_SAMPLES = 3
"""With fewer values there is no interval: the values themselves are more informative."""

MIN_INTERQUARTILE = 5
"""With fewer values there is no interquartile mean."""

_MIN_BOOTSTRAP = 30
_RESAMPLES = 9999


@dataclass(frozen=True)
class Interval:
    """A 95 % confidence interval.

    Examples:
        >>> f"{Interval(-0.5, 1.25):.2f}", f"{Interval(-np.inf, np.inf):.2f}"
        ('[-0.50, 1.25]', 'unbounded')
    """

    low: float
    high: float

    def __format__(self, spec: str) -> str:
        if np.isinf(self.low) and np.isinf(self.high):
            return "unbounded"
        return f"[{self.low:{spec}}, {self.high:{spec}}]"


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


def student_interval(values: Sequence[float]) -> Interval:
    """95 % interval of the mean of two or more values, by Student's t.

    Examples:
        >>> f"{student_interval([1.0, 2.0, 3.0]):.2f}"
        '[-0.48, 4.48]'
    """
    count = len(values)
    mean, half = np.mean(values), t.ppf(0.975, count - 1) * np.std(values, ddof=1) / count**0.5
    return Interval(float(mean - half), float(mean + half))


def mean_interval(values: Sequence[float]) -> Interval | None:
    """95 % interval of the mean.

    Student's t for fewer than 30 values, for which a bootstrap covers too little. From 30 values
    on, the bias-corrected and accelerated bootstrap, or the percentile one where that is undefined.
    Of normal values, Student's t contains the mean in 95 of 100 samples of any size, this
    bootstrap in 84, 89, 92 and 94 of 100 for 5, 10, 20 and 30 values; of log-normal ones, t in 83,
    84, 87 and 88, the bootstrap in 75, 84, 87 and 89. The resampling has a fixed seed: the same
    values give the same interval.

    Args:
        values: one value per seed.

    Returns:
        the interval, or ``None`` for fewer than three values.

    Examples:
        >>> mean_interval([1.0, 2.0]) is None
        True
        >>> mean_interval([1.0, 2.0, 3.0]) == student_interval([1.0, 2.0, 3.0])
        True
    """
    count = len(values)
    if count < MIN_SAMPLES:
        return None
    if count < _MIN_BOOTSTRAP:
        return student_interval(values)
    return _bootstrap(values, np.mean, "BCa") or _bootstrap(values, np.mean, "percentile")


def ratio(above: np.ndarray, below: np.ndarray) -> tuple[float, Interval]:
    """Of the means of paired values, with Fieller's 95 % interval.

    Those are the ratios r for which Student's t test does not tell the mean of above - r below
    from 0: a share is told from 0 where its gain is. Where the mean of below is not told from 0,
    they have no bounds.

    Args:
        above: values ``(n,)``, two or more.
        below: values of the same seeds.

    Examples:
        >>> share, interval = ratio(np.array([4.0, 6.0, 5.0]), np.array([9.0, 10.0, 11.0]))
        >>> f"{share:.2f} {interval:.2f}"
        '0.50 [0.28, 0.72]'
        >>> f"{ratio(np.array([4.0, 6.0, 5.0]), np.array([-1.0, 0.0, 2.0]))[1]:.2f}"
        'unbounded'
    """
    count = len(below)
    means = np.array([np.mean(above), np.mean(below)])
    # They are where (1, -r) c (1, -r)' <= 0.
    c = np.outer(means, means) - t.ppf(0.975, count - 1) ** 2 / count * np.cov(above, below)
    if c[1, 1] <= 0:
        return float(means[0] / means[1]), Interval(-np.inf, np.inf)
    half = np.sqrt(max(c[0, 1] ** 2 - c[0, 0] * c[1, 1], 0.0))
    low, high = (c[0, 1] - half) / c[1, 1], (c[0, 1] + half) / c[1, 1]
    return float(means[0] / means[1]), Interval(float(low), float(high))


def interquartile_interval(values: Sequence[float]) -> Interval | None:
    """95 % percentile bootstrap interval of the interquartile mean, as in arXiv 2108.13264.

    Of normal values it contains the mean in 90, 92 and 93 of 100 samples of 5, 8 and 10.

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

    Every policy has the same weight. With two or more policies the 95 % intervals are over their
    mean returns: Student's t for the gap and :func:`ratio`'s for the share. Simulated with 25
    episodes each of normally distributed policies that differ, the intervals of both contain the
    truth in 94 to 96 of 100 cases with two to ten policies. The price is that few policies seldom
    have a share: for an oracle that gains 1 with a standard deviation of 0.4, 18 of 100 pairs have
    one, 50 of 100 triples, and 95 of 100 sets of five.

    With one policy both are percentile bootstraps over its episodes, with the same draws for all
    three; the resampling has a fixed seed. With fewer than three episodes in total, the interval of
    the gap is unbounded, and there is no share.

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
    gains, gaps = (
        [np.asarray(mine, dtype=np.float64) - bare for mine, bare in zip(one, off, strict=True)]
        for one in (on, oracle)
    )
    gain, gap = (np.array([mine.mean() for mine in one]) for one in (gains, gaps))
    found = Recovery(float(gap.mean()), Interval(-np.inf, np.inf), None, None, len(sizes))
    # One or two episodes tell nothing about other possible ones.
    if sum(sizes) < MIN_SAMPLES:
        return found
    if len(sizes) > 1:
        found = replace(found, gap_interval=student_interval(gap.tolist()))
        if found.gap_interval.low <= 0 <= found.gap_interval.high:
            return found
        share, interval = ratio(gain, gap)
        return replace(found, share=share, interval=interval)
    drawn_gain, drawn_gap = (_resampled(one[0]) for one in (gains, gaps))
    found = replace(found, gap_interval=_percentiles(drawn_gap))
    if found.gap_interval.low <= 0 <= found.gap_interval.high:
        return found
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = drawn_gain / drawn_gap
    interval = _percentiles(shares[np.isfinite(shares)])
    return replace(found, share=float(gain[0] / gap[0]), interval=interval)


def _resampled(values: np.ndarray) -> np.ndarray:
    """Means of resamples, for equal numbers of values of the same ones."""
    size = len(values)
    drawn = np.random.default_rng(0).multinomial(size, [1 / size] * size, size=_RESAMPLES)
    return drawn @ values / size


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
