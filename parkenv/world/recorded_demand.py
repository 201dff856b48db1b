"""Arrivals and stays of the cars in a log of occupancy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from parkenv.compiled.arrays import BoolArray, FloatArray
from parkenv.errors import InputError
from parkenv.world.arrivals import PoissonArrivals
from parkenv.world.durations import QUANTILES, EmpiricalTime, parked_share
from parkenv.world.occupancy.log import OccupancyLog
from parkenv.world.week import DAY_HOURS, DAY_PERIODS, HOUR_S, PERIOD_S


def recorded_demand(log: OccupancyLog, n_slots: int, kind: str) -> tuple[PoissonArrivals, EmpiricalTime]:
    """Return the arrivals and stays with which occupancy comes out as recorded; see `Demand.fitted_to`."""
    cars = _cars_of(log, kind)
    if not cars.ended.any():
        raise InputError(f"{log.source}: no car comes and leaves on a {kind}, so no demand can be fitted")
    stays = _stay_quantiles(cars.stay_s, cars.ended)
    seen = cars.seen > 0
    edges, times = np.arange(DAY_HOURS + 1.0) * HOUR_S, np.arange(1.0 * DAY_PERIODS) * PERIOD_S
    filled = parked_share(EmpiricalTime(stays), edges, times)[seen]
    weight = np.sqrt(cars.seen[seen])
    per_slot, _ = nnls(filled * weight[:, None], cars.arrived[seen] / cars.seen[seen] * weight)
    hours = per_slot.nonzero()[0]
    window = float(hours[0] * HOUR_S), float((hours[-1] + 1) * HOUR_S)
    return PoissonArrivals(tuple(map(float, n_slots * per_slot)), *window), EmpiricalTime(stays)


class _RecordedCars(NamedTuple):
    """The cars that arrived in a log.

    Attributes:
        stay_s: (k,) float64, s, until they left or were observed last.
        ended: (k,) bool, whether they were observed to leave.
        arrived: (48,) float64, over all slots and days: slots taken by a car that arrived, at full and half hours.
        seen: (48,) float64, slots observed before and after that time on that day.
    """

    stay_s: FloatArray
    ended: BoolArray
    arrived: FloatArray
    seen: FloatArray


def _cars_of(log: OccupancyLog, kind: str) -> _RecordedCars:
    if kind not in ("weekday", "weekend"):
        raise InputError(f"class of day is {kind!r}, want weekday or weekend")
    grid = np.arange(DAY_PERIODS) * PERIOD_S
    arrived, seen = np.zeros(DAY_PERIODS), np.zeros(DAY_PERIODS)
    stays, ended = [], []
    for day in np.flatnonzero(log.weekend == (kind == "weekend")):
        for slot in range(len(log.slot_ids)):
            record = day * len(log.slot_ids) + slot
            rows = slice(log.first[record], log.first[record + 1])
            occupied, since, last_s = log.occupied[rows], log.from_s[rows], log.second[rows][-1:]
            if not len(occupied):
                continue
            changes = np.flatnonzero(np.diff(occupied.astype(np.int8))) + 1
            inside = (grid >= log.second[rows][0]) & (grid <= last_s)
            state = occupied[np.maximum(np.searchsorted(since, grid, side="right") - 1, 0)]
            came = changes[occupied[changes]]
            seen += inside
            if len(came):
                arrived += inside & state & (grid >= since[came[0]])
            ends = np.concatenate((since[changes], last_s))
            for i in np.flatnonzero(occupied[changes]):
                if ends[i + 1] > ends[i]:
                    stays.append(ends[i + 1] - ends[i])
                    ended.append(i + 1 < len(changes))
    return _RecordedCars(np.array(stays), np.array(ended, dtype=np.bool_), arrived, seen)


def _stay_quantiles(stays: FloatArray, ended: BoolArray) -> tuple[float, ...]:
    """Return stays at equally likely quantiles, s, from stays of which some are known from below only.

    The estimator of Kaplan and Meier; beyond the longest stay whose end was observed, an exponential law whose mean is
    the time stayed for each observed end.
    """
    times, ends = np.unique(stays[ended], return_counts=True)
    staying = len(stays) - np.searchsorted(np.sort(stays), times, side="left")
    survival = np.cumprod(1.0 - ends / staying)
    levels = 1.0 - (np.arange(QUANTILES) + 0.5) / QUANTILES
    # The first time at which at most this fraction still stays.
    at = np.searchsorted(-survival, -levels, side="left")
    last, mean = times[-1], float(stays.sum() / ended.sum())
    left = max(float(survival[-1]), levels[-1] / 2)
    beyond = last + mean * np.log(np.maximum(left / levels, 1.0))
    return tuple(map(float, np.where(at < len(times), times[np.minimum(at, len(times) - 1)], beyond)))
