"""Intervals against scipy, a published example, and how often they hold the truth."""

import numpy as np
import pytest
from scipy import stats

from kjax.sim.intervals import bootstrap, median_interval, paired_difference, wilson


@pytest.mark.parametrize("count", [1, 16, 64, 256])
def test_a_share_s_interval_is_scipy_s(count):
    for hits in range(count + 1):
        expected = stats.binomtest(hits, count).proportion_ci(0.95, method="wilson")
        np.testing.assert_allclose(wilson(hits, count), expected, atol=1e-12)


def test_shares_that_are_none_are_refused():
    for hits, count in ((-1, 4), (5, 4), (0, 0)):
        with pytest.raises(ValueError, match="hits must lie between 0 and a count"):
            wilson(hits, count)


@pytest.mark.parametrize("count", [6, 7, 16, 64, 255, 256, 5000])
def test_a_median_s_interval_is_that_of_the_binomial_ranks(count):
    values = np.random.default_rng(count).normal(size=count)
    k = int(stats.binom.ppf(0.025, count, 0.5))  # P(X < k) <= 2.5 % < P(X <= k)
    ordered = np.sort(values)
    assert median_interval(values) == (ordered[k - 1], ordered[count - k])
    assert stats.binom.cdf(k - 1, count, 0.5) <= 0.025


def test_a_few_values_have_no_interval():
    assert median_interval([]) is None
    assert median_interval([1.0] * 5) is None  # 2^-4 lie outside of all five
    assert median_interval([3.0, 1.0, 2.0, 6.0, 5.0, 4.0]) == (1.0, 6.0)


def test_a_median_s_interval_holds_the_median_as_often_as_it_says():
    rng = np.random.default_rng(0)
    draws = rng.exponential(size=(4000, 64))
    bounds = np.array([median_interval(row) for row in draws])
    holds = ((bounds[:, 0] <= np.log(2.0)) & (bounds[:, 1] >= np.log(2.0))).mean()
    assert 0.94 < holds < 0.985  # 95 % at least, in steps of single ranks; 4000 draws


def pairs(both, only_first, only_second, neither):
    first = [True] * (both + only_first) + [False] * (only_second + neither)
    second = [True] * both + [False] * only_first + [True] * only_second + [False] * neither
    return first, second


def test_the_difference_of_paired_shares_is_that_of_a_published_table():
    """Bentur 2009 in Fagerland et al., BMC Med. Res. Meth. 13:91: 1, 1, 7, 12 of 21."""
    difference, low, high = paired_difference(*pairs(1, 1, 7, 12)[::-1])
    assert (difference, low, high) == pytest.approx((-0.286, -0.507, -0.026), abs=6e-4)


def test_the_difference_of_paired_shares_is_newcombe_s_published_example():
    """Altman et al., Statistics with Confidence: 20, 12, 2, 16 of 50 give 0.20 (0.056 to 0.329)."""
    first, second = pairs(20, 12, 2, 16)
    difference, low, high = paired_difference(second, first)
    assert difference == pytest.approx(0.20)
    assert (low, high) == (pytest.approx(0.056, abs=5e-4), pytest.approx(0.329, abs=5e-4))
    back, low_back, high_back = paired_difference(first, second)
    assert (back, low_back, high_back) == pytest.approx((-difference, -high, -low))


def test_no_difference_still_has_an_interval():
    difference, low, high = paired_difference(*pairs(256, 0, 0, 0))
    assert difference == 0.0
    assert low < 0.0 < high
    assert high - low < 0.05


@pytest.mark.parametrize("lost", [0.02, 0.1])
def test_the_difference_s_interval_holds_the_truth_as_often_as_it_says(lost):
    """255 of 256 fields crossed one way, some of them lost the other way."""
    rng = np.random.default_rng(1)
    holds = []
    for _ in range(1500):
        first = rng.random(256) < 0.99
        second = first & (rng.random(256) >= lost)
        _, low, high = paired_difference(first, second)
        holds.append(low <= -0.99 * lost <= high)
    assert np.mean(holds) > 0.93


def test_trials_that_are_no_pairs_are_refused():
    with pytest.raises(ValueError, match="equally long"):
        paired_difference([True], [True, False])
    with pytest.raises(ValueError, match="equally long"):
        paired_difference([], [])


def test_a_bootstrap_of_a_mean_is_scipy_s():
    values = np.random.default_rng(1).normal(3.0, 2.0, 40)
    low, high = bootstrap(lambda a: a.mean(axis=1), values, draws=20_000)
    expected = stats.bootstrap(
        (values,), np.mean, n_resamples=20_000, method="percentile", rng=np.random.default_rng(2)
    ).confidence_interval
    # Both ends wander by about 0.01 from one set of draws to another.
    np.testing.assert_allclose((low, high), expected, atol=0.05)


def test_paired_samples_are_drawn_together():
    values = np.random.default_rng(1).uniform(1.0, 9.0, 30)
    interval = bootstrap(lambda a, b: b.mean(axis=1) / a.mean(axis=1), values, 2.0 * values)
    np.testing.assert_allclose(interval, 2.0, rtol=1e-12)  # 2 in every draw; apart, it would spread
