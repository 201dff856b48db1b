"""Forecasts of whole days: joint distributions of the occupancy of car parks at the 24 hours of a day.

The log-odds of the occupancy at the hours of a day are multivariate t: the whole day is off by some amount, and its
hours besides.

Spreads are calibrated day by day on how often earlier intervals covered what was observed. A forecast's own spread is
multiplied by a scale for the level of the whole day, and one for its hours. After each day the scale rises where the
90 % interval missed and falls where it did not, per car park and per band of forecast fullness over all car parks. So
the intervals hold 90 % of the days in the long run, whatever is wrong with the model (Gibbs, Candès: Adaptive Conformal
Inference Under Distribution Shift. NeurIPS 2021).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, ndtri
from scipy.stats import chi2, qmc, t

from parkenv.compiled.arrays import BoolArray, FloatArray
from parkenv.forecast.count_table import HOURS
from parkenv.forecast.counts import Counts

# Degrees of freedom of the t distributions: days that nothing announces are far off more often than normal ones.
FREEDOM = 6.0
INTERVAL = (0.05, 0.95)  # quantiles of the 90 % intervals
DIAGONAL = np.arange(HOURS)
_N_DRAWS = 128
MIN_HOURS = 12  # observed hours that a day needs for its mean to count
_BANDS = np.array([0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95])
_MISSES = 1.0 - (INTERVAL[1] - INTERVAL[0])
_STEP_CAR_PARK, _STEP_BAND = 0.03, 0.05
_FIRST_STEP = 0.3  # of a car park; the steps fall to the above as its days pass


def logits(occupied: FloatArray, capacity: FloatArray) -> FloatArray:
    taken = np.nan_to_num(occupied) * capacity
    return np.asarray(np.log((taken + 0.5) / (np.maximum(capacity - taken, 0.0) + 0.5)))


@cache
def quantiles_of_t() -> FloatArray:
    """Return 32 equally likely values (32,) of the t distribution, scaled to variance 1."""
    values = t.ppf((np.arange(32) + 0.5) / 32, FREEDOM)
    return np.asarray(values / np.sqrt(np.mean(values**2)))


@cache
def _draws() -> FloatArray:
    points = qmc.Sobol(HOURS + 1, rng=0).random(_N_DRAWS // 2)
    normal = ndtri(np.clip(points[:, :HOURS], 1e-6, 1 - 1e-6))
    scale = np.sqrt((FREEDOM - 2.0) / chi2.ppf(np.clip(points[:, HOURS:], 1e-6, 1 - 1e-6), FREEDOM))
    values = np.concatenate([normal * scale, -normal * scale])
    return np.asarray(values / np.sqrt(np.mean(values**2)))


def draw_days(mean: FloatArray, covariance: NDArray[Any]) -> FloatArray:
    """Return equally likely days, (c, k, 24) occupied fractions, of log-odds with means, (c, 24), and covariances."""
    root = np.linalg.cholesky(covariance.astype(float) + 1e-9 * np.eye(HOURS))
    return np.asarray(expit(mean[:, None] + _draws() @ np.swapaxes(root, 1, 2)))


@dataclass(frozen=True, eq=False)
class DayForecast:
    """Forecasts of several days of several car parks, each made before its day."""

    first: int  # index of the first of the d days among those of the counts
    mean: FloatArray  # (c, d, 24) float64, log-odds of the occupancy
    covariance: NDArray[np.float32]  # (c, d, 24, 24) float32, of the log-odds, over the hours of a day
    # (c, d, 24), the expected occupied fraction, where a model states one of its own
    point: FloatArray | None = None

    @property
    def sd(self) -> FloatArray:
        return np.asarray(np.sqrt(self.covariance[:, :, DIAGONAL, DIAGONAL].astype(float)))

    @cached_property
    def level_sd(self) -> FloatArray:
        """(c, d) standard deviation of the day's mean level, log-odds: the day error."""
        return np.asarray(np.sqrt(self.covariance.mean(axis=(2, 3), dtype=float)))

    @property
    def occupancy(self) -> FloatArray:
        if self.point is not None:
            return self.point
        total, sd = np.zeros(self.mean.shape), self.sd
        for value in (values := quantiles_of_t()):
            total += expit(self.mean + sd * value)
        return total / len(values)

    def from_day(self, first: int) -> DayForecast:
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
        z = logits(seen, counts.sample[:, days, None])
        v = self.covariance.astype(float)
        within = np.where(observed[..., :, None] & observed[..., None, :], v, 0.0)
        within[..., DIAGONAL, DIAGONAL] += np.where(observed, 1e-9, 1.0)
        across = np.where(observed[..., None, :], v, 0.0)
        gain = np.swapaxes(np.linalg.solve(within, np.swapaxes(across, -1, -2)), -1, -2)
        mean = self.mean + (gain @ np.where(observed, z - self.mean, 0.0)[..., None])[..., 0]
        rest = v - gain @ np.swapaxes(across, -1, -2)
        rest[..., DIAGONAL, DIAGONAL] = np.maximum(rest[..., DIAGONAL, DIAGONAL], 0.0)
        return replace(self, mean=mean, covariance=rest.astype(np.float32), point=None)


class _Scale:
    def __init__(self, n: int) -> None:
        self._car_park, self._band = np.zeros(n), np.zeros(len(_BANDS) + 1)
        self._days = np.zeros(n)

    def of(self, band: np.ndarray) -> FloatArray:
        return np.asarray(np.exp(self._car_park + self._band[band]))

    def update(self, rows: np.ndarray, band: np.ndarray, missed: FloatArray) -> None:
        excess = missed - _MISSES
        self._days[rows] += 1
        self._car_park[rows] += np.maximum(_STEP_CAR_PARK, _FIRST_STEP / np.sqrt(self._days[rows])) * excess
        n = np.bincount(band, minlength=len(self._band))
        self._band += _STEP_BAND * np.bincount(band, excess, len(self._band)) / np.sqrt(np.maximum(n, 1))


def day_means(fractions: FloatArray, observed: BoolArray) -> FloatArray:
    """Return the means over the observed hours, (..., 24) and (c, 24) to (...); fractions are (c, 24) or (c, k, 24)."""
    weight = observed / np.maximum(observed.sum(axis=-1, keepdims=True), 1)
    weight = weight if fractions.ndim == 2 else weight[:, None]
    return np.asarray((np.nan_to_num(fractions) * weight).sum(axis=-1))


def held(
    mean: FloatArray,
    covariance: NDArray[Any],
    occupied: FloatArray,
    observed: BoolArray,
    capacity: FloatArray,
) -> tuple[BoolArray, BoolArray]:
    """Return whether the 90 % intervals of a day hold what was observed: of its mean (c,), of its hours (c, 24)."""
    draws, half = draw_days(mean, covariance), 0.5 / capacity

    def inside(values: FloatArray, drawn: FloatArray, half: FloatArray) -> BoolArray:
        low, high = np.quantile(drawn, INTERVAL, axis=1)
        return np.asarray((values >= low - half) & (values <= high + half))

    days = inside(day_means(occupied, observed), day_means(draws, observed), half)
    return days, inside(occupied, draws, half[:, None])


def calibrated(forecast: DayForecast, counts: Counts, until: int | None = None) -> DayForecast:
    """Return a forecast, of all days from the first one of the counts on, with calibrated spreads.

    From the day with index `until` on nothing is learned.
    """
    c, d = forecast.mean.shape[:2]
    levels, hours = _Scale(c), _Scale(c)
    covariance = np.empty_like(forecast.covariance)
    for day in range(d):
        mean, spread = forecast.mean[:, day], forecast.covariance[:, day].astype(float)
        band = np.searchsorted(_BANDS, expit(mean).mean(axis=1))
        covariance[:, day] = spread = _scaled(spread, levels.of(band), hours.of(band))
        occupied = counts.seen[:, day]
        observed = np.isfinite(occupied)
        rows = np.flatnonzero(observed.sum(axis=1) >= MIN_HOURS)
        if rows.size and (until is None or day < until):
            y, o, places = occupied[rows], observed[rows], counts.capacity[rows, day]
            days_held, hours_held = held(mean[rows], spread[rows], y, o, places)
            levels.update(rows, band[rows], (~days_held).astype(float))
            hours.update(rows, band[rows], (~hours_held & o).sum(axis=1) / o.sum(axis=1))
    return replace(forecast, covariance=covariance)


def _scaled(spread: FloatArray, level: FloatArray, hour: FloatArray) -> FloatArray:
    """Scale the part of covariances (c, 24, 24) that moves with the day's mean level, and what is left of them."""
    row = spread.sum(axis=2) / HOURS
    with_level = row[:, :, None] * row[:, None, :] / row.mean(axis=1)[:, None, None]
    return np.asarray(
        (hour**2)[:, None, None] * (spread - with_level) + (level**2)[:, None, None] * with_level
    )
