"""Means with confidence intervals, and the summary rows of a comparison."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

from parkenv.world.cost_terms import COST_FIELDS

RESAMPLES = 9999
# Fewest paired searches that can show a difference at 95 %: with five, all of one sign come up once in 16.
LEAST_PAIRS = 6
_ROUNDING = 1e-12  # relative difference of values that count as the same


def mean_interval(values: ArrayLike) -> tuple[float, float, float]:
    """Compute the mean and 95 % bootstrap interval (bias-corrected and accelerated) of a sample.

    Returns:
        Mean, lower and upper end. The ends equal the mean if all values are the same but for rounding, and are NaN for
        fewer than two values. The resampling has a fixed seed: equal samples have equal intervals.
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
        n_resamples=RESAMPLES,
        batch=max(1, 4_000_000 // len(sample)),
        rng=np.random.default_rng(0),
    ).confidence_interval
    return mean, float(interval.low), float(interval.high)


def mean_over_days(values: ArrayLike, days: ArrayLike) -> tuple[float, float, float]:
    """Compute the mean of searches and its 95 % interval where searches of a recorded day share what happened on it.

    Errors are clustered by day, with Student's t of one degree of freedom less than days (Cameron and Miller, *A
    practitioner's guide to cluster-robust inference*, 2015). Of a single day, or without days, the searches count as
    independent; see `mean_interval`.

    Args:
        values: (n,) numbers.
        days: (n,) name of the day of each; all empty for worlds that are drawn anew for each search.

    Examples:
        >>> mean, low, high = mean_over_days([1.0, 1.0, 1.0, 3.0], ["mon", "mon", "mon", "tue"])
        >>> round(mean, 2), round(high - mean, 2)
        (1.5, 9.53)
    """
    sample, (names, day) = np.asarray(values, np.float64), np.unique(np.asarray(days), return_inverse=True)
    if len(names) < 2:
        return mean_interval(sample)
    mean, count = float(sample.mean()), len(names)
    sums = np.bincount(day, sample - mean)
    error = float(np.sqrt(count / (count - 1.0) * (sums**2).sum())) / len(sample)
    return Estimate(mean, error, count - 1.0).interval()


def mean_or_nan(values: NDArray[Any]) -> float:
    return float(values.mean()) if len(values) else float("nan")


def trimmed_mean_interval(values: ArrayLike, cut: float) -> tuple[float, float, float]:
    """Compute a trimmed mean and its 95 % bootstrap interval; the share `cut` is left out at either end."""
    from scipy import stats

    sample = np.asarray(values, dtype=np.float64)
    return _percentile_interval(lambda drawn: stats.trim_mean(sample[drawn], cut, axis=-1), len(sample))


def ratio_interval(values: ArrayLike, others: ArrayLike) -> tuple[float, float, float]:
    """Compute the ratio of two sums of pairs, such as days, and its 95 % bootstrap interval.

    Examples:
        >>> ratio_interval([2.0, 4.0], [1.0, 2.0])
        (2.0, 2.0, 2.0)
    """
    sample, base = np.asarray(values, dtype=np.float64), np.asarray(others, dtype=np.float64)
    return _percentile_interval(
        lambda drawn: sample[drawn].sum(axis=-1) / base[drawn].sum(axis=-1), len(sample)
    )


def _percentile_interval(statistic: Callable[[NDArray[np.int64]], Any], n: int) -> tuple[float, float, float]:
    """Return a statistic of n values and the ends of its bootstrap interval (percentiles), NaN for a single value.

    `statistic` takes indices of the values, (..., n). The resampling has a fixed seed.
    """
    value = float(statistic(np.arange(n)))
    if n < 2:
        return value, np.nan, np.nan
    low, high = np.percentile(statistic(np.random.default_rng(0).integers(0, n, (RESAMPLES, n))), [2.5, 97.5])
    return value, float(low), float(high)


def success_columns(name: str, successes: int, trials: int) -> dict[str, Any]:
    """Return a rate and its 95 % interval (Wilson) as columns of a row."""
    from scipy import stats

    interval = stats.binomtest(successes, trials).proportion_ci(0.95, "wilson")
    return columns_of(name, (successes / trials, float(interval.low), float(interval.high)))


class Estimate(NamedTuple):
    mean: float
    error: float  # its standard error
    freedom: float  # degrees of freedom of the standard error

    def interval(self) -> tuple[float, float, float]:
        """Return the mean and the ends of its 95 % interval (Student's t)."""
        half = self.error * float(stdtrit(self.freedom, 0.975)) if self.error else 0.0
        return self.mean, self.mean - half, self.mean + half

    @classmethod
    def combined(cls, parts: Iterable[tuple[float, Self]]) -> Self:
        """Return a weighted sum of independent estimates, given as (weight, estimate) (Welch and Satterthwaite)."""
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
        observed = averages.T @ known
        # The standard error's own weights make its minimum a least-squares problem.
        scale = (member @ (weights / np.sqrt(counts * (counts - 1.0))))[:, None]
        deviations = scale * (known - member @ observed)
        slopes, _, fitted, _ = np.linalg.lstsq(deviations, scale[:, 0] * residual)
        mean += float(weights @ (np.asarray(control_means) - observed) @ slopes)
        residual = residual - (known - member @ observed) @ slopes
    squares = member.T @ residual**2
    squares[squares <= (_ROUNDING * np.abs(sample).max()) ** 2 * counts] = 0.0
    free = len(sample) - len(weights)
    variances = squares / (counts - 1.0) * free / max(free - fitted, 1)
    return Estimate.combined(
        (w, Estimate(0.0, float(np.sqrt(v / c)), c - 1.0))
        for w, v, c in zip(weights, variances, counts, strict=True)
    )._replace(mean=mean)


def columns_of(name: str, interval: tuple[float, float, float]) -> dict[str, Any]:
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


def summarize(
    columns: Mapping[str, Any],
    episodes: Sequence[Mapping[str, Any]],
    first: Sequence[Mapping[str, Any]] | None = None,
    decision_s: ArrayLike = (),
) -> dict[str, Any]:
    """Return the row of an agent in one setting, which `columns` identify, from its rows of `episodes.csv`.

    Differences are to the rows of the same seeds in `first`; None for the first agent itself. Intervals of replayed
    days are by day; see `mean_over_days`.
    """
    total, parked = _column(episodes, "total_s"), _column(episodes, "parked")
    days = [row.get("day", "") for row in episodes]
    row: dict[str, Any] = {
        **columns,
        "episodes": len(episodes),
        "parked_fraction": float(parked.mean()),
        **columns_of("total_s", mean_over_days(total, days)),
        "median_s": float(np.median(total)),
        "gave_up_fraction": float(1.0 - parked.mean()),
        "difference_s": 0.0,
        "difference_s_ci95": [0.0, 0.0],
    }
    if first is not None:
        row |= columns_of("difference_s", mean_over_days(*paired_differences(episodes, first)))
    row |= {name: float(_column(episodes, name).mean()) for name in MEANS}
    row |= columns_of("regret_s", mean_over_days(total - _column(episodes, "bound_s"), days))
    return row | decision_columns(decision_s)


def decision_columns(decision_s: ArrayLike) -> dict[str, float]:
    """Return median and 99th percentile of wall times of decisions, ms, as columns; none without times."""
    milliseconds = 1e3 * np.asarray(decision_s, dtype=np.float64)
    if not len(milliseconds):
        return {}
    return {
        "decision_ms": float(np.median(milliseconds)),
        "decision_ms_p99": float(np.quantile(milliseconds, 0.99)),
    }


def paired_differences(
    episodes: Sequence[Mapping[str, Any]], others: Sequence[Mapping[str, Any]]
) -> tuple[list[float], list[str]]:
    """Return the differences of total times in the same worlds, s, and the recorded day of each."""
    totals = {e["seed"]: e["total_s"] for e in others}
    pairs = [(e["total_s"] - totals[e["seed"]], e.get("day", "")) for e in episodes if e["seed"] in totals]
    return [difference for difference, _ in pairs], [day for _, day in pairs]


def _column(episodes: Sequence[Mapping[str, Any]], name: str) -> NDArray[np.float64]:
    return np.array([e[name] for e in episodes], dtype=np.float64)
