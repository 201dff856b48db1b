"""Recorded occupancy: a log of states of slots.

A state that was observed holds until the next observation of the slot on that day, or until `until` where a log knows
how long (see `parkenv.forecast.event_table`). Longer gaps than `max_gap_s` between observations are unknown, as is the
time before a day's first observation and after its last. A slot that was not observed on a day has no record of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import date
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self, TypeVar, get_args

import numpy as np
from numpy.typing import ArrayLike

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.errors import InputError, require, require_number, require_one_of
from parkenv.forecast.count_table import Capacity
from parkenv.forecast.counts import Counts
from parkenv.forecast.event_table import Events, is_counts, read_events
from parkenv.forecast.slot_days import Days, SlotDays
from parkenv.world.week import DAY_HOURS, DAY_PERIODS, DAY_S, PERIOD_S

DayClass = Literal["weekday", "weekend"]

MAX_GAP_S = 7200.0
SAMPLE_S = 900.0  # time between the pairs of observations of a log that has each change, s
MAX_RECORDS = 5_000_000  # maximum number of slots times days of a log, each of which takes half a kilobyte


def weekday_of(day: str) -> int:
    return date.fromisoformat(day).weekday()


def day_class(day: str) -> DayClass:
    """Return the class of an ISO date, `weekday` or `weekend`.

    >>> day_class("2015-11-12"), day_class("2015-11-21")
    ('weekday', 'weekend')
    """
    return "weekday" if weekday_of(day) < 5 else "weekend"


def _is_date(text: str) -> bool:
    try:
        return date.fromisoformat(text).isoformat() == text
    except ValueError:
        return False


class Intervals(NamedTuple):
    """Pairs of consecutive observations of one slot on one day; each field (k,).

    slot and day are int64 indices; start and end are float64 seconds of the day, end > start; before and after are the
    states at start and end, True if taken.
    """

    slot: IntArray
    day: IntArray
    start: FloatArray
    end: FloatArray
    before: BoolArray
    after: BoolArray


class _Periods(NamedTuple):
    """Seconds between the day's first and last observation, each (m, n_days, 48) float64."""

    occupied: FloatArray
    seen: FloatArray


class RecordedFile(NamedTuple):
    """A file of counts, or logs of bays, and how they are read; see `Counts.read` and `OccupancyLog.read`."""

    files: tuple[Path, ...]
    timezone: str | None = None
    capacity: Capacity = None
    columns: str | None = None

    @property
    def is_counts(self) -> bool:
        return is_counts(self.files[0], self.columns)

    def counts(self) -> Counts:
        return Counts.read(self.files[0], self.timezone, self.capacity, self.columns)

    def log(self) -> OccupancyLog:
        return OccupancyLog.read(*self.files, timezone=self.timezone, columns=self.columns)


_Model = TypeVar("_Model")


@dataclass(frozen=True, eq=False)
class OccupancyLog:
    """Observations of the slots of a lot over several days.

    They are sorted by day, slot and time. Of several observations of a slot at the same time (by several cameras), only
    the last in the input is kept.

    Args:
        slot_ids: the log's slots.
        days: recorded days, ISO dates, ascending.
        slot: (k,) int64, index of the observed slot.
        day: (k,) int64, index of the day.
        second: (k,) float64, s since that day's midnight, in [0, 86400).
        occupied: (k,) bool, observed state.
        max_gap_s: s, longest gap between observations over which the last state holds.
        source: name of the log in error messages.
        known_until: (k,) float64, s of the day up to which the state is known to hold; by default until the next
            observation, if that is near enough, or if the log has both states of each change, within a second.
        faults: how much of its file is not in the log, or changed, by rule (see `parkenv.forecast.event_table`).
    """

    slot_ids: tuple[str, ...]
    days: tuple[str, ...]
    slot: IntArray
    day: IntArray
    second: FloatArray
    occupied: BoolArray
    max_gap_s: float = MAX_GAP_S
    source: str = "occupancy log"
    known_until: FloatArray = field(default_factory=lambda: np.zeros(0))
    faults: Mapping[str, int] = field(default_factory=dict)
    # Record r = day * n_slots + slot: observations first[r] to first[r + 1].
    first: IntArray = field(init=False, repr=False)
    until: FloatArray = field(init=False, repr=False)  # (k,) s of the day up to which the state is known
    continuous: bool = field(
        init=False, repr=False
    )  # whether states are known between observations, however far
    _models: dict[tuple[Any, ...], Any] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        slot, day = np.asarray(self.slot, np.int64), np.asarray(self.day, np.int64)
        second, occupied = np.asarray(self.second, float), np.asarray(self.occupied, bool)
        require(slot.size, f"{self.source}: no observations, want at least one")
        if not slot.shape == day.shape == second.shape == occupied.shape == (slot.size,):
            raise InputError(f"{self.source}: want slot, day, second and occupied of one length")
        require(
            len(self.slot_ids) * len(self.days) <= MAX_RECORDS,
            f"{self.source}: has {len(self.slot_ids):,} slots on {len(self.days):,} days, "
            f"want at most {MAX_RECORDS:,} slots times days",
        )
        for name, index, size in (("slot", slot, len(self.slot_ids)), ("day", day, len(self.days))):
            if index.min() < 0 or index.max() >= size:
                raise InputError(f"{self.source}: {name}: want indices from 0 to {size - 1}")
        if list(self.days) != sorted({day for day in self.days if _is_date(day)}):
            raise InputError(f"{self.source}: days: want different ISO dates in order")
        if not np.all((second >= 0) & (second < DAY_S)):
            raise InputError(f"{self.source}: second: want seconds of the day in [0, 86400)")
        require_number("max_gap_s", self.max_gap_s, above=0.0, finite=False)
        order = np.lexsort((second, slot, day))
        record = (day * len(self.slot_ids) + slot)[order]
        stands = np.append((np.diff(record) > 0) | (np.diff(second[order]) > 0), True)
        order, record = order[stands], record[stands]
        slot, day, second, occupied = slot[order], day[order], second[order], occupied[order]
        first = np.searchsorted(record, np.arange(len(self.slot_ids) * len(self.days) + 1))
        same = np.append(np.diff(record) == 0, False)
        following = np.where(same, np.append(second[1:], 0.0), DAY_S)
        changes = same & (np.append(occupied[1:], False) != occupied)
        each_change = bool(changes.any()) and float((following - second)[changes].max()) <= 1.001
        continuous = each_change or np.size(self.known_until) > 0
        if np.size(self.known_until):
            require(
                np.shape(self.known_until) == stands.shape,
                f"{self.source}: known_until: want one for each observation",
            )
            until = np.clip(np.asarray(self.known_until, float)[order], second, following)
            object.__setattr__(self, "known_until", until)
        else:
            until = np.where(same & (each_change | (following - second <= self.max_gap_s)), following, second)
        arrays = {"slot": slot, "day": day, "second": second, "occupied": occupied}
        for name, array in (arrays | {"first": first, "until": until}).items():
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        object.__setattr__(self, "continuous", continuous)

    def __deepcopy__(self, memo: dict[int, Any]) -> OccupancyLog:
        return self  # immutable: copies share it

    def fitted(self, what: str, days: IntArray, fit: Callable[[IntArray], _Model]) -> _Model:
        """Return a model of some of the days: fitted once, however many scenarios replay the log."""
        key = (what, *days.tolist())
        if key not in self._models:
            self._models[key] = fit(days)
        return self._models[key]  # type: ignore[no-any-return]

    @classmethod
    def read(
        cls,
        *paths: str | Path,
        timezone: str | None = None,
        columns: str | None = None,
        max_gap_s: float = MAX_GAP_S,
    ) -> Self:
        """Read tables of bays, .csv or .csv.gz, in any layout of `parkenv.forecast.event_table`, as one log.

        Args:
            paths: the tables.
            timezone: IANA name of the local time zone, wanted if times are in UTC or have an offset.
            columns: names of columns that are not recognised, `bay=Marker,...`.
            max_gap_s: s, longest gap between observations over which the last state holds.

        Raises:
            InputError: names the file, and the line and value where there is one.
        """
        source = ",".join(map(str, paths))
        return cls.of_events(read_events(paths, timezone, columns), max_gap_s, source)

    @classmethod
    def of_events(cls, events: Events, max_gap_s: float = MAX_GAP_S, source: str = "occupancy log") -> Self:
        """Return the events day by day: what lasts over midnight is known on both days."""
        are_looks = not (events.end > events.start).any()
        begin, last = events.start // DAY_S, np.ceil(events.end / DAY_S) - 1
        n = np.maximum(last - begin, 0).astype(np.int64) + 1
        which = np.repeat(np.arange(n.size), n)
        number = begin[which] + np.arange(which.size) - np.repeat(np.cumsum(n) - n, n)
        second = np.maximum(events.start[which] - number * DAY_S, 0.0)
        until = np.minimum(events.end[which] - number * DAY_S, DAY_S)
        days, day = np.unique(number.astype(np.int64), return_inverse=True)
        dates = tuple(date.fromordinal(events.first + day).isoformat() for day in days.tolist())
        known = np.zeros(0) if are_looks else until
        parts = events.bay[which], day, second, events.taken[which], max_gap_s, source, known, events.faults
        return cls(events.bays, dates, *parts)

    @cached_property
    def weekend(self) -> BoolArray:
        """(n_days,) bool, whether the day is a Saturday or Sunday."""
        return np.array([day_class(day) == "weekend" for day in self.days], bool)

    def intervals(self, max_gap_s: float = MAX_GAP_S) -> Intervals:
        """Return the pairs of consecutive observations of one slot on one day, at most `max_gap_s` apart."""
        log = self.looks
        same_record = np.diff(log.day * len(log.slot_ids) + log.slot) == 0
        earlier = np.flatnonzero(same_record & (np.diff(log.second) <= max_gap_s))
        later = earlier + 1
        slot, day = log.slot[earlier], log.day[earlier]
        return Intervals(
            slot, day, log.second[earlier], log.second[later], log.occupied[earlier], log.occupied[later]
        )

    @cached_property
    def looks(self) -> Self:
        """This log with observations at times that do not depend on the states.

        Where observations follow from changes they would say that states change within a second: of such a log the
        states every `SAMPLE_S` are taken instead, where they are known.
        """
        if not self.continuous:
            return self
        grid = np.arange(0.0, DAY_S, SAMPLE_S)
        low, high = np.searchsorted(grid, self.second), np.searchsorted(grid, self.until)
        which = np.repeat(np.arange(low.size), high - low)
        if not which.size:
            return self
        at = np.arange(which.size) - np.repeat(np.cumsum(high - low) - high, high - low)
        parts = self.slot[which], self.day[which], grid[at], self.occupied[which]
        return type(self)(self.slot_ids, self.days, *parts, self.max_gap_s, self.source)

    def mean_occupancy(
        self, kind: DayClass, hours: tuple[int, int] = (0, DAY_HOURS), days: BoolArray | None = None
    ) -> FloatArray:
        """Return the fraction of the known time in which each slot was taken.

        Args:
            kind: class of the days.
            hours: first hour of the day, and end hour (exclusive).
            days: (n_days,) bool, selected days; all by default.

        Returns:
            (m,) float64; NaN for a slot that was not observed in these hours.
        """
        require_one_of("class of day", kind, get_args(DayClass))
        used = self.weekend == (kind == "weekend")
        if days is not None:
            used &= days
        window = slice(*(hour * DAY_PERIODS // DAY_HOURS for hour in hours))
        occupied, seen = (seconds[:, used, window].sum(axis=(1, 2)) for seconds in self._periods)
        return np.divide(occupied, seen, out=np.full(occupied.shape, np.nan), where=seen > 0)  # type: ignore[no-any-return]

    @property
    def recorded(self) -> BoolArray:
        """(m, n_days) bool, whether the slot was observed on that day."""
        return (np.diff(self.first) > 0).reshape(len(self.days), -1).T

    def slot_days(self, days: IntArray) -> SlotDays:
        """Return the states of the slots in half-hours on `days`, (d,) indices.

        A state counts while it is known; one that is known at a moment only, to the end of its half-hour.
        """
        occupied, seen = (seconds.copy() for seconds in self._periods)
        last = np.flatnonzero(self.until == self.second)
        period = (self.second[last] // PERIOD_S).astype(np.int64)
        rest = (period + 1) * PERIOD_S - self.second[last]
        cell = self.slot[last], self.day[last], period
        np.add.at(seen, cell, rest)
        np.add.at(occupied, cell, np.where(self.occupied[last], rest, 0.0))
        np.minimum(seen, PERIOD_S, out=seen)
        np.minimum(occupied, seen, out=occupied)
        seen, occupied = seen[:, days], occupied[:, days]
        taken = np.divide(occupied, seen, out=np.zeros(seen.shape), where=seen > 0)
        return SlotDays(self.dates(days), taken, seen / PERIOD_S)

    def dates(self, days: ArrayLike) -> Days:
        """Return the dates of `days`, (d,) indices."""
        dates = [date.fromisoformat(self.days[day]) for day in np.asarray(days)]
        return Days(
            np.array([day.toordinal() for day in dates], np.int64),
            np.array([day.weekday() for day in dates], np.int64),
        )

    @cached_property
    def _periods(self) -> _Periods:
        shape = (len(self.slot_ids), len(self.days), DAY_PERIODS)
        periods = _Periods(np.zeros(shape), np.zeros(shape))
        _sum_periods(self.slot, self.day, self.second, self.until, self.occupied, *periods)
        return periods


@compiled
def _add_seconds(periods: FloatArray, start: float, end: float) -> None:
    period = int(start // PERIOD_S)
    while start < end:
        stop = min((period + 1) * PERIOD_S, end)
        periods[period] += stop - start
        start = stop
        period += 1


@compiled
def _sum_periods(
    slot: IntArray,
    day: IntArray,
    second: FloatArray,
    until: FloatArray,
    taken: BoolArray,
    occupied: FloatArray,
    seen: FloatArray,
) -> None:
    for i in range(slot.size):
        _add_seconds(seen[slot[i], day[i]], second[i], until[i])
        if taken[i]:
            _add_seconds(occupied[slot[i], day[i]], second[i], until[i])
