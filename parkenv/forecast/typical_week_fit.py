"""What counts usually are: the typical week of many car parks, how these differ from it, and days of a class."""

import warnings
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import expit, logit

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.errors import require
from parkenv.forecast.counts import Counts

LEVEL_SHARES = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)  # shares of all car parks whose levels are reported
LEAST_READINGS = 20  # number of readings below which an hour of the week has no mean
BY_DAY = slice(8, 20)  # hours that the level of a car park, or of a day, is measured by
WORKDAYS = 5
_CLIP = 0.005  # an occupancy of exactly 0 or 1 has no logit
_ITERATIONS = 50
_PRIOR_SD, _PRIOR_DAYS = 0.8, 2.0  # logits, assumed between days, with the weight of so many days


@dataclass(frozen=True, eq=False)
class TypicalWeekFit:
    """The week of the typical car park, and how others differ from it."""

    # (7, 24) float64, fraction that is taken at the end of each hour, in the car park of median level
    occupied: FloatArray
    # (7,) float64, logits above that week, of the car parks fuller than `LEVEL_SHARES` of all
    levels: FloatArray
    # (c,) float64, logits, standard deviation over weekdays of a car park's level around its own week
    day_errors: FloatArray


def fit_typical_week(counts: Counts) -> TypicalWeekFit | None:
    """Fit logit P(taken) = week[hour] + level[car park] by medians, which closing hours hardly move.

    None if no hour of the week has `LEAST_READINGS`.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "(Mean of empty slice|All-NaN)", RuntimeWarning)
        mean = _weeks(counts)
        logits = logit(np.clip(mean, _CLIP, 1.0 - _CLIP))
        level, week = np.zeros(len(mean)), np.nanmedian(logits, axis=0)
        if np.isnan(week).all():
            return None
        for _ in range(_ITERATIONS):
            level = np.nanmedian((logits - week)[:, :6, BY_DAY].reshape(len(mean), -1), axis=1)
            level -= np.nanmedian(level)
            week = np.nanmedian(logits - level[:, None, None], axis=0)
    errors = [_day_error(y, week, counts.weekday) for y, week in zip(counts.occupied, mean, strict=True)]
    known = level[np.isfinite(level)]
    return TypicalWeekFit(expit(week), np.quantile(known, LEVEL_SHARES), np.array(errors))


def _weeks(counts: Counts) -> FloatArray:
    weeks = np.full((len(counts.car_parks), 7, 24), np.nan)
    for day in range(7):
        readings = counts.occupied[:, counts.weekday == day]
        enough = np.isfinite(readings).sum(axis=1) >= LEAST_READINGS
        weeks[:, day] = np.where(enough, np.nanmean(readings, axis=1), np.nan)
    return weeks


def _day_error(occupied: FloatArray, week: FloatArray, weekday: IntArray) -> float:
    """Return the standard deviation of the shifts, logits, that give the week the mean of each weekday by day."""
    shifts = []
    for day in np.flatnonzero(weekday < WORKDAYS):
        readings, usual = occupied[day, BY_DAY], week[weekday[day], BY_DAY]
        known = np.isfinite(readings) & (usual > 2 * _CLIP) & (usual < 1.0 - 2 * _CLIP)
        if known.sum() >= 8:
            centre = logit(usual[known])
            wanted = float(np.clip(readings[known].mean(), _CLIP, 1.0 - _CLIP))
            shifts.append(brentq(lambda s, c=centre, w=wanted: expit(c + s).mean() - w, -15.0, 15.0))
    return float(np.std(shifts)) if len(shifts) >= LEAST_READINGS else np.nan


def usual_days(occupied: FloatArray, weekday: IntArray, source: str) -> tuple[FloatArray, FloatArray]:
    """Forecast each day of a car park from all others, before and after it, but not from the day itself.

    From fractions of taken places, (d, 24), and days of the week, (d,): mean and standard deviation of the error of the
    occupancy's logit, (d, 24) each. Monday to Friday, Saturdays and Sundays differ; a day that is the only one of its
    class is forecast from all others.
    """
    y = logit(np.clip(occupied, _CLIP, 1.0 - _CLIP))
    days = np.flatnonzero(np.isfinite(y).any(axis=1))
    require(
        days.size > 1, f"{source}: counted on {days.size} days, want at least two, or more with replay_from"
    )
    kind = np.clip(weekday - 4, 0, 2)
    mean, sd = np.full(y.shape, np.nan), np.full(y.shape, np.nan)
    for day in range(len(y)):
        others = days[days != day]
        alike = others[kind[others] == kind[day]]
        mean[day], sd[day] = _of(y[alike if alike.size else others])
    return mean, sd


def _of(y: FloatArray) -> tuple[FloatArray, FloatArray]:
    known = np.isfinite(y)
    n = known.sum(axis=0)
    mean = np.divide(np.where(known, y, 0.0).sum(axis=0), n, where=n > 0, out=np.full(n.shape, np.nan))
    squares = (np.where(known, y - mean, 0.0) ** 2).sum(axis=0)
    variance = (_PRIOR_DAYS * _PRIOR_SD**2 + squares) / (_PRIOR_DAYS + np.maximum(n - 1, 0))
    sd = np.sqrt(variance * (1.0 + 1.0 / np.maximum(n, 1)))
    hour, at = np.arange(n.size), np.flatnonzero(n)
    return np.interp(hour, at, mean[at]), np.interp(hour, at, sd[at])
