"""Recorded occupancy: a log of observations of slots.

Between observations the last known state holds; in a gap longer than `max_gap_s`, the state of the observation nearest
in time. Before a day's first observation the first state holds, after its last observation the last one. A slot that
was not observed on a day has no record of that day.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import date, datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self, TypeVar, get_args

import numpy as np
from numpy.typing import ArrayLike

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.errors import InputError, require, require_number, require_one_of
from parkenv.files.limited_reading import csv_rows
from parkenv.forecast.slot_days import Days, SlotDays
from parkenv.world.week import DAY_HOURS, DAY_PERIODS, DAY_S, PERIOD_S

DayClass = Literal["weekday", "weekend"]

MAX_GAP_S = 7200.0
SAMPLE_S = 900.0
"""Time between the pairs of observations of a log that has each change, s."""
MAX_LOG_BYTES = 512_000_000
"""Maximum size of a log, unpacked: some 12 million observations."""
MAX_RECORDS = 5_000_000
"""Maximum number of slots times days of a log, each of which takes half a kilobyte."""

_KNOWN = ("datetime", "camera", "slot_id", "weather", "occupied")


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
        max_gap_s: s, longest gap over which the last known state holds to the end.
        source: name of the log in error messages.
    """

    slot_ids: tuple[str, ...]
    days: tuple[str, ...]
    slot: IntArray
    day: IntArray
    second: FloatArray
    occupied: BoolArray
    max_gap_s: float = MAX_GAP_S
    source: str = "occupancy log"
    # Record r = day * n_slots + slot: observations first[r] to first[r + 1]. Each state holds from from_s on.
    first: IntArray = field(init=False, repr=False)
    from_s: FloatArray = field(init=False, repr=False)
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
        gap = np.diff(second, prepend=second[0])
        # In a long gap the state changes half-way, where the later observation becomes the nearer one.
        from_s = np.where(gap > self.max_gap_s, second - gap / 2, second)
        from_s[np.diff(record, prepend=-1) > 0] = 0.0
        arrays = {"slot": slot, "day": day, "second": second, "occupied": occupied}
        for name, array in (arrays | {"first": first, "from_s": from_s}).items():
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    def __deepcopy__(self, memo: dict[int, Any]) -> "OccupancyLog":
        return self  # immutable: copies share it

    @classmethod
    def read(cls, path: str | os.PathLike[str], max_gap_s: float = MAX_GAP_S) -> Self:
        """Read a CSV file, gzipped if its name ends in `.gz`.

        Columns: `datetime` (ISO, local time), `slot_id`, `occupied` (0 or 1); `camera` and `weather` are allowed and
        ignored. Several cameras may observe a slot; its observations must be in order of time.

        Raises:
            InputError: names the file, and the line and value where there is one.
        """
        path = Path(path)
        slots: dict[str, int] = {}
        moments: dict[str, datetime] = {}  # one image shows many slots: many lines have the same text
        latest: dict[str, datetime] = {}
        observations: list[tuple[int, datetime, bool]] = []
        rows = csv_rows(path, MAX_LOG_BYTES)
        at_time, at_slot, at_occupied = csv_columns(path, rows, _KNOWN, ("datetime", "slot_id", "occupied"))
        for line, row in rows:
            text, slot_id, taken = row[at_time], row[at_slot], row[at_occupied]
            moment = moments.get(text)
            if moment is None:
                moment = moments[text] = _moment(path, line, text)
            if not slot_id:
                raise InputError(f"{path}: line {line}: slot_id: empty, want a slot's name")
            if taken not in ("0", "1"):
                raise InputError(f"{path}: line {line}: occupied is {taken!r}, want 0 or 1")
            if moment < latest.get(slot_id, moment):
                raise InputError(
                    f"{path}: line {line}: datetime: {text} of slot {slot_id} is before its line above,"
                    f" {latest[slot_id]}; want observations in order of time"
                )
            latest[slot_id] = moment
            observations.append((slots.setdefault(slot_id, len(slots)), moment, taken == "1"))
        if not observations:
            raise InputError(f"{path}: no observations, want at least one line below the header")
        dates = [moment.date().isoformat() for _, moment, _ in observations]
        days = sorted(set(dates))
        day_index = {day: i for i, day in enumerate(days)}
        seconds = [
            m.hour * 3600 + m.minute * 60 + m.second + m.microsecond * 1e-6 for _, m, _ in observations
        ]
        slot, occupied = (np.array([each[k] for each in observations]) for k in (0, 2))
        day = np.array([day_index[day] for day in dates])
        return cls(tuple(slots), tuple(days), slot, day, np.array(seconds), occupied, max_gap_s, str(path))

    @classmethod
    def read_all(cls, paths: Sequence[str | os.PathLike[str]]) -> Self:
        """Read logs of the same slots on different days as one log.

        Raises:
            InputError: as `read`; or other slots than in the first log, or a day of an earlier one.
        """
        log = cls.read(paths[0])
        for path in paths[1:]:
            log = log._with(cls.read(path))
        return log

    def fitted(self, what: str, days: IntArray, fit: Callable[[IntArray], _Model]) -> _Model:
        """Return a model of some of the days: fitted once, however many scenarios replay the log."""
        key = (what, *days.tolist())
        if key not in self._models:
            self._models[key] = fit(days)
        return self._models[key]  # type: ignore[no-any-return]

    def _with(self, other: Self) -> Self:
        odd = set(self.slot_ids) ^ set(other.slot_ids)
        if odd:
            raise InputError(
                f"{other.source}: slot_id: {min(odd)!r} is in one of this log and {self.source} only,"
                " want the same slots"
            )
        twice = set(self.days) & set(other.days)
        if twice:
            raise InputError(f"{other.source}: {min(twice)} is also in {self.source}, want different days")
        days = sorted({*self.days, *other.days})
        slot = {slot_id: i for i, slot_id in enumerate(self.slot_ids)}
        slots = np.array([slot[slot_id] for slot_id in other.slot_ids], np.int64)
        day = [np.searchsorted(days, log.days)[log.day] for log in (self, other)]
        return type(self)(
            self.slot_ids,
            tuple(days),
            np.concatenate([self.slot, slots[other.slot]]),
            np.concatenate(day),
            np.concatenate([self.second, other.second]),
            np.concatenate([self.occupied, other.occupied]),
            self.max_gap_s,
            f"{self.source},{other.source}",
        )

    @cached_property
    def weekend(self) -> BoolArray:
        """(n_days,) bool, whether the day is a Saturday or Sunday."""
        return np.array([day_class(day) == "weekend" for day in self.days], bool)

    def intervals(self, max_gap_s: float = MAX_GAP_S) -> Intervals:
        """Return the pairs of consecutive observations of one slot on one day, at most `max_gap_s` apart.

        Where observations follow from changes, as in days of a fleet, they would say that states change within a
        second. The pairs of such a log are `SAMPLE_S` apart, at times that do not depend on the states.
        """
        same_record = np.diff(self._record) == 0
        changes = same_record & (np.diff(self.occupied.astype(np.int8)) != 0)
        if changes.any() and np.diff(self.second)[changes].max() <= 1.0:  # a log of each change
            return self._samples(min(SAMPLE_S, max_gap_s))
        earlier = np.flatnonzero(same_record & (np.diff(self.second) <= max_gap_s))
        later = earlier + 1
        slot, day = self.slot[earlier], self.day[earlier]
        return Intervals(
            slot, day, self.second[earlier], self.second[later], self.occupied[earlier], self.occupied[later]
        )

    @property
    def _record(self) -> IntArray:
        return self.day * len(self.slot_ids) + self.slot

    def _samples(self, each_s: float) -> Intervals:
        grid = np.arange(0.0, DAY_S, each_s)
        observed = np.flatnonzero(np.diff(self.first))
        begin, end = self.second[self.first[observed]], self.second[self.first[observed + 1] - 1]
        which, at = np.nonzero((grid >= begin[:, None]) & (grid + each_s <= end[:, None]))
        day, slot = np.divmod(observed[which], len(self.slot_ids))
        start, key = grid[at], self._record * DAY_S + self.second
        before, after = (
            self.occupied[np.searchsorted(key, observed[which] * DAY_S + second, side="right") - 1]
            for second in (start, start + each_s)
        )
        return Intervals(slot, day, start, start + each_s, before, after)

    def mean_occupancy(
        self, kind: DayClass, hours: tuple[int, int] = (0, DAY_HOURS), days: BoolArray | None = None
    ) -> FloatArray:
        """Return the fraction of time each slot was taken, between the days' first and last observations.

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

        A state counts from one observation to the next, the last one of a day to the end of its half-hour.
        """
        occupied, seen = (seconds.copy() for seconds in self._periods)
        record = np.flatnonzero(np.diff(self.first))
        day, slot = np.divmod(record, len(self.slot_ids))
        last = self.first[record + 1] - 1
        period = (self.second[last] // PERIOD_S).astype(np.int64)
        rest = (period + 1) * PERIOD_S - self.second[last]
        seen[slot, day, period] += rest
        occupied[slot, day, period] += np.where(self.occupied[last], rest, 0.0)
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
        _sum_periods(self.first, self.from_s, self.second, self.occupied, *periods)
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
    first: IntArray,
    from_s: FloatArray,
    second: FloatArray,
    taken: BoolArray,
    occupied: FloatArray,
    seen: FloatArray,
) -> None:
    n_slots = seen.shape[0]
    for record in range(first.size - 1):
        day, slot = record // n_slots, record % n_slots
        last = first[record + 1] - 1
        for i in range(first[record], last + 1):
            start, end = from_s[i], DAY_S if i == last else from_s[i + 1]
            watched, left = max(start, second[first[record]]), min(end, second[last])
            _add_seconds(seen[slot, day], watched, left)
            if taken[i]:
                _add_seconds(occupied[slot, day], watched, left)


def csv_columns(
    path: Path, rows: Iterator[tuple[int, list[str]]], known: Sequence[str], needed: Sequence[str]
) -> list[int]:
    _, header = next(rows, (0, []))
    require(header, f"{path}: empty, want a header with the columns {', '.join(needed)}")
    for name in header:
        require(name in known, f"{path}: column {name!r} is unknown, want some of {', '.join(known)}")
        require(header.count(name) <= 1, f"{path}: column {name!r} stands there twice, want it once")
    for name in needed:
        require(name in header, f"{path}: column {name!r} is missing, want {', '.join(needed)}")
    return [header.index(name) for name in needed]


def _moment(path: Path, line: int, text: str) -> datetime:
    wanted = "want local date and time, for example 2015-11-12 07:09"
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        moment = None
    if moment is None or ":" not in text or moment.tzinfo is not None:
        raise InputError(f"{path}: line {line}: datetime is {text!r}, {wanted}")
    return moment
