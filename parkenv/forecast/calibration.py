"""Spreads of forecasts, calibrated day by day on how often earlier intervals covered what was observed.

A forecast's own spread is multiplied by a scale for the level of the whole day, and one for its hours. After each day
the scale rises where the 90 % interval missed and falls where it did not, per car park and per band of forecast
fullness over all car parks. So the intervals hold 90 % of the days in the long run, whatever is wrong with the model.

References:
    Gibbs, Candès: Adaptive Conformal Inference Under Distribution Shift. NeurIPS 2021.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import expit

from parkenv.compiled.arrays import BoolArray, FloatArray
from parkenv.forecast.counts import HOURS, Counts
from parkenv.forecast.day_forecast import INTERVAL, DayForecast, draw_days

MIN_HOURS = 12
"""Observed hours that a day needs for its mean to count."""
_BANDS = np.array([0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95])
_MISSES = 1.0 - (INTERVAL[1] - INTERVAL[0])
_STEP_CAR_PARK, _STEP_BAND = 0.03, 0.05
_FIRST_STEP = 0.3  # of a car park; the steps fall to the above as its days pass


class _Scale:
    """Logarithms of scales, per car park and band of fullness."""

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


def holds(occupied: FloatArray, low: FloatArray, high: FloatArray, capacity: FloatArray) -> BoolArray:
    """Return whether intervals hold what was observed, up to the half place by which counts are rounded."""
    half = 0.5 / capacity
    return np.asarray((occupied >= low - half) & (occupied <= high + half))


def calibrated(forecast: DayForecast, counts: Counts, until: int | None = None) -> DayForecast:
    """Return the forecast with calibrated spreads.

    Args:
        forecast: of all days from the first one of the counts on.
        counts: what was observed.
        until: index of the first day from which on nothing is learned.
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
            days = draw_days(mean[rows], spread[rows])
            low, high = np.quantile(day_means(days, o), INTERVAL, axis=1)
            covered = holds(day_means(y, o), low, high, places)
            levels.update(rows, band[rows], (~covered).astype(float))
            low, high = np.quantile(days, INTERVAL, axis=1)
            missed = ~holds(y, low, high, places[:, None]) & o
            hours.update(rows, band[rows], missed.sum(axis=1) / o.sum(axis=1))
    return replace(forecast, covariance=covariance)


def _scaled(spread: FloatArray, level: FloatArray, hour: FloatArray) -> FloatArray:
    """Scale the part of covariances (c, 24, 24) that moves with the day's mean level, and what is left of them."""
    row = spread.sum(axis=2) / HOURS
    with_level = row[:, :, None] * row[:, None, :] / row.mean(axis=1)[:, None, None]
    return np.asarray(
        (hour**2)[:, None, None] * (spread - with_level) + (level**2)[:, None, None] * with_level
    )
