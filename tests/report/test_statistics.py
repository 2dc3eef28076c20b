from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_l1.report.statistics import (
    Interval,
    bootstrap_interval,
    final_return,
    interquartile_mean,
    published_spread,
)

SEEDS = st.lists(st.floats(-1e4, 1e4).map(lambda x: round(x, 3)), min_size=3, max_size=12)


def test_final_return_is_the_mean_of_the_last_three() -> None:
    returns = np.array([[100.0, 1.0, 2.0, 6.0], [0.0, 0.0, 0.0, 3.0]])
    assert final_return(returns).tolist() == [3.0, 1.0]
    assert final_return(np.array([2.0, 4.0])) == 3.0


def test_published_spread_is_the_population_std_per_iteration_averaged() -> None:
    # Iterations of std 1, 2 and 3; the first does not count. The std of means would be 1.
    returns = np.array([[50.0, -1.0, 2.0, 2.0], [0.0, 1.0, -2.0, 8.0]])
    assert published_spread(returns) == pytest.approx((1 + 2 + 3) / 3)


@given(SEEDS)
def test_interquartile_mean_against_sorting(values: list[float]) -> None:
    cut = len(values) // 4
    middle = sorted(values)[cut : len(values) - cut]
    assert interquartile_mean(values) == pytest.approx(sum(middle) / len(middle), abs=1e-6)


@settings(max_examples=15, deadline=None)
@given(SEEDS, st.booleans())
def test_interval_is_repeatable_and_within_the_values(
    values: list[float], interquartile: bool
) -> None:
    interval = bootstrap_interval(values, interquartile)
    assert interval == bootstrap_interval(values, interquartile)
    assert interval is not None
    slack = 1e-6
    # Means of equal values differ in their last digit.
    assert min(values) - slack <= interval.low <= interval.high + slack
    assert interval.high <= max(values) + slack


def test_interval_of_many_normal_values_is_that_of_the_textbook() -> None:
    values = np.random.default_rng(1).normal(5.0, 2.0, 400)
    interval = bootstrap_interval(values.tolist())
    half = 1.96 * values.std(ddof=1) / 20
    assert interval is not None
    assert interval.low == pytest.approx(values.mean() - half, abs=0.03)
    assert interval.high == pytest.approx(values.mean() + half, abs=0.03)


def test_interval_is_corrected_for_skewness() -> None:
    values = np.random.default_rng(3).lognormal(0.0, 1.5, 15)
    interval = bootstrap_interval(values.tolist())
    draws = np.random.default_rng(0).choice(values, (20_000, len(values))).mean(axis=1)
    low, high = np.quantile(draws, [0.025, 0.975])
    # A long upper tail is seen too seldom in a sample: the plain percentiles lie too low.
    assert interval is not None
    assert interval.low > low + 0.02 and interval.high > high + 0.2


def test_no_interval_of_fewer_than_three_and_a_point_of_equal_ones() -> None:
    assert bootstrap_interval([]) is None
    assert bootstrap_interval([1.0, 5.0]) is None
    assert bootstrap_interval([4.0, 4.0, 4.0]) == Interval(4.0, 4.0)
    assert bootstrap_interval([4.0, 4.0, 4.0, 4.0], interquartile=True) == Interval(4.0, 4.0)
