"""Means with confidence intervals, and the summary rows of a comparison."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

from parkenv.world.cost_terms import COST_FIELDS

RESAMPLES = 9999
LEAST_PAIRS = 6
"""Fewest paired searches that can show a difference at 95 %: with five, all of one sign come up once in 16."""
_ROUNDING = 1e-12
"""Relative difference of values that count as the same."""


def mean_interval(values: ArrayLike, confidence: float = 0.95) -> tuple[float, float, float]:
    """Compute the mean and bootstrap interval (bias-corrected and accelerated) of a sample.

    Args:
        values: (n,) numbers.
        confidence: coverage of the interval.

    Returns:
        Mean, lower and upper end. The ends equal the mean if all values are the same but for rounding, and are NaN for
        fewer than two values. The resampling has a fixed seed: equal samples have equal intervals.

    Examples:
        >>> mean_interval([1.0, 1.0, 1.0])
        (1.0, 1.0, 1.0)
    """
    sample = np.asarray(values, dtype=np.float64)
    if len(sample) == 0:
        return np.nan, np.nan, np.nan
    mean = float(sample.mean())
    if len(sample) < 2:
        return mean, np.nan, np.nan
    if np.ptp(sample) <= _ROUNDING * np.abs(sample).max():
        return mean, mean, mean
    from scipy import stats  # processes that run searches do not need it, and it loads slowly

    interval = stats.bootstrap(
        (sample,),
        np.mean,
        confidence_level=confidence,
        n_resamples=RESAMPLES,
        batch=max(1, 4_000_000 // len(sample)),
        rng=np.random.default_rng(0),
    ).confidence_interval
    return mean, float(interval.low), float(interval.high)


def mean_or_nan(values: NDArray[Any]) -> float:
    """Return the mean; NaN of no values."""
    return float(values.mean()) if len(values) else float("nan")


def trimmed_mean_interval(values: ArrayLike, cut: float) -> tuple[float, float, float]:
    """Compute a trimmed mean and its 95 % bootstrap interval (percentiles).

    Args:
        values: (n,) numbers, n >= 1.
        cut: share of the numbers that is left out at either end, rounded down.

    Returns:
        Mean, lower and upper end. The ends are NaN for fewer than two values. The resampling has a fixed seed.

    Examples:
        >>> trimmed_mean_interval([1.0] * 9 + [1000.0], cut=0.1)[0]
        1.0
    """
    sample = np.asarray(values, dtype=np.float64)
    from scipy import stats

    mean = float(stats.trim_mean(sample, cut))
    if len(sample) < 2:
        return mean, np.nan, np.nan
    drawn = sample[np.random.default_rng(0).integers(0, len(sample), (RESAMPLES, len(sample)))]
    low, high = np.percentile(stats.trim_mean(drawn, cut, axis=1), [2.5, 97.5])
    return mean, float(low), float(high)


def ratio_interval(values: ArrayLike, others: ArrayLike) -> tuple[float, float, float]:
    """Compute the ratio of two sums of pairs, such as days, and its 95 % bootstrap interval (percentiles).

    Args:
        values: (n,) numbers, n >= 1.
        others: (n,) numbers.

    Returns:
        Ratio, lower and upper end, NaN for a single pair. The resampling of pairs has a fixed seed.

    Examples:
        >>> ratio_interval([2.0, 4.0], [1.0, 2.0])
        (2.0, 2.0, 2.0)
    """
    mine, theirs = np.asarray(values, dtype=np.float64), np.asarray(others, dtype=np.float64)
    if len(mine) < 2:
        return float(mine.sum() / theirs.sum()), np.nan, np.nan
    drawn = np.random.default_rng(0).integers(0, len(mine), (RESAMPLES, len(mine)))
    low, high = np.percentile(mine[drawn].sum(axis=1) / theirs[drawn].sum(axis=1), [2.5, 97.5])
    return float(mine.sum() / theirs.sum()), float(low), float(high)


class Estimate(NamedTuple):
    """An estimated mean.

    Attributes:
        mean: the mean.
        error: its standard error.
        freedom: degrees of freedom of the standard error.
    """

    mean: float
    error: float
    freedom: float

    def interval(self, confidence: float = 0.95) -> tuple[float, float, float]:
        """Return the mean and the ends of its interval (Student's t)."""
        half = self.error * float(stdtrit(self.freedom, (1.0 + confidence) / 2.0)) if self.error else 0.0
        return self.mean, self.mean - half, self.mean + half

    @classmethod
    def combined(cls, parts: Iterable[tuple[float, Estimate]]) -> Self:
        """Return a weighted sum of independent estimates, given as (weight, estimate) (Welch and Satterthwaite).

        Examples:
            >>> Estimate.combined([(0.5, Estimate(1.0, 0.3, 9.0)), (0.5, Estimate(2.0, 0.4, 9.0))]).mean
            1.5
        """
        weights, estimates = zip(*parts, strict=True)
        means, errors, freedom = np.array(estimates).T
        variances = np.square(np.multiply(weights, errors))
        total = float(variances.sum())
        shares = variances / total if total else np.full(len(variances), 1.0 / len(variances))
        return cls(float(np.dot(weights, means)), total**0.5, float(1.0 / (shares**2 / freedom).sum()))


def stratified_estimate(
    values: ArrayLike,
    strata: ArrayLike,
    shares: ArrayLike,
    controls: ArrayLike | None = None,
    control_means: ArrayLike | None = None,
) -> Estimate:
    """Estimate the mean of a population from a stratified sample, with control variates whose means are known.

    The combined regression estimator: one regression coefficient for each control, which minimises the variance of the
    estimate (Cochran, *Sampling Techniques*, 1977, section 7.10; Owen, *Monte Carlo theory, methods and examples*,
    2013, section 8.9). A single stratum is a plain random sample.

    Args:
        values: (n,) numbers.
        strata: (n,) int, stratum of each; each stratum has at least two.
        shares: (h,) share of each stratum in the population; their sum is 1.
        controls: (n, k) control variates of each, k >= 1; None for none.
        control_means: (h, k) means of the controls over each stratum's whole population; None for no controls.

    Raises:
        ValueError: a stratum has fewer than two values.

    Examples:
        >>> stratified_estimate([1.0, 3.0, 10.0, 10.0], [0, 0, 1, 1], [0.75, 0.25]).mean
        4.0
        >>> stratified_estimate([2.0, 4.0, 6.0], [0, 0, 0], [1.0], [[1.0], [2.0], [3.0]], [[1.5]])[:2]
        (3.0, 0.0)
    """
    sample, weights = np.asarray(values, np.float64), np.asarray(shares, np.float64)
    member = np.asarray(strata)[:, None] == np.arange(len(weights))
    counts = member.sum(axis=0)
    if (counts < 2).any():
        raise ValueError(f"strata have {counts.tolist()} values, want at least 2 each")
    averages = member / counts
    residual, mean = sample - averages @ (member.T @ sample), float(weights @ (averages.T @ sample))
    fitted = 0
    if controls is not None:
        known = np.asarray(controls, np.float64)
        found = averages.T @ known
        # The standard error's own weights make its minimum a least-squares problem.
        scale = (member @ (weights / np.sqrt(counts * (counts - 1.0))))[:, None]
        deviations = scale * (known - member @ found)
        slopes, _, fitted, _ = np.linalg.lstsq(deviations, scale[:, 0] * residual)
        mean += float(weights @ (np.asarray(control_means) - found) @ slopes)
        residual = residual - (known - member @ found) @ slopes
    squares = member.T @ residual**2
    squares[squares <= (_ROUNDING * np.abs(sample).max()) ** 2 * counts] = 0.0
    free = len(sample) - len(weights)
    variances = squares / (counts - 1.0) * free / max(free - fitted, 1)
    return Estimate.combined(
        (w, Estimate(0.0, float(np.sqrt(v / c)), c - 1.0))
        for w, v, c in zip(weights, variances, counts, strict=True)
    )._replace(mean=mean)


def columns_of(name: str, interval: tuple[float, float, float]) -> dict[str, Any]:
    """Return a value and the ends of its interval as columns of a row.

    Examples:
        >>> columns_of("total_s", (2.0, 1.0, 3.0))
        {'total_s': 2.0, 'total_s_ci95': [1.0, 3.0]}
    """
    value, low, high = interval
    return {name: value, f"{name}_ci95": [low, high]}


MEANS = (
    *COST_FIELDS,
    "failed_parks",
    "replans",
    "driven_m",
    "walked_m",
    "slots_passed",
    "occupancy",
    "bound_s",
)
"""Columns of an episode that the table shows as plain means."""


def summarize(
    columns: Mapping[str, Any],
    episodes: Sequence[Mapping[str, Any]],
    first: Sequence[Mapping[str, Any]] | None = None,
    decision_s: ArrayLike = (),
) -> dict[str, Any]:
    """Summarise the results of an agent in one setting as a row of the table.

    Args:
        columns: columns that identify the row: scenario, agent, costs and speeds.
        episodes: rows of `episodes.csv`.
        first: rows of the agent to compare with, for the paired difference; rows with the same seed are paired. None
            for that agent itself.
        decision_s: (k,) wall time of single decisions, s.
    """
    total, parked = _column(episodes, "total_s"), _column(episodes, "parked")
    row: dict[str, Any] = {
        **columns,
        "episodes": len(episodes),
        "parked_fraction": float(parked.mean()),
        **columns_of("total_s", mean_interval(total)),
        "median_s": float(np.median(total)),
        "gave_up_fraction": float(1.0 - parked.mean()),
        "difference_s": 0.0,
        "difference_s_ci95": [0.0, 0.0],
    }
    if first is not None:
        row |= columns_of("difference_s", mean_interval(paired_differences(episodes, first)))
    row |= {name: float(_column(episodes, name).mean()) for name in MEANS}
    row |= columns_of("regret_s", mean_interval(total - _column(episodes, "bound_s")))
    return row | decision_columns(decision_s)


def decision_columns(decision_s: ArrayLike) -> dict[str, float]:
    """Return median and 99th percentile of wall times of decisions, ms, as columns; none without times.

    Args:
        decision_s: (k,) wall time of single decisions, s.
    """
    milliseconds = 1e3 * np.asarray(decision_s, dtype=np.float64)
    if not len(milliseconds):
        return {}
    return {
        "decision_ms": float(np.median(milliseconds)),
        "decision_ms_p99": float(np.quantile(milliseconds, 0.99)),
    }


def paired_differences(
    episodes: Sequence[Mapping[str, Any]], others: Sequence[Mapping[str, Any]]
) -> list[float]:
    """Return the total times minus those of other rows with the same seeds, s."""
    theirs = {e["seed"]: e["total_s"] for e in others}
    return [e["total_s"] - theirs[e["seed"]] for e in episodes if e["seed"] in theirs]


def _column(episodes: Sequence[Mapping[str, Any]], name: str) -> NDArray[np.float64]:
    return np.array([e[name] for e in episodes], dtype=np.float64)
