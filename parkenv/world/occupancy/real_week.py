"""A week as counted in real car parks, for any lot: the occupancy of a lot file alone."""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq
from scipy.special import expit, logit

from parkenv.compiled.arrays import FloatArray
from parkenv.forecast.typical_week_fit import LEVEL_SHARES
from parkenv.world.lot import ParkingLot
from parkenv.world.occupancy.process import OccupancyProcess
from parkenv.world.occupancy.real_week_figures import FULLER_THAN, LEVELS, OCCUPIED, PULL, UNEVENNESS
from parkenv.world.occupancy.typical_week import attraction
from parkenv.world.week import HOUR_S, WEEK_HOURS

_LEAST_DEMAND, _MOST_DEMAND = -12.0, 30.0  # logits


def real_week_occupancy(
    lot: ParkingLot,
    *,
    goal: int = 0,
    fuller_than: float = FULLER_THAN,
    pull: float = PULL,
    unevenness: float = UNEVENNESS,
    mean_stay_s: float = 2 * HOUR_S,
) -> OccupancyProcess:
    """Create an occupancy process with the week of real car parks: the mean over the slots at full hours is as counted.

    Args:
        lot: the lot.
        goal: index of the goal that drivers want to park near.
        fuller_than: share of real car parks that are less full: 0.5 for the typical one, 0.9 for a busy one.
        pull: logits by which the demand for the nearest slot is above, and for the farthest below, that of the middle.
        unevenness: standard deviation, in logits, of the demand for equally near slots.
        mean_stay_s: mean parking duration, s. Where counts fall faster than parked cars leave, no car arrives.

    Examples:
        >>> from parkenv.lots import packaged_lot
        >>> process = real_week_occupancy(packaged_lot("campus"))
        >>> tuesday_11_am = (24 + 11) * 3600.0
        >>> round(float(process.marginal(tuesday_11_am).mean()), 3)
        0.824
    """
    popularity = attraction(lot, goal, pull, unevenness)
    wanted = expit(logit(OCCUPIED / 100.0) + np.interp(fuller_than, LEVEL_SHARES, LEVELS))
    return OccupancyProcess.from_demand(popularity, _demand(popularity, wanted, mean_stay_s), mean_stay_s)


def _demand(popularity: FloatArray, wanted: FloatArray, mean_stay_s: float) -> FloatArray:
    """Return the demand of each hour, (168,) logits, that brings the mean over the slots to `wanted` at its end."""
    demand = np.empty(WEEK_HOURS)

    def after(p: FloatArray, logits: float) -> FloatArray:
        """Follow the slots through an hour of constant rates."""
        odds = np.exp(popularity + logits)
        equilibrium = odds / (1.0 + odds)
        return np.asarray(equilibrium + (p - equilibrium) * np.exp(-(1.0 + odds) * HOUR_S / mean_stay_s))

    p = np.full(popularity.size, wanted[-25])
    # Start with the last day, then the whole week: the state at the start is forgotten within a day.
    for hour in (*range(WEEK_HOURS - 24, WEEK_HOURS), *range(WEEK_HOURS)):

        def excess(logits: float, p: FloatArray = p, target: float = wanted[hour]) -> float:
            return float(after(p, logits).mean()) - target

        demand[hour] = (
            _LEAST_DEMAND
            if excess(_LEAST_DEMAND) >= 0.0
            else brentq(excess, _LEAST_DEMAND, _MOST_DEMAND, xtol=1e-4)
        )
        p = after(p, demand[hour])
    return demand
