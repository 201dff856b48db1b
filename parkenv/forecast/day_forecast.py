"""Forecasts of whole days: joint distributions of the occupancy of car parks at the 24 hours of a day.

The log-odds of the occupancy at the hours of a day are multivariate t: the whole day is off by some amount, and its
hours besides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, ndtri
from scipy.stats import chi2, qmc, t

from parkenv.compiled.arrays import FloatArray
from parkenv.forecast.counts import HOURS, Counts

FREEDOM = 6.0
"""Degrees of freedom of the t distributions: days that nothing announces are far off more often than normal ones."""
INTERVAL = (0.05, 0.95)
"""Quantiles of the 90 % intervals."""
DIAGONAL = np.arange(HOURS)
_N_DRAWS = 128


def logits(occupied: FloatArray, capacity: FloatArray) -> FloatArray:
    """Return the log-odds of occupied fractions, which half a place keeps finite; NaN becomes 0."""
    taken = np.nan_to_num(occupied) * capacity
    return np.asarray(np.log((taken + 0.5) / (np.maximum(capacity - taken, 0.0) + 0.5)))


@cache
def quantiles_of_t(n: int = 32) -> FloatArray:
    """Return n equally likely values (n,) of the t distribution, scaled to variance 1."""
    values = t.ppf((np.arange(n) + 0.5) / n, FREEDOM)
    return np.asarray(values / np.sqrt(np.mean(values**2)))


@cache
def _draws() -> FloatArray:
    """Return equally likely draws (k, 24) of uncorrelated t variables of variance 1 (a scrambled Sobol sequence)."""
    points = qmc.Sobol(HOURS + 1, rng=0).random(_N_DRAWS // 2)
    normal = ndtri(np.clip(points[:, :HOURS], 1e-6, 1 - 1e-6))
    scale = np.sqrt((FREEDOM - 2.0) / chi2.ppf(np.clip(points[:, HOURS:], 1e-6, 1 - 1e-6), FREEDOM))
    values = np.concatenate([normal * scale, -normal * scale])
    return np.asarray(values / np.sqrt(np.mean(values**2)))


def draw_days(mean: FloatArray, covariance: NDArray[Any]) -> FloatArray:
    """Return equally likely days.

    Args:
        mean: (c, 24) log-odds.
        covariance: (c, 24, 24) of the log-odds.

    Returns:
        (c, k, 24), the occupied fraction at each hour.
    """
    root = np.linalg.cholesky(covariance.astype(float) + 1e-9 * np.eye(HOURS))
    return np.asarray(expit(mean[:, None] + _draws() @ np.swapaxes(root, 1, 2)))


@dataclass(frozen=True, eq=False)
class DayForecast:
    """Forecasts of several days of several car parks, each made before its day.

    Args:
        first: index of the first of the d days among those of the counts.
        mean: (c, d, 24) float64, log-odds of the occupancy.
        covariance: (c, d, 24, 24) float32, of the log-odds, over the hours of a day.
        point: (c, d, 24), the expected occupied fraction, where a model states one of its own.
    """

    first: int
    mean: FloatArray
    covariance: NDArray[np.float32]
    point: FloatArray | None = None

    @property
    def sd(self) -> FloatArray:
        """(c, d, 24) standard deviation of each hour, log-odds."""
        return np.asarray(np.sqrt(self.covariance[:, :, DIAGONAL, DIAGONAL].astype(float)))

    @property
    def level_sd(self) -> FloatArray:
        """(c, d) standard deviation of the day's mean level, log-odds: the day error."""
        return np.asarray(np.sqrt(self.covariance.mean(axis=(2, 3), dtype=float)))

    @property
    def occupancy(self) -> FloatArray:
        """(c, d, 24) expected occupied fraction."""
        if self.point is not None:
            return self.point
        total, sd = np.zeros(self.mean.shape), self.sd
        for value in (values := quantiles_of_t()):
            total += expit(self.mean + sd * value)
        return total / len(values)

    def from_day(self, first: int) -> DayForecast:
        """Return the forecasts of the days from index `first` on."""
        keep = slice(max(first - self.first, 0), None)
        point = None if self.point is None else self.point[:, keep]
        return DayForecast(max(first, self.first), self.mean[:, keep], self.covariance[:, keep], point)

    def given(self, counts: Counts, hour: int) -> DayForecast:
        """Return the forecasts of the same days once the counts of the hours before `hour` have been seen.

        Those hours keep what was seen, with no variance.
        """
        days = slice(self.first, self.first + self.mean.shape[1])
        seen = counts.seen[:, days].copy()
        seen[:, :, hour:] = np.nan
        observed = np.isfinite(seen)
        z = logits(seen, counts.capacity[:, days, None])
        v = self.covariance.astype(float)
        both = observed[..., :, None] & observed[..., None, :]
        within = np.where(both, v, 0.0)
        within[..., DIAGONAL, DIAGONAL] += np.where(observed, 1e-9, 1.0)
        across = np.where(observed[..., None, :], v, 0.0)
        gain = np.swapaxes(np.linalg.solve(within, np.swapaxes(across, -1, -2)), -1, -2)
        error = np.where(observed, z - self.mean, 0.0)
        mean = self.mean + (gain @ error[..., None])[..., 0]
        rest = v - gain @ np.swapaxes(across, -1, -2)
        rest[..., DIAGONAL, DIAGONAL] = np.maximum(rest[..., DIAGONAL, DIAGONAL], 0.0)
        return replace(self, mean=mean, covariance=rest.astype(np.float32), point=None)
