"""Worlds that follow counts of car parks: hourly ones by a process; finer ones, and those of kerbs, by a log."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq
from scipy.special import expit, logit

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.errors import InputError, require
from parkenv.files.known_names import SAME_SLOTS
from parkenv.forecast.counts import Counts
from parkenv.forecast.event_table import Events
from parkenv.forecast.logistic_normal import NormalQuadrature
from parkenv.world.lot import ParkingLot
from parkenv.world.occupancy.arrival_window import DAY_NAMES, ArrivalWindow
from parkenv.world.occupancy.day_error import DayError
from parkenv.world.occupancy.kernel import MAX_PROBABILITY, MIN_PROBABILITY, PROCESS_KIND
from parkenv.world.occupancy.log import OccupancyLog, weekday_of
from parkenv.world.occupancy.process import (
    MAX_RATE,
    Arrival,
    Course,
    Forecast,
    OccupancyModel,
    OccupancyProcess,
    ProcessWorld,
)
from parkenv.world.occupancy.recorded import read_mapping, some_mapped
from parkenv.world.week import DAY_HOURS, DAY_S, HOUR_S

# Bounds of the mean occupancy of a lot: beyond them, slots would be taken or free for ever.
LEAST, MOST = 0.002, 0.998
_QUADRATURE = NormalQuadrature.gauss_hermite(9)
_PASSES = 3  # over the day; the curve of a process is periodic


@dataclass(frozen=True, eq=False)
class CountedOccupancy(OccupancyModel):
    """Replays days of a car park of which only the number of taken places is known.

    Slot s is taken with the log-odds `attraction[s]` plus the level of the moment, such that the mean over the lot
    follows the counts: the occupancy counted in hour h is that at its end. Within these means, slots are two-state
    chains as in an `OccupancyProcess`, a process for each day. The forecast is made in the same way, from the curve
    that a forecasting model predicts for the day.
    """

    kind: ClassVar[int] = PROCESS_KIND
    recorded: ClassVar[bool] = True
    days: tuple[str, ...]  # (d,) ISO dates, ascending, of the days that can be replayed
    # (d, 24) float64, fraction of the places that was taken in each hour of these days; NaN if unknown
    occupied: FloatArray
    level: FloatArray  # (d, 24) float64, logit, predicted mean of that fraction's logit
    level_sd: FloatArray  # (d, 24) float64, logits, standard deviation of the prediction's error
    attraction: FloatArray  # (n,) float64, logit, popularity of the lot's slots
    # s, mean parking duration; shorter in hours in which the lot empties faster
    mean_stay_s: float = 2 * HOUR_S
    source: str = "counts"  # name of the counts in messages
    _worlds: dict[str, OccupancyProcess] = field(init=False, repr=False, default_factory=dict)
    _forecasts: dict[str, OccupancyProcess] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        shape = (len(self.days), DAY_HOURS)
        require(self.days, f"{self.source}: no days to replay, want at least one")
        for name in ("occupied", "level", "level_sd"):
            array = np.asarray(getattr(self, name), float)
            require(array.shape == shape, f"{self.source}: {name} has shape {array.shape}, want {shape}")
            object.__setattr__(self, name, array)
        object.__setattr__(self, "attraction", np.asarray(self.attraction, float))

    @property
    def n_slots(self) -> int:
        return int(self.attraction.size)

    def days_in(self, window: ArrivalWindow) -> list[str]:
        first = int(window.start_s // HOUR_S)
        end = max(math.ceil(window.end_s / HOUR_S), first + 1)
        counted = np.flatnonzero(np.isfinite(self.occupied[:, first:end]).all(axis=1))
        days = [self.days[i] for i in counted if weekday_of(self.days[i]) in window.weekdays]
        if not days:
            names = ",".join(DAY_NAMES[weekday] for weekday in window.weekdays)
            raise InputError(
                f"{self.source}: no day on {names} was counted from {first}:00 to {end}:00, want at least one"
            )
        return days

    def world(self, key: np.uint64, arrival: Arrival) -> ProcessWorld:
        return ProcessWorld(self.process_of(arrival.day), key, arrival)

    def process_of(self, day: str) -> OccupancyProcess:
        if day not in self._worlds:
            curve = self.occupied[self._index(day)]
            known = np.flatnonzero(np.isfinite(curve))
            curve = np.interp(np.arange(DAY_HOURS), known, curve[known])
            self._worlds[day] = process_of_curve(self.attraction, curve, self.mean_stay_s)
        return self._worlds[day]

    def course(self, arrival: Arrival, times: ArrayLike) -> Course:
        """Return the course of the occupancy on the arrival's day, linear between the counts; see `OccupancyModel`."""
        process = self.process_of(arrival.day)
        hours = arrival.time // DAY_S * DAY_S + np.arange(DAY_HOURS + 1) * HOUR_S
        counted = process.course(arrival, hours).occupied
        return process.course(arrival, times)._replace(
            occupied=np.interp(np.asarray(times, np.float64), hours, counted)
        )

    def forecast(self, arrival: Arrival) -> Forecast:
        index, day = self._index(arrival.day), arrival.day
        if day not in self._forecasts:
            curve, _ = _QUADRATURE.expit(self.level[index], self.level_sd[index])
            self._forecasts[day] = process_of_curve(self.attraction, curve, self.mean_stay_s)
        own = self._forecasts[day].forecast(arrival)
        hour = int(arrival.time % DAY_S // HOUR_S)
        p = np.clip(own.p_occupied, MIN_PROBABILITY, MAX_PROBABILITY)
        # The shift of every slot's log-odds, logits, that shifts the lot's mean by `level_sd` logits.
        level, level_sd = self.level[index, hour], self.level_sd[index, hour]
        low, high = (level_of_mean(self.attraction, float(expit(level + s * level_sd))) for s in (-1.0, 1.0))
        return Forecast(p, own.decay_rate, DayError(level=0.5 * (high - low)))

    def _index(self, day: str) -> int:
        try:
            return self.days.index(day)
        except ValueError:
            raise InputError(f"Arrival.day is {day!r}, want a counted day of {self.source}") from None


def level_of_mean(attraction: FloatArray, mean: float) -> float:
    """Return the level, logit, at which slots of these log-odds, (n,), are taken with this mean probability."""
    mean = min(max(mean, LEAST), MOST)
    reach = float(np.abs(attraction).max()) + abs(float(logit(mean))) + 1.0
    return float(brentq(lambda x: float(expit(attraction + x).mean()) - mean, -reach, reach))


def process_of_curve(attraction: FloatArray, curve: FloatArray, mean_stay_s: float) -> OccupancyProcess:
    """Return the process whose mean occupancy is a given one at the end of every hour of the day, every day.

    Within an hour rates are constant. Cars leave after `mean_stay_s` on average, and the arrival rate is chosen for
    the curve, (24,); where the lot empties faster than that, no car arrives and the departure rate is chosen.
    """
    curve = np.clip(curve, LEAST, MOST)
    pull = np.exp(attraction - attraction.max())
    fastest = math.log(0.9 * MAX_RATE)
    usual = math.log(1.0 / mean_stay_s)
    none = fastest - 60.0
    arrivals, departures = np.full(DAY_HOURS, none), np.full(DAY_HOURS, usual)
    p = expit(attraction + level_of_mean(attraction, float(curve[-1])))

    def later(log_arrival: float, log_departure: float) -> FloatArray:
        arrive, leave = pull * math.exp(log_arrival), math.exp(log_departure)
        total = arrive + leave
        equilibrium = arrive / total
        return np.asarray(equilibrium + (p - equilibrium) * np.exp(-total * HOUR_S))

    for _ in range(_PASSES):
        for hour, mean in enumerate(curve):
            arrivals[hour], departures[hour] = none, usual
            if later(none, usual).mean() < mean:
                arrivals[hour] = brentq(lambda x, m=mean: later(x, usual).mean() - m, none, fastest)
            elif later(none, fastest).mean() < mean:
                departures[hour] = brentq(lambda x, m=mean: later(none, x).mean() - m, usual, fastest)
            p = later(arrivals[hour], departures[hour])
    return OccupancyProcess(
        pull, np.tile(np.exp(arrivals), 7), np.ones(pull.size), np.tile(np.exp(departures), 7)
    )


def car_park_of_slots(mapping: str | Path, lot: ParkingLot, counts: Counts) -> IntArray:
    """Return the car park of each slot, (n,) index; -1 for none.

    Args:
        mapping: a file of slots and car parks, `slot_id,log_slot_id`; or `same`: the slots of a facility or a zone with
            the name of a car park.
        lot: the lot.
        counts: the counts.
    """
    if mapping != SAME_SLOTS:
        return read_mapping(mapping, lot.slot_ids, counts.car_parks, counts.source)
    index = {name: i for i, name in enumerate(counts.car_parks)}
    of_slot = np.full(lot.n_slots, -1, np.int64)
    for names, places in (
        (lot.zones, lot.zone_of_slot),
        ([f.name for f in lot.facilities], lot.facility_of_slot),
    ):
        for k, name in enumerate(names):
            if name in index:
                of_slot[places == k] = index[name]
    return some_mapped(of_slot, "mapping 'same': facility or zone", counts.car_parks, counts.source)


MOST_GAP_S = 2 * HOUR_S  # longest time between counts over which they say how full a car park is, s


def log_of_counts(
    counts: Counts, car_park: IntArray, slot_ids: Sequence[str], attraction: FloatArray
) -> OccupancyLog:
    """Return a log in which, from each count on, as many slots of a car park are taken as it says of its slots.

    No more cars come or go than the counts say: where they rise, cars take free slots, popular ones more often; where
    they fall, any of them leave.

    Args:
        counts: the counts.
        car_park: (n,) int64, car park of each slot; -1 for none.
        slot_ids: (n,) names of the slots.
        attraction: (n,) float64, logit, popularity of the slots.
    """
    spans = list[tuple[int, float, float, bool]]()
    for park in np.unique(car_park[car_park >= 0]).tolist():
        slots, rng = np.flatnonzero(car_park == park), np.random.default_rng(park)
        second, occupied = counts.readings(park)
        taken, since = np.zeros(slots.size, bool), second[:1].repeat(slots.size)
        for k, wanted in enumerate(np.round(occupied * slots.size).astype(int).tolist()):
            if k and second[k] - second[k - 1] > MOST_GAP_S:
                spans += zip(slots, since, second[k - 1].repeat(slots.size), taken.copy(), strict=True)
                since[:] = second[k]
            comes = wanted > taken.sum()
            among = np.flatnonzero(taken != comes)
            race = rng.exponential(size=among.size) * (np.exp(-attraction[slots[among]]) if comes else 1.0)
            for slot in among[np.argsort(race)[: abs(wanted - int(taken.sum()))]]:
                spans.append((slots[slot], since[slot], second[k], not comes))
                taken[slot], since[slot] = comes, second[k]
        spans += zip(slots, since, second[-1:].repeat(slots.size), taken, strict=True)
    table = np.array([span for span in spans if span[2] > span[1]]).reshape(-1, 4)
    require(table.size, f"{counts.source}: no counts in a row of the lot's car parks, want some")
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    columns = table[:, 0].astype(np.int64), table[:, 1], table[:, 2], table[:, 3] > 0
    return OccupancyLog.of_events(
        Events(tuple(slot_ids), counts.days[0].toordinal(), *columns, {}), source=counts.source
    )
