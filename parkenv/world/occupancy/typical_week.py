"""Weeks for any lot: a typical working one, and one as counted in real car parks, that of a lot file alone."""

import dataclasses

import numpy as np
from scipy.optimize import brentq
from scipy.special import expit, logit

from parkenv.compiled.arrays import FloatArray
from parkenv.forecast.typical_week_fit import LEVEL_SHARES
from parkenv.world.lot import ParkingLot
from parkenv.world.occupancy.process import OccupancyProcess
from parkenv.world.occupancy.real_week_figures import FULLER_THAN, LEVELS, OCCUPIED, PULL, UNEVENNESS
from parkenv.world.week import HOUR_S, WEEK_HOURS

# Logit of the demand in each hour of a weekday; the shape is that of a campus lot: empty at night, full from
# mid-morning to mid-afternoon.
_WEEKDAY_DEMAND = np.array(
    [
        *(-4.0, -4.0, -4.0, -4.0, -4.0, -3.5, -2.5, -0.8, 0.6, 1.3, 1.7, 1.9),
        *(1.8, 1.7, 1.7, 1.5, 1.1, 0.2, -0.8, -1.6, -2.2, -2.8, -3.4, -3.8),
    ]
)
_WEEKEND_DEMAND = np.full(24, -2.5)
_LEAST_DEMAND, _MOST_DEMAND = -12.0, 30.0  # logits
_WEEK_DEMAND = np.concatenate([np.tile(_WEEKDAY_DEMAND, 5), np.tile(_WEEKEND_DEMAND, 2)])


def typical_occupancy(
    lot: ParkingLot,
    *,
    goal: int = 0,
    pull: float = 1.6,
    unevenness: float = 0.6,
    demand: float = 0.0,
    mean_stay_s: float = 2 * 3600.0,
) -> OccupancyProcess:
    """Create an occupancy process for a working week on any lot; `demand` is added at every hour, logits.

    The demand for the slot nearest to the goal is `pull` logits above, and for the farthest below, that of the middle.
    Equally near slots differ by `unevenness`, a standard deviation in logits. It is drawn from a fixed seed, so the
    same lot always has the same popular slots.
    """
    return OccupancyProcess.from_demand(
        attraction(lot, goal, pull, unevenness), _WEEK_DEMAND + demand, mean_stay_s
    )


def attraction(lot: ParkingLot, goal: int, pull: float, unevenness: float) -> FloatArray:
    walk = lot.walk_m(goal)
    span = float(np.ptp(walk)) or 1.0
    nearness = 1.0 - 2.0 * (walk - walk.min()) / span
    noise = np.random.default_rng(lot.n_slots).normal(0.0, unevenness, lot.n_slots)
    return np.asarray(pull * nearness + noise)


def with_full_facilities(process: OccupancyProcess, lot: ParkingLot) -> OccupancyProcess:
    """Return the process in which the slot of a counted facility is taken while all of the facility is.

    In the fullest hour of the week that is as often as all of its spaces are taken, each as the process says; it ends
    when the first of the cars leaves.
    """
    if not lot.is_counted.any():
        return process
    arrival, departure = process.arrival_factor, process.departure_factor
    profile = process.arrival_profile / np.maximum(process.departure_profile, np.finfo(float).tiny)
    odds = np.maximum(arrival / departure * profile.max(), np.finfo(float).tiny)
    p_full = (odds / (1.0 + odds)) ** lot.capacity
    less = np.where(lot.is_counted, p_full / (1.0 - p_full) / odds, 1.0)
    return dataclasses.replace(
        process, arrival_factor=arrival * less * lot.capacity, departure_factor=departure * lot.capacity
    )


def with_event(
    usual: OccupancyProcess, lot: ParkingLot, *, goal: int = 0, share: float, factor: float
) -> OccupancyProcess:
    """Return the process of a day with an event: cars come `factor` times as often to the share nearest to the goal."""
    walk = lot.walk_m(goal)
    near = walk < np.quantile(walk, share)
    return dataclasses.replace(usual, arrival_factor=usual.arrival_factor * np.where(near, factor, 1.0))


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

    Lot, goal, pull and unevenness as in `typical_occupancy`; `fuller_than` is the share of real car parks that are less
    full: 0.5 for the typical one, 0.9 for a busy one. Where counts fall faster than parked cars leave, no car arrives.

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
