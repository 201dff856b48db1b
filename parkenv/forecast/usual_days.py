"""Forecasts of days drawn from counts: each as the other days of its class usually are."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import require

_CLIP = 0.005  # an occupancy of exactly 0 or 1 has no logit
_PRIOR_SD, _PRIOR_DAYS = (
    0.8,
    2.0,
)  # logits, standard deviation between days, assumed with the weight of so many days


def usual_days(
    occupied: FloatArray, weekday: NDArray[np.int64], source: str
) -> tuple[FloatArray, FloatArray]:
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
