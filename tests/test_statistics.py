"""Estimates from stratified samples with control variates: closed forms, and the coverage of their intervals."""

import numpy as np
import pytest
from scipy import stats

from parkenv.studies.statistics import Estimate, mean_interval, mean_over_days, stratified_estimate


def test_intervals_are_students_and_welchs_and_of_days_that_count_as_one():
    """Of days with equally many searches, the interval is Student's of the means of the days."""
    rng = np.random.default_rng(0)
    one, other = rng.normal(3.0, 1.0, 12), rng.normal(1.0, 4.0, 7)
    its, theirs = (stratified_estimate(sample, np.zeros(len(sample)), [1.0]) for sample in (one, other))
    known = stats.ttest_1samp(one, 0.0).confidence_interval()
    assert its.interval() == pytest.approx((one.mean(), known.low, known.high))
    difference = Estimate.combined([(1.0, its), (-1.0, theirs)])
    welch = stats.ttest_ind(one, other, equal_var=False).confidence_interval()
    assert difference.interval()[1:] == pytest.approx((welch.low, welch.high))
    rng = np.random.default_rng(3)
    searches = rng.normal(0.0, 4.0, (7, 1)) + rng.normal(60.0, 2.0, (7, 20))
    days = np.repeat([f"2024-01-0{day}" for day in range(1, 8)], 20)
    known = stats.ttest_1samp(searches.mean(axis=1), 0.0).confidence_interval()
    assert mean_over_days(searches.ravel(), days) == pytest.approx((searches.mean(), known.low, known.high))
    assert mean_over_days(searches[0], [""] * 20) == mean_interval(searches[0])


def test_a_control_variate_that_says_all_leaves_no_error_and_a_stratum_needs_two_values():
    strata, x = np.repeat([0, 1], 5), np.arange(10.0)
    found = stratified_estimate(7.0 - 2.0 * x, strata, [0.9, 0.1], x[:, None], [[1.0], [6.0]])
    assert found.mean == pytest.approx(0.9 * 5.0 + 0.1 * -5.0)
    assert found.error == 0.0
    constant = stratified_estimate(np.full(10, 3.0), strata, [0.9, 0.1], x[:, None], [[1.0], [6.0]])
    assert constant.interval() == pytest.approx((3.0, 3.0, 3.0))
    with pytest.raises(ValueError, match=r"\[2, 1\] values, want at least 2"):
        stratified_estimate([1.0, 2.0, 3.0], [0, 0, 1], [0.5, 0.5])


@pytest.mark.parametrize("heavy", [False, True])
def test_intervals_cover_the_mean_of_the_population_and_the_error_is_the_designs(heavy):
    """Samples of a known population: few, wild worlds in the second stratum, and a control variate in both."""
    rng = np.random.default_rng(1)
    size, shares, counts = 20_000, np.array([0.9, 0.1]), np.array([60, 60])
    parts = np.split(np.arange(size), [int(0.9 * size)])
    control = rng.gamma(4.0, 1.0, size)
    noise = rng.lognormal(0.0, 1.0, size) - np.exp(0.5) if heavy else rng.normal(0.0, 2.0, size)
    spread = np.repeat([1.0, 10.0], [len(part) for part in parts])
    values = np.repeat([50.0, 200.0], [len(part) for part in parts]) + 3.0 * control + spread * noise
    means = [[control[part].mean()] for part in parts]
    strata, covered, errors, found = np.repeat([0, 1], counts), 0, [], []
    for _ in range(1000):
        drawn = np.concatenate([rng.choice(part, n) for part, n in zip(parts, counts, strict=True)])
        estimate = stratified_estimate(values[drawn], strata, shares, control[drawn, None], means)
        _, low, high = estimate.interval()
        covered += low <= values.mean() <= high
        errors.append(estimate.error)
        found.append(estimate.mean)
    sizes = zip(shares, parts, counts, strict=True)
    wanted = np.sqrt(sum(w**2 * (spread * noise)[part].var() / n for w, part, n in sizes))
    assert np.std(found) == pytest.approx(wanted, rel=0.1)
    assert np.mean(np.square(errors)) == pytest.approx(wanted**2, rel=0.1)
    assert (0.9 if heavy else 0.935) <= covered / 1000 <= 0.965
    assert np.mean(found) == pytest.approx(values.mean(), abs=4.0 * wanted / np.sqrt(1000))
