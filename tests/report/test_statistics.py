from __future__ import annotations

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_l1.report.statistics import (
    Interval,
    final_return,
    interquartile_interval,
    interquartile_mean,
    mean_interval,
    published_spread,
    ratio,
    recovered,
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
@given(SEEDS)
def test_intervals_are_repeatable_and_the_resampled_one_within_the_values(
    values: list[float],
) -> None:
    interval, middle = mean_interval(values), interquartile_interval(values)
    assert interval == mean_interval(values) and middle == interquartile_interval(values)
    assert interval is not None
    # Means of equal values differ in their last digit.
    slack = 1e-6
    assert interval.low <= np.mean(values) + slack and np.mean(values) <= interval.high + slack
    assert (middle is None) == (len(values) < 5)
    if middle is not None:
        assert min(values) - slack <= middle.low <= middle.high + slack
        assert middle.high <= max(values) + slack


@pytest.mark.parametrize("count", [3, 9, 10, 29])
def test_interval_of_few_values_is_students(count: int) -> None:
    values = np.random.default_rng(count).normal(5.0, 2.0, count)
    expected = scipy.stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    interval = mean_interval(values.tolist())
    assert interval is not None
    assert (interval.low, interval.high) == pytest.approx((expected.low, expected.high))


@pytest.mark.parametrize("count", [3, 4, 5])
def test_interval_of_few_normal_values_covers_what_it_says(count: int) -> None:
    samples = np.random.default_rng(0).normal(0.0, 1.0, (2000, count))
    intervals = [mean_interval(values) for values in samples.tolist()]
    covered = np.mean([one is not None and one.low <= 0 <= one.high for one in intervals])
    assert 0.93 < covered < 0.97


@pytest.mark.parametrize("count", [5, 8, 12])
def test_interquartile_interval_has_the_percentiles_of_resampled_means(count: int) -> None:
    values = np.random.default_rng(count).normal(0.0, 10.0, count)
    draws = np.random.default_rng(1).choice(values, (20_000, count))
    cut = count // 4
    middle = np.sort(draws, axis=1)[:, cut : count - cut].mean(axis=1)
    low, high = np.quantile(middle, [0.025, 0.975])
    interval = interquartile_interval(values.tolist())
    assert interval is not None
    assert interval.low == pytest.approx(low, abs=0.4)
    assert interval.high == pytest.approx(high, abs=0.4)


def test_interval_of_many_normal_values_is_that_of_the_textbook() -> None:
    values = np.random.default_rng(1).normal(5.0, 2.0, 400)
    interval = mean_interval(values.tolist())
    half = 1.96 * values.std(ddof=1) / 20
    assert interval is not None
    assert interval.low == pytest.approx(values.mean() - half, abs=0.03)
    assert interval.high == pytest.approx(values.mean() + half, abs=0.03)


def test_interval_is_corrected_for_skewness() -> None:
    values = np.random.default_rng(3).lognormal(0.0, 1.5, 30)
    interval = mean_interval(values.tolist())
    draws = np.random.default_rng(0).choice(values, (20_000, len(values))).mean(axis=1)
    low, high = np.quantile(draws, [0.025, 0.975])
    # A long upper tail is seen too seldom in a sample: the plain percentiles lie too low.
    assert interval is not None
    assert interval.low > low + 0.02 and interval.high > high + 0.2


def test_no_interval_of_too_few_and_a_point_of_equal_ones() -> None:
    assert mean_interval([]) is None
    assert mean_interval([1.0, 5.0]) is None
    assert interquartile_interval([10.0, 300.0, 350.0, 900.0]) is None
    for count in (3, 29, 30):
        assert mean_interval([4.0] * count) == Interval(4.0, 4.0)
    assert interquartile_interval([4.0] * 5) == Interval(4.0, 4.0)


def sample(
    rng: np.random.Generator, policies: int, episodes: int, share: float, gap: float
) -> tuple[list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Policies that differ in all: in their level, in the gap and in what is recovered of it."""
    level, gaps = rng.normal(0, 50, (policies, 1)), gap * rng.uniform(0.5, 1.5, (policies, 1))
    shares = share + rng.normal(0, 0.15, (policies, 1))
    common = level + rng.normal(0, 20, (policies, episodes))

    def noisy(mean: np.ndarray) -> list[np.ndarray]:
        return list(common + mean + rng.normal(0, 10, common.shape))

    return noisy(0 * gaps), noisy(shares * gaps), noisy(gaps)


@pytest.mark.parametrize("policies", [4, 12])
def test_recovered_interval_covers_the_truth_about_as_often_as_it_says(policies: int) -> None:
    rng = np.random.default_rng(0)
    covered, errors = [], []
    for _ in range(400):
        found = recovered(*sample(rng, policies, 10, 0.6, 100.0))
        if found.share is not None and found.interval is not None:
            covered.append(found.interval.low <= 0.6 <= found.interval.high)
            errors.append(found.share - 0.6)
    assert len(covered) > 350
    assert 0.92 < np.mean(covered) < 0.98
    assert abs(np.mean(errors)) < 0.02


def test_interval_of_a_share_is_where_students_test_does_not_tell_it_apart() -> None:
    rng = np.random.default_rng(6)
    gap = rng.normal(10.0, 2.0, 5)
    gain = 0.6 * gap + rng.normal(0.0, 1.0, 5)
    share, interval = ratio(gain, gap)
    assert share == pytest.approx(gain.mean() / gap.mean())
    for end in (interval.low, interval.high):
        assert scipy.stats.ttest_1samp(gain - end * gap, 0.0).pvalue == pytest.approx(0.05)
    # A denominator that may be 0 allows any ratio.
    unbounded = ratio(gain, gap - gap.mean() + 0.1)[1]
    assert (unbounded.low, unbounded.high) == (-np.inf, np.inf)


@pytest.mark.parametrize("policies", [2, 3, 12])
def test_recovered_is_empty_where_there_is_no_gap(policies: int) -> None:
    rng = np.random.default_rng(1)
    empty = []
    for _ in range(400):
        off = rng.normal(0.0, 2.0, (policies, 10))
        oracle = off + rng.normal(0.0, 1.0, (policies, 1))
        empty.append(recovered(list(off), list(off), list(oracle)).share is None)
    assert np.mean(empty) > 0.92
    kept = recovered(*sample(rng, 12, 10, 0.6, 100.0))
    assert kept.gap_interval.low < kept.gap < kept.gap_interval.high and kept.policies == 12


def test_recovered_pairs_episodes() -> None:
    start = np.random.default_rng(2).normal(0, 1e6, (3, 5))
    found = recovered(list(start), list(start + 3.0), list(start + 4.0))
    assert found.share == pytest.approx(0.75)
    assert found.interval is not None
    assert (found.interval.low, found.interval.high) == pytest.approx((0.75, 0.75))
    assert found.gap == pytest.approx(4.0)


def test_recovered_of_one_policy_is_the_bootstrap_over_its_episodes() -> None:
    rng = np.random.default_rng(3)
    off, on, oracle = (rng.normal(mean, 1.0, 30) for mean in (0.0, 2.0, 4.0))
    found = recovered([off], [on], [oracle])
    draws = np.random.default_rng(4).integers(30, size=(20_000, 30))
    shares = (on - off)[draws].mean(1) / (oracle - off)[draws].mean(1)
    assert found.interval is not None and found.policies == 1
    assert (found.interval.low, found.interval.high) == pytest.approx(
        tuple(np.quantile(shares, [0.025, 0.975])), abs=0.01
    )
    assert found == recovered([off], [on], [oracle])


def test_recovered_of_policies_is_over_these_and_not_over_their_episodes() -> None:
    # Two policies that recover all and nothing, without any noise in the episodes.
    off, oracle = [np.zeros(4)] * 2, [np.ones(4)] * 2
    found = recovered(off, [np.zeros(4), np.ones(4)], oracle)
    assert found.interval is not None
    expected = scipy.stats.ttest_1samp([0.0, 1.0], 0.0).confidence_interval()
    values = (found.share, found.interval.low, found.interval.high)
    assert values == pytest.approx((0.5, expected.low, expected.high))


def test_a_gap_of_either_sign_can_be_undone() -> None:
    off, oracle = [np.array([5.0, 6.0, 7.0])], [np.array([1.0, 2.0, 3.0])]
    found = recovered(off, oracle, oracle)
    assert (found.gap, found.share) == pytest.approx((-4.0, 1.0))


@pytest.mark.parametrize("on", [[], [np.zeros(2)], [np.zeros(3), np.zeros(3)]])
def test_recovered_needs_the_same_episodes(on: list[np.ndarray]) -> None:
    with pytest.raises(ValueError, match="the same episodes of the same policies"):
        recovered([np.zeros(3)], on, [np.zeros(3)])
    with pytest.raises(ValueError, match="the same episodes of the same policies"):
        recovered([], [], [])


@pytest.mark.parametrize(("policies", "episodes"), [(1, 1), (1, 2), (2, 1), (1, 3), (3, 1)])
def test_one_or_two_episodes_have_no_share(policies: int, episodes: int) -> None:
    off = [np.arange(episodes) + 0.1 * policy for policy in range(policies)]
    found = recovered(off, [one + 5 for one in off], [one + 10 for one in off])
    assert found.gap == pytest.approx(10)
    if policies * episodes < 3:
        assert found.share is None
        assert (found.gap_interval.low, found.gap_interval.high) == (-np.inf, np.inf)
    else:
        assert found.share == pytest.approx(0.5)
        assert found.gap_interval.low == pytest.approx(10)
