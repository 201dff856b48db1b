"""Hourly counts of free places of whole car parks, cleaned by stated rules.

A file has the columns `car_park,capacity,free` and `hour` (local time), the hour at whose end the reading holds, or
`time`, the moment of the reading: one of 09:00 sharp holds for the end of the hour before it. `hour_utc` and `time_utc`
are the same in UTC; `taken` may stand for `free` (see `count_table`). Real counts have faults. Each reading that is
changed or dropped is counted under the name of its rule:

- `negative`: below 0. Down to -5 % of the capacity it counts as full, below that it is dropped.
- `above_capacity`: more free places than places. Up to 5 % it counts as empty, above that it is dropped (unless
  the capacity is estimated, see below).
- `stuck`: a run of equal readings is dropped if chance makes one of that length less than once in a billion, given
  how often readings of those hours repeat on earlier days; so is one of over a day at full, or three days at empty.
- `capacity_changed`: the stated capacity changes from one day to the next; occupancy refers to the day's own.
- `capacity_estimated`: days of a car park where in the 28 days before more than 5 % of the readings exceed the stated
  capacity. The 98 % quantile of those readings then serves as the capacity.
- `duplicate`: several readings of one hour; the last in time counts. In the hour that comes twice, their mean.
- `summer_time`: days of 23 or 25 hours, where a time zone is given. `gap`: hours without a reading between a car park's
  first and last day.

Of a table with several readings an hour all are used: the occupancy of an hour is their mean, `moments` has all of
them, and `duplicate` are those of a car park at the same time.

Every rule looks back only: what is known of a day does not depend on later days. The exception are the hours of a run
before it is recognised as stuck: `seen` has them, `occupied` has not.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import NamedTuple
from zoneinfo import ZoneInfo

import numpy as np

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.errors import InputError, nearest
from parkenv.forecast.count_table import DAY_S, FINE, HOURS, Capacity, Readings, read_table

_TOLERANCE = 0.05  # of the capacity
_SURPRISE = math.log(1e9)
_WINDOW, _IDLE = (
    28,
    0.02,
)  # days; share of the places that are taken and left at least where a car park is in use
_REPEATS_PRIOR = (2.0, 4.0)  # repeats of readings, and pairs, assumed before any is seen


# Readings an hour that say something of their own: cars stay for longer than the quarter of an hour between them.
_MOST_PER_HOUR = 4.0


class Moments(NamedTuple):
    """Readings of a car park in order of time, each array (k,)."""

    second: FloatArray  # float64, s since the midnight of the first day
    occupied: FloatArray  # float64, fraction of the places that is taken


@dataclass(frozen=True, eq=False)
class Counts:
    """Occupancy of car parks by local hour; arrays over (car park, day, hour of the day)."""

    car_parks: tuple[str, ...]  # (c,) names
    days: tuple[date, ...]  # (d,) dates without a gap, ascending
    capacity: FloatArray  # (c, d) float64, places; that of the day before where a day states none
    # (c, d, 24) float64, fraction of the places that is taken; NaN without a usable reading
    occupied: FloatArray
    # (c, d, 24) float64, the same as known at the end of that day, for models that learn day by day
    seen: FloatArray
    faults: tuple[dict[str, int], ...]  # (c,) number of readings, or days, by rule
    source: str = "counts"  # name of the file in messages
    # (c,) of a table with several readings an hour; empty: one
    moments: tuple[Moments, ...] = ()
    per_hour: float = 1.0  # number of readings in an hour that say something of their own

    @classmethod
    def read(
        cls,
        path: str | Path,
        timezone: str | None = None,
        capacity: Capacity = None,
        columns: str | None = None,
    ) -> Counts:
        """Read and clean a file of counts, .csv or .csv.gz, see `count_table`.

        The IANA name of the local time is wanted if times are in UTC; it tells the days of summer time.
        """
        return _cleaned(read_table(path, timezone, capacity, columns), timezone, str(path))

    @property
    def sample(self) -> FloatArray:
        """(c, d) float64, number of places that an hour's occupancy is the mean of: it has that of several readings."""
        return self.capacity * self.per_hour

    @cached_property
    def weekday(self) -> IntArray:
        return np.array([day.weekday() for day in self.days])

    def day_index(self, day: date) -> int:
        """Return the index of a date; 0 for one before the first, `len(days)` for one after the last."""
        return min(max((day - self.days[0]).days, 0), len(self.days))

    def readings(self, car_park: int) -> Moments:
        """Return all readings of a car park; hourly ones hold at the ends of their hours."""
        if self.moments:
            return self.moments[car_park]
        occupied = self.occupied[car_park].ravel()
        known = np.flatnonzero(np.isfinite(occupied))
        return Moments(np.asarray((known + 1) * (DAY_S / HOURS)), occupied[known])

    def total_faults(self) -> dict[str, int]:
        return {name: sum(faults[name] for faults in self.faults) for name in self.faults[0]}

    def idle(self) -> dict[str, str]:
        idle = {}
        for name, y in zip(self.car_parks, self.occupied, strict=True):
            y = y[np.isfinite(y)]
            if not y.size:
                idle[name] = "no usable readings"
            elif np.quantile(y, 0.98) - np.quantile(y, 0.02) < _IDLE:
                idle[name] = f"dead: always {np.median(y):.0%} full"
            elif np.quantile(y, 0.999) < 0.25:
                idle[name] = f"never filling: at most {y.max():.0%} full"
        return idle

    def chosen(self, names: Iterable[str]) -> Counts:
        names = list(names)
        for name in names:
            if name not in self.car_parks:
                raise InputError(f"{self.source}: has no car park {name!r}; {nearest(name, self.car_parks)}")
        return self.part([self.car_parks.index(name) for name in names])

    def part(self, rows: Sequence[int] | IntArray, first: int = 0, last: int | None = None) -> Counts:
        days = slice(first, last)
        names, faults = zip(*((self.car_parks[i], self.faults[i]) for i in rows), strict=True)
        capacity, occupied, seen = (array[rows, days] for array in (self.capacity, self.occupied, self.seen))
        moments = tuple(self.moments[i] for i in rows) if self.moments and first == 0 else ()
        return Counts(
            names, self.days[days], capacity, occupied, seen, faults, self.source, moments, self.per_hour
        )


def _cleaned(readings: Readings, timezone: str | None, source: str) -> Counts:
    days = tuple(readings.first + timedelta(i) for i in range(readings.n_days))
    changes = {} if timezone is None else _summer_time(days, ZoneInfo(timezone))
    stated, free, duplicates = _by_hour(readings, changes)
    known = np.isfinite(stated)
    stated = _carried_forward(stated)
    changed = (np.diff(stated, axis=1) != 0) & known[:, 1:]
    capacity = np.stack([_capacity_in_force(*pair) for pair in zip(stated, free, strict=True)])
    whole = capacity[:, :, None]
    with np.errstate(invalid="ignore"):
        negative, above = free < 0, free > stated[:, :, None]
        lost = (free < -_TOLERANCE * whole) | (free > (1 + _TOLERANCE) * whole)
    occupied = 1.0 - np.where(lost, np.nan, np.clip(free, 0.0, whole)) / whole
    recognised, stuck = _stuck(occupied, np.array([day.weekday() >= 5 for day in days]))
    present = [np.flatnonzero(np.isfinite(y).any(axis=1)) for y in occupied]
    spans = [slice(where[0], where[-1] + 1) if where.size else slice(0) for where in present]
    faults = tuple(
        {
            "negative": int(negative[i].sum()),
            "above_capacity": int(above[i].sum()),
            "stuck": int(stuck[i].sum()),
            "capacity_changed": int(changed[i].sum()),
            "capacity_estimated": int((capacity[i] != stated[i]).sum()),
            "duplicate": int(duplicates[i]),
            "summer_time": sum(k in range(readings.n_days)[span] for k in changes),
            "gap": int(np.isnan(occupied[i, span]).sum()),
        }
        for i, span in enumerate(spans)
    )
    usable, seen = (np.where(mask, np.nan, occupied) for mask in (stuck, recognised))
    if readings.per_hour < FINE:
        return Counts(readings.car_parks, days, capacity, usable, seen, faults, source)
    moments = tuple(_moments(readings, i, usable[i], capacity[i]) for i in range(len(capacity)))
    rate = min(readings.per_hour, _MOST_PER_HOUR)
    return Counts(readings.car_parks, days, capacity, usable, seen, faults, source, moments, rate)


def _moments(readings: Readings, park: int, usable: FloatArray, capacity: FloatArray) -> Moments:
    # Those of the hours that are used; of several at the same time the last.
    of = np.flatnonzero((readings.park == park) & np.isfinite(readings.free))
    of = of[np.isfinite(usable[readings.day[of], readings.hour[of]])]
    of = of[np.append(np.diff(readings.second[of]) > 0, True)[: of.size]]
    return Moments(
        readings.second[of], np.clip(1.0 - readings.free[of] / capacity[readings.day[of]], 0.0, 1.0)
    )


def _summer_time(days: tuple[date, ...], zone: ZoneInfo) -> dict[int, int]:
    """Return the days of 23 or 25 hours, by index, with the hour that comes twice, -1 if none does."""
    midnights = [datetime(day.year, day.month, day.day, tzinfo=zone) for day in days]
    changes = {}
    for i, start in enumerate(midnights):
        hours = [start.replace(hour=hour) for hour in range(HOURS)]
        # The last hour's second fold: where the clock goes from midnight back to 23:00, the day ends with it.
        if hours[0].utcoffset() != hours[-1].replace(fold=1).utcoffset():
            # The hour that the spring leaves out differs by fold as well, but is changed on the way through UTC.
            changes[i] = next(
                (
                    t.hour
                    for t in hours
                    if t.utcoffset() != t.replace(fold=1).utcoffset()
                    and t.astimezone(UTC).astimezone(zone) == t
                ),
                -1,
            )
    return changes


def _by_hour(readings: Readings, changes: dict[int, int]) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return capacities (c, d), the last of each day, readings (c, d, 24), and the number of duplicates (c,)."""
    c, d = len(readings.car_parks), readings.n_days
    known = np.isfinite(readings.free) & (readings.capacity > 0) & np.isfinite(readings.capacity)
    columns = (readings.park, readings.day, readings.hour, readings.second, readings.free, readings.capacity)
    park, day, hour, second, free, capacity = (column[known] for column in columns)
    stated = np.full((c, d), np.nan)
    stated[park, day] = capacity  # the last one stays
    cell = (park * d + day) * HOURS + hour
    order = np.lexsort((np.arange(cell.size), second, cell))
    kept = np.append(np.diff(cell[order]) > 0, True)[: order.size]
    twice = np.zeros((c, d, HOURS), bool)
    if readings.per_hour >= FINE:  # all but those at the same time, in the mean
        kept |= np.append(np.diff(second[order]) > 0, True)[: order.size]
    else:
        summer = {day: hour for day, hour in changes.items() if hour >= 0}
        twice[:, list(summer), list(summer.values())] = True
        kept |= twice.ravel()[cell[order]]
    at, values = cell[order][kept], free[order][kept]
    n = np.bincount(at, minlength=twice.size)
    mean = np.divide(np.bincount(at, values, n.size), n, where=n > 0, out=np.full(n.size, np.nan))
    again = np.bincount(park[order[~kept]], minlength=c)
    again += np.where(twice, np.maximum(n.reshape(twice.shape) - 2, 0), 0).sum(axis=(1, 2))
    return stated, mean.reshape(twice.shape), again


def _carried_forward(values: FloatArray) -> FloatArray:
    index = np.where(np.isfinite(values), np.arange(values.shape[1]), 0)
    filled = np.take_along_axis(values, np.maximum.accumulate(index, axis=1), axis=1)
    first = np.take_along_axis(values, np.isfinite(values).argmax(axis=1)[:, None], axis=1)
    return np.nan_to_num(np.where(np.isfinite(filled), filled, first), nan=1.0)


def _capacity_in_force(stated: FloatArray, free: FloatArray) -> FloatArray:
    """Return the capacity of each day (d,): the stated one, or that of the readings before if they exceed it."""
    with np.errstate(invalid="ignore"):
        suspicious = np.flatnonzero((free > stated[:, None]).any(axis=1))
    result = stated.copy()
    if not suspicious.size:
        return result
    estimate = 0.0
    for day in range(int(suspicious[0]) + 1, len(stated)):
        recent = free[max(day - _WINDOW, 0) : day]
        recent = recent[np.isfinite(recent)]
        if recent.size >= HOURS and (recent > stated[day]).mean() > _TOLERANCE:
            value = float(np.quantile(recent, 0.98))
            if abs(value - estimate) > _TOLERANCE * estimate:
                estimate = value
            result[day] = max(estimate, stated[day])
        else:
            estimate = 0.0
    return result


def _stuck(occupied: FloatArray, weekend: BoolArray) -> tuple[BoolArray, BoolArray]:
    c, d, _ = occupied.shape
    recognised = np.zeros(occupied.shape, bool)
    stuck = recognised.copy()
    for i in range(c):
        where = np.flatnonzero(np.isfinite(occupied[i].ravel()))
        if where.size < 2:
            continue
        values, hour, day = occupied[i].ravel()[where], where % HOURS, where // HOURS
        same = np.r_[False, np.diff(values) == 0]
        # How often readings of this hour repeated the one before, on earlier days of this class.
        cell = weekend[day] * HOURS + hour
        pairs, repeats = np.zeros((2, d + 1, 2 * HOURS))
        np.add.at(pairs, (day + 1, cell), 1.0)
        np.add.at(repeats, (day + 1, cell), same)
        repeats, pairs = repeats.cumsum(axis=0)[day, cell], pairs.cumsum(axis=0)[day, cell]
        chance = (repeats + _REPEATS_PRIOR[0]) / (pairs + _REPEATS_PRIOR[1])
        limit = np.where(values >= 1, 24.0, np.where(values <= 0, 72.0, _SURPRISE))
        step = np.where(same, np.where((values <= 0) | (values >= 1), 1.0, -np.log(chance)), 0.0)
        run = np.cumsum(~same) - 1
        start = np.flatnonzero(~same)
        total = np.cumsum(step)
        total -= total[start][run]
        known = total > limit
        recognised[i].ravel()[where] = known
        stuck[i].ravel()[where] = np.logical_or.reduceat(known, start)[run]
    return recognised, stuck
