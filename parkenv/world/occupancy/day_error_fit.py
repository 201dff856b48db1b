"""The size of the day error from recorded days: a random effect of the day on the logit scale."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import brentq
from scipy.special import expit, logit

from parkenv.compiled.arrays import FloatArray
from parkenv.world.occupancy.day_error import MAX_LOGITS, DayError
from parkenv.world.occupancy.kernel import MAX_PROBABILITY, MIN_PROBABILITY
from parkenv.world.occupancy.process import OccupancyProcess
from parkenv.world.week import DAY_S, HOUR_S

if TYPE_CHECKING:
    from parkenv.world.occupancy.log import OccupancyLog

# The day error of 99 German car parks over two years: its median, and as many days as give the prior their middle 80 %,
# 0.50 to 1.07. Of a few days, none may have been unusual.
PRIOR_LEVEL, PRIOR_DAYS = 0.77, 5.7
_FAR = 15.0  # logits
_SMALL = 1e-3  # logits
_MOMENT_S = 600.0  # a few minutes make no difference, and a log may have as many times as observations


def fit_day_error(log: OccupancyLog, process: OccupancyProcess) -> DayError:
    """Fit the standard deviation of the level of days around a process (method of moments).

    The shift of a day is the one at which the process expects as many observations of taken slots as there were.

    Args:
        log: the observations.
        process: fitted to them, without a day error.

    Returns:
        The level: the square root of the variance of the shifts over days, less the variance that they have by
        chance, pooled with that of other car parks (a scaled inverse χ² prior). Levels well above
        1 come out a tenth too low, as the centring of days is left out. No slope: a log has no order of slots.
    """
    shifts, variances = [], []
    for day in np.unique(log.day):
        chosen = log.day == day
        rounded = np.minimum(np.round(log.second[chosen] / _MOMENT_S) * _MOMENT_S, DAY_S - 1.0)
        # A day that follows one of its own class.
        moments, which = np.unique((6 if log.weekend[day] else 1) * DAY_S + rounded, return_inverse=True)
        count = np.zeros((moments.size, process.n_slots))
        np.add.at(count, (which, log.slot[chosen]), 1.0)
        # Half an observation of each state keeps the shift finite.
        share = (log.occupied[chosen].sum() + 0.5) / (chosen.sum() + 1)
        shift = brentq(_surplus, -_FAR, _FAR, (process, moments, count, share), xtol=1e-6)
        sides = [_surplus(shift + side, process, moments, count, share) for side in (_SMALL, -_SMALL)]
        shifts.append(shift)
        variances.append(
            _variance(shift, process, moments, count) / ((sides[0] - sides[1]) / (2.0 * _SMALL)) ** 2
        )
    own = max(float(np.var(shifts, ddof=1) - np.mean(variances)), 0.0) if len(shifts) > 1 else 0.0
    days = len(shifts) - 1
    level = np.sqrt((PRIOR_DAYS * PRIOR_LEVEL**2 + days * own) / (PRIOR_DAYS + days))
    return DayError(min(level, MAX_LOGITS))


def _surplus(
    shift: float, process: OccupancyProcess, moments: FloatArray, count: FloatArray, share: float
) -> float:
    """Return by how many more observations of taken slots a shifted day expects than a share of them all."""
    p, _ = _day(process, moments, shift)
    return float((count * p).sum() - share * count.sum())


def _variance(shift: float, process: OccupancyProcess, moments: FloatArray, count: FloatArray) -> float:
    """Return the variance of the number of observations of taken slots on days with this shift."""
    p, remaining = _day(process, moments, shift)
    total, later = 0.0, np.zeros(process.n_slots)
    for k in range(moments.size - 1, -1, -1):
        # Two states of a slot have the covariance p(1 - p) of the earlier one, decayed.
        total += float((count[k] * p[k] * (1.0 - p[k]) * (count[k] + 2.0 * later)).sum())
        later = remaining[k] * (count[k] + later)
    return total


def _day(process: OccupancyProcess, moments: FloatArray, shift: float) -> tuple[FloatArray, FloatArray]:
    """Follow the slots of a process through a day with exp(`shift`) times its odds and arrival rates.

    It begins with the first of `moments`, (k,) s since Monday 00:00, ascending. Returns (k, n) each: P(taken), and the
    part of a difference that is left since the moment before.
    """
    now = float(moments[0])
    p = expit(logit(np.clip(process.marginal(now), MIN_PROBABILITY, MAX_PROBABILITY)) + shift)
    taken, remaining = np.empty((2, moments.size, process.n_slots))
    for k, moment in enumerate(moments):
        gathered = np.zeros(process.n_slots)
        while now < moment:
            hour = int(now // HOUR_S)
            until = min((hour + 1) * HOUR_S, float(moment))
            arrival, departure = process.factors * process.profiles[:, hour, None]
            arrival = arrival * np.exp(shift)
            total = arrival + departure
            equilibrium = arrival / np.maximum(total, np.finfo(float).tiny)
            p = equilibrium + (p - equilibrium) * np.exp(-total * (until - now))
            gathered += total * (until - now)
            now = until
        taken[k], remaining[k] = p, np.exp(-gathered)
    return taken, remaining
