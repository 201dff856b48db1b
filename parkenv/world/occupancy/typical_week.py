"""Occupancy of a typical working week on any lot: full by day, empty at night, fuller near the goal."""

from __future__ import annotations

import dataclasses

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.world.lot import ParkingLot
from parkenv.world.occupancy.process import OccupancyProcess

# Logit of the demand in each hour of a weekday; the shape is that of a campus lot: empty at night, full from
# mid-morning to mid-afternoon.
_WEEKDAY_DEMAND = np.array(
    [
        *(-4.0, -4.0, -4.0, -4.0, -4.0, -3.5, -2.5, -0.8, 0.6, 1.3, 1.7, 1.9),
        *(1.8, 1.7, 1.7, 1.5, 1.1, 0.2, -0.8, -1.6, -2.2, -2.8, -3.4, -3.8),
    ]
)
_WEEKEND_DEMAND = np.full(24, -2.5)
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
    """Create an occupancy process for a working week on any lot.

    Args:
        lot: the lot.
        goal: index of the goal that drivers want to park near.
        pull: logits by which the demand for the nearest slot is above, and for the farthest below, that of the middle.
        unevenness: standard deviation, in logits, of the demand for equally near slots. It is drawn from a fixed
            seed, so the same lot always has the same popular slots.
        demand: logits added at every hour.
        mean_stay_s: mean parking duration, s.
    """
    return OccupancyProcess.from_demand(
        attraction(lot, goal, pull, unevenness), _WEEK_DEMAND + demand, mean_stay_s
    )


def attraction(lot: ParkingLot, goal: int, pull: float, unevenness: float) -> FloatArray:
    """Return the popularity of the slots, (n_slots,) logits; arguments: see `typical_occupancy`."""
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
    """Create the process for a day with an event: cars arrive more often at the slots nearest to the goal.

    Args:
        usual: the process on ordinary days.
        lot: the lot.
        goal: index of the goal of the event.
        share: fraction of the slots, nearest to the goal, that the event fills.
        factor: factor of their arrival rates.
    """
    walk = lot.walk_m(goal)
    near = walk < np.quantile(walk, share)
    return dataclasses.replace(usual, arrival_factor=usual.arrival_factor * np.where(near, factor, 1.0))
