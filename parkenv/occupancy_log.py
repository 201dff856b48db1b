"""Recorded occupancy: a log of looks at slots, and worlds that replay its days on a lot.

Between looks the last known state holds; in a gap longer than `max_gap_s`, the state of the look nearest in
time. Before a day's first look its first state holds, after its last look its last. A slot that was not seen
at all on a day has no record of that day, and no world replays it there.
"""

import csv
import gzip
import math
import os
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import date, datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self, TextIO

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from parkenv.errors import InputError
from parkenv.keyed_random import ARRIVAL_STREAM, keyed_uniform
from parkenv.occupancy import (
    DAY_NAMES,
    DAY_S,
    HOUR_S,
    MAX_PROBABILITY,
    MIN_PROBABILITY,
    Arrival,
    ArrivalWindow,
    BoolArray,
    FloatArray,
    Forecast,
    IntArray,
)
from parkenv.occupancy_fit import fit_constant_rates

DayClass = Literal["weekday", "weekend"]

MAX_GAP_S = 7200.0
PRIOR_DAYS = 1.0
DAY_HOURS = 24

_KNOWN = ("datetime", "camera", "slot_id", "weather", "occupied")


def weekday_of(day: str) -> int:
    """Monday = 0 ... Sunday = 6, of an ISO date."""
    return date.fromisoformat(day).weekday()


def day_class(day: str) -> DayClass:
    """`weekday` or `weekend`, of an ISO date.

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
    """Pairs of consecutive looks at one slot on one day; each field (k,).

    slot and day are int64 indices; start and end float64 seconds of the day, end > start; before and after
    say whether the slot was taken then.
    """

    slot: IntArray
    day: IntArray
    start: FloatArray
    end: FloatArray
    before: BoolArray
    after: BoolArray


class _Hours(NamedTuple):
    """Seconds per (slot, day, hour of the day), each (m, n_days, 24) float64."""

    replayed: FloatArray  # taken, over the whole day as it is replayed
    occupied: FloatArray  # taken, between the day's first and last look only
    seen: FloatArray  # between the day's first and last look


@dataclass(frozen=True, eq=False)
class OccupancyLog:
    """What looks at the slots of a lot found, day by day.

    Args:
        slot_ids: the log's slots.
        days: recorded days, ISO dates, ascending.
        slot: (k,) int64, index of the slot that a look saw.
        day: (k,) int64, index of the day.
        second: (k,) float64, s since that day's midnight, in [0, 86400).
        occupied: (k,) bool, what the look found.
        max_gap_s: s, longest gap over which the last known state holds to the end.
        source: the name that error messages give to the log.

    The looks are kept sorted by day, slot and time; of several looks at a slot at one instant (by several
    cameras) only the last in the input is kept.
    """

    slot_ids: tuple[str, ...]
    days: tuple[str, ...]
    slot: IntArray
    day: IntArray
    second: FloatArray
    occupied: BoolArray
    max_gap_s: float = MAX_GAP_S
    source: str = "occupancy log"
    # Record r = day * n_slots + slot: looks first[r] to first[r + 1]. A look's state holds from from_s on.
    first: IntArray = field(init=False, repr=False)
    from_s: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        slot, day = np.asarray(self.slot, np.int64), np.asarray(self.day, np.int64)
        second, occupied = np.asarray(self.second, float), np.asarray(self.occupied, bool)
        if not slot.size:
            raise InputError(f"{self.source}: no looks, wanted at least one")
        if not slot.shape == day.shape == second.shape == occupied.shape == (slot.size,):
            raise InputError(f"{self.source}: wanted slot, day, second and occupied of one length")
        for name, index, size in (("slot", slot, len(self.slot_ids)), ("day", day, len(self.days))):
            if index.min() < 0 or index.max() >= size:
                raise InputError(f"{self.source}: {name}: wanted indices from 0 to {size - 1}")
        if list(self.days) != sorted({day for day in self.days if _is_date(day)}):
            raise InputError(f"{self.source}: days: wanted different ISO dates in order")
        if not np.all((second >= 0) & (second < DAY_S)):
            raise InputError(f"{self.source}: second: wanted seconds of the day in [0, 86400)")
        if not self.max_gap_s > 0:
            raise InputError(f"max_gap_s: got {self.max_gap_s}, wanted seconds > 0")
        order = np.lexsort((second, slot, day))
        record = (day * len(self.slot_ids) + slot)[order]
        stands = np.append((np.diff(record) > 0) | (np.diff(second[order]) > 0), True)
        order, record = order[stands], record[stands]
        slot, day, second, occupied = slot[order], day[order], second[order], occupied[order]
        first = np.searchsorted(record, np.arange(len(self.slot_ids) * len(self.days) + 1))
        gap = np.diff(second, prepend=second[0])
        # In a long gap the state changes half-way, where the later look becomes the nearer one.
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

        Columns: `datetime` (ISO, local time), `slot_id`, `occupied` (0 or 1); `camera` and `weather` may be
        there and are not used.
        A slot may be seen by several cameras; its looks must be in order of time.

        Raises:
            InputError: names the file, and the line and value where there is one.
        """
        path = Path(path)
        slots: dict[str, int] = {}
        moments: dict[str, datetime] = {}  # one look at many slots: many lines, one text
        latest: dict[str, datetime] = {}
        looks: list[tuple[int, datetime, bool]] = []
        with _rows(path) as rows:
            at_time, at_slot, at_occupied = _columns(path, rows, _KNOWN, ("datetime", "slot_id", "occupied"))
            for line, row in rows:
                text, slot_id, taken = row[at_time], row[at_slot], row[at_occupied]
                moment = moments.get(text)
                if moment is None:
                    moment = moments[text] = _moment(path, line, text)
                if not slot_id:
                    raise InputError(f"{path}: line {line}: slot_id: empty, wanted a slot's name")
                if taken not in ("0", "1"):
                    raise InputError(f"{path}: line {line}: occupied: got {taken!r}, wanted 0 or 1")
                if moment < latest.get(slot_id, moment):
                    raise InputError(
                        f"{path}: line {line}: datetime: {text} of slot {slot_id} is before its line above,"
                        f" {latest[slot_id]}; wanted looks in order of time"
                    )
                latest[slot_id] = moment
                looks.append((slots.setdefault(slot_id, len(slots)), moment, taken == "1"))
        if not looks:
            raise InputError(f"{path}: no looks, wanted at least one line below the header")
        dates = [moment.date().isoformat() for _, moment, _ in looks]
        days = sorted(set(dates))
        day_index = {day: i for i, day in enumerate(days)}
        seconds = [m.hour * 3600 + m.minute * 60 + m.second + m.microsecond * 1e-6 for _, m, _ in looks]
        return cls(
            tuple(slots),
            tuple(days),
            np.array([slot for slot, _, _ in looks], np.int64),
            np.array([day_index[day] for day in dates], np.int64),
            np.array(seconds, float),
            np.array([taken for _, _, taken in looks], bool),
            max_gap_s,
            str(path),
        )

    @cached_property
    def weekend(self) -> BoolArray:
        """(n_days,) bool: is the day a Saturday or a Sunday?"""
        return np.array([day_class(day) == "weekend" for day in self.days], bool)

    def intervals(self, max_gap_s: float = MAX_GAP_S) -> Intervals:
        """Pairs of consecutive looks at one slot on one day, at most `max_gap_s` apart."""
        same_record = (np.diff(self.slot) == 0) & (np.diff(self.day) == 0)
        earlier = np.flatnonzero(same_record & (np.diff(self.second) <= max_gap_s))
        later = earlier + 1
        return Intervals(
            self.slot[earlier],
            self.day[earlier],
            self.second[earlier],
            self.second[later],
            self.occupied[earlier],
            self.occupied[later],
        )

    def mean_occupancy(
        self, kind: DayClass, hours: tuple[int, int] = (0, DAY_HOURS), days: BoolArray | None = None
    ) -> FloatArray:
        """(m,) float64: share of the time that each slot was taken, between the days' first and last looks.

        Args:
            kind: class of the days.
            hours: first hour of the day, and the hour before which to stop.
            days: (n_days,) bool, of which days; all by default.

        Returns:
            NaN for a slot that was not watched then.
        """
        if kind not in ("weekday", "weekend"):
            raise InputError(f"class of day: got {kind!r}, wanted weekday or weekend")
        used = self.weekend == (kind == "weekend")
        if days is not None:
            used &= days
        window = slice(*hours)
        occupied, seen = (seconds[:, used, window].sum(axis=(1, 2)) for seconds in self._hours[1:])
        mean: FloatArray = np.divide(occupied, seen, out=np.full(occupied.shape, np.nan), where=seen > 0)
        return mean

    @property
    def recorded(self) -> BoolArray:
        """(m, n_days) bool: was the slot seen at all on that day?"""
        return (np.diff(self.first) > 0).reshape(len(self.days), -1).T

    @property
    def replayed_share(self) -> FloatArray:
        """(m, n_days, 24) float64: share of each hour that the replay is taken; 0 without a record."""
        return self._hours.replayed / HOUR_S

    @cached_property
    def _hours(self) -> _Hours:
        shape = (len(self.slot_ids), len(self.days), DAY_HOURS)
        hours = _Hours(np.zeros(shape), np.zeros(shape), np.zeros(shape))
        _sum_hours(self.first, self.from_s, self.second, self.occupied, *hours)
        return hours


@njit(cache=True)
def _add_hours(hours: FloatArray, start: float, end: float) -> None:
    hour = int(start // HOUR_S)
    while start < end:
        stop = min((hour + 1) * HOUR_S, end)
        hours[hour] += stop - start
        start = stop
        hour += 1


@njit(cache=True)
def _sum_hours(
    first: IntArray,
    from_s: FloatArray,
    second: FloatArray,
    taken: BoolArray,
    replayed: FloatArray,
    occupied: FloatArray,
    seen: FloatArray,
) -> None:
    n_slots = replayed.shape[0]
    for record in range(first.size - 1):
        day, slot = record // n_slots, record % n_slots
        last = first[record + 1] - 1
        for look in range(first[record], last + 1):
            start, end = from_s[look], DAY_S if look == last else from_s[look + 1]
            watched, left = max(start, second[first[record]]), min(end, second[last])
            _add_hours(seen[slot, day], watched, left)
            if taken[look]:
                _add_hours(replayed[slot, day], start, end)
                _add_hours(occupied[slot, day], watched, left)


def read_mapping(path: str | os.PathLike[str], lot_slot_ids: Sequence[str], log: OccupancyLog) -> IntArray:
    """Read which slot of a log each slot of a lot replays.

    Args:
        path: CSV file with the columns `slot_id` (of the lot) and `log_slot_id`, a line a slot.
        lot_slot_ids: ids of the lot's slots, n.
        log: the log.

    Returns:
        (n,) int64, indices into `log.slot_ids`, in the order of `lot_slot_ids`.

    Raises:
        InputError: names file, line and value.
    """
    path = Path(path)
    log_index = {slot_id: i for i, slot_id in enumerate(log.slot_ids)}
    lot_index = {slot_id: i for i, slot_id in enumerate(lot_slot_ids)}
    mapping = np.full(len(lot_slot_ids), -1, np.int64)
    with _rows(path) as rows:
        at_slot, at_log_slot = _columns(path, rows, ("slot_id", "log_slot_id"), ("slot_id", "log_slot_id"))
        for line, row in rows:
            slot_id, log_slot_id = row[at_slot], row[at_log_slot]
            if slot_id not in lot_index:
                raise InputError(f"{path}: line {line}: slot_id: got {slot_id!r}, wanted a slot of the lot")
            if mapping[lot_index[slot_id]] >= 0:
                raise InputError(f"{path}: line {line}: slot_id: {slot_id!r} a second time, wanted it once")
            if log_slot_id not in log_index:
                raise InputError(
                    f"{path}: line {line}: log_slot_id: got {log_slot_id!r}, wanted a slot of {log.source}"
                )
            mapping[lot_index[slot_id]] = log_index[log_slot_id]
    missing = [slot_id for slot_id, i in lot_index.items() if mapping[i] < 0]
    if missing:
        raise InputError(
            f"{path}: slot_id: {len(missing)} slots of the lot have no line, the first is {missing[0]!r}"
        )
    return mapping


@contextmanager
def _rows(path: Path) -> Iterator[Iterator[tuple[int, list[str]]]]:
    """Rows of a CSV file with their line numbers; whatever cannot be read becomes an InputError."""
    width = 0

    def rows(file: TextIO) -> Iterator[tuple[int, list[str]]]:
        nonlocal width
        reader = csv.reader(file)
        for row in reader:
            width = width or len(row)
            if row and len(row) != width:
                raise InputError(f"{path}: line {reader.line_num}: got {len(row)} fields, wanted {width}")
            if row:
                yield reader.line_num, row

    opened: Callable[..., Any] = gzip.open if path.suffix == ".gz" else open
    try:
        with opened(path, "rt", encoding="utf-8-sig", newline="") as file:
            yield rows(file)
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise InputError(f"{path}: not a whole gzip file ({error}), wanted it complete") from error
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}, wanted a CSV file") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not CSV text in UTF-8 ({error})") from error


def _columns(
    path: Path, rows: Iterator[tuple[int, list[str]]], known: Sequence[str], needed: Sequence[str]
) -> list[int]:
    """Where the needed columns stand in the header."""
    _, header = next(rows, (0, []))
    if not header:
        raise InputError(f"{path}: empty, wanted a header with the columns {', '.join(needed)}")
    for name in header:
        if name not in known:
            raise InputError(f"{path}: column {name!r} is unknown, wanted some of {', '.join(known)}")
        if header.count(name) > 1:
            raise InputError(f"{path}: column {name!r} stands there twice, wanted it once")
    for name in needed:
        if name not in header:
            raise InputError(f"{path}: column {name!r} is missing, wanted {', '.join(needed)}")
    return [header.index(name) for name in needed]


def _moment(path: Path, line: int, text: str) -> datetime:
    wanted = "wanted local date and time, for example 2015-11-12 07:09"
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        moment = None
    if moment is None or ":" not in text or moment.tzinfo is not None:
        raise InputError(f"{path}: line {line}: datetime: got {text!r}, {wanted}")
    return moment


@njit(cache=True)
def _replay(
    slots: IntArray,
    second: float,
    free: bool,
    first: IntArray,
    stop: IntArray,
    from_s: FloatArray,
    taken: BoolArray,
) -> FloatArray:
    """1.0 or 0.0: taken at `second` or not; with `free`, the second from which the slot is free."""
    answer = np.empty(slots.size)
    for i, slot in enumerate(slots):
        if not 0 <= slot < first.size:
            raise IndexError("slot index out of range")
        end = stop[slot]
        look = first[slot] + np.searchsorted(from_s[first[slot] : end], second, side="right") - 1
        if not free:
            answer[i] = 1.0 if taken[look] else 0.0
            continue
        answer[i] = second
        while look < end and taken[look]:
            look += 1
            answer[i] = from_s[look] if look < end else np.inf
    return answer


class RecordedWorld:
    """One recorded day, replayed; past the end of the day its last state holds."""

    def __init__(self, log: OccupancyLog, records: IntArray, arrival: Arrival) -> None:
        self.log = log
        self.arrival = arrival
        self._first, self._stop = log.first[records], log.first[records + 1]
        self._midnight = weekday_of(arrival.day) * DAY_S

    def occupied(self, slots: ArrayLike, time: float) -> BoolArray:
        """(k,) bool: is each of the slots (k,) taken at `time`, which is at or after the arrival?"""
        return self._look(slots, time, free=False) > 0

    def next_free(self, slots: ArrayLike, time: float) -> FloatArray:
        """(k,) float64, s: the earliest time >= `time` at which each slot is free; inf if never."""
        return np.maximum(self._look(slots, time, free=True) + self._midnight, time)

    def _look(self, slots: ArrayLike, time: float, free: bool) -> FloatArray:
        if not self.arrival.time <= time < math.inf:
            raise InputError(
                f"time: got {time}, wanted finite seconds from the arrival at {self.arrival.time} on"
            )
        second = float(time) - self._midnight
        looks = (self._first, self._stop, self.log.from_s, self.log.occupied)
        answer: FloatArray = _replay(np.asarray(slots, np.int64), second, free, *looks)
        return answer


class _Layout(NamedTuple):
    """What does not depend on the second of an arrival on a given day."""

    log_slot: IntArray  # (n,)
    record: IntArray  # (n,)
    held_out: frozenset[int]  # days that the world replays: the forecast must not know them
    share: FloatArray  # (m, 24) share of each hour taken, summed over the other days
    n_days: IntArray  # (m,) other days with a record
    relaxation_rate: float


@dataclass(frozen=True, eq=False)
class RecordedOccupancy:
    """A log laid on the n slots of a lot: every episode replays a recorded day.

    The lot's slots, nearest to the goal first, get the log's m slots, fullest first (mean occupancy on the
    days of the arrival's class, weekday or weekend): rank r gets log rank floor(r·m/n). If the lot is larger,
    a log slot serves several lot slots: the k-th copy replays the k-th next recorded day of the class on
    which the log slot was seen, cyclically, so no two slots share a record. If it is smaller, the ranks are
    thinned evenly.

    Nothing of the days that a world replays is used to lay it out or to forecast it.

    Args:
        log: the recorded looks.
        walk_m: (n,) float64, m, walking distance from each slot to the goal.
        mapping: (n,) int64, log slot of each lot slot, in place of the rule (see `read_mapping`).
    """

    log: OccupancyLog
    walk_m: FloatArray
    mapping: IntArray | None = None
    _layouts: dict[int, _Layout] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        walk = np.array(self.walk_m, float)
        if walk.ndim != 1 or not walk.size or not np.all((walk >= 0) & np.isfinite(walk)):
            raise InputError(f"walk_m: got shape {walk.shape}, wanted (n,) finite metres >= 0")
        object.__setattr__(self, "walk_m", walk)
        if self.mapping is not None:
            mapping = np.array(self.mapping, np.int64)
            m = len(self.log.slot_ids)
            if mapping.shape != walk.shape or mapping.min() < 0 or mapping.max() >= m:
                raise InputError(f"mapping: wanted ({walk.size},) indices of log slots from 0 to {m - 1}")
            object.__setattr__(self, "mapping", mapping)

    @property
    def n_slots(self) -> int:
        """Number of slots of the lot."""
        return int(self.walk_m.size)

    def draw_arrival(self, window: ArrivalWindow, key: np.uint64) -> Arrival:
        """A recorded day, uniform among those on the window's weekdays, and a time of day, uniform in it."""
        days = [day for day in self.log.days if weekday_of(day) in window.weekdays]
        if not days:
            names = ",".join(DAY_NAMES[weekday] for weekday in window.weekdays)
            raise InputError(f"{self.log.source}: no recorded day is one of {names}")
        day = days[int(keyed_uniform(key, ARRIVAL_STREAM, 0, 0) * len(days))]
        return Arrival(weekday_of(day) * DAY_S + window.draw_second(key), day)

    def world(self, key: np.uint64, arrival: Arrival) -> RecordedWorld:  # noqa: ARG002 - the day decides all
        """The replay of the arrival's day."""
        return RecordedWorld(self.log, self._layout(arrival).record, arrival)

    def forecast(self, arrival: Arrival) -> Forecast:
        """What the other days of the class say of the hour around the arrival.

        Per log slot the mean over the days that the world does not replay, shrunk by a Beta prior worth one
        day to the mean of all the log's slots, and clipped to [0.001, 0.999]. The relaxation rate is that of
        one chain with constant rates, fitted to all looks on those days.
        """
        layout = self._layout(arrival)
        hours = np.arange(DAY_HOURS) * HOUR_S
        second = arrival.time - weekday_of(arrival.day) * DAY_S
        overlap = np.minimum(hours + HOUR_S, second + HOUR_S / 2) - np.maximum(hours, second - HOUR_S / 2)
        weight = np.maximum(overlap, 0.0)
        taken = layout.share @ (weight / weight.sum())
        lot_mean = taken.sum() / layout.n_days.sum()
        p = (taken + PRIOR_DAYS * lot_mean) / (layout.n_days + PRIOR_DAYS)
        p = np.clip(p, MIN_PROBABILITY, MAX_PROBABILITY)[layout.log_slot]
        return Forecast(p, np.full(self.n_slots, layout.relaxation_rate))

    def _layout(self, arrival: Arrival) -> _Layout:
        if arrival.day not in self.log.days:
            raise InputError(f"Arrival.day: got {arrival.day!r}, wanted a recorded day of {self.log.source}")
        second = arrival.time - weekday_of(arrival.day) * DAY_S
        if not 0 <= second < DAY_S:
            raise InputError(f"Arrival.time: got {arrival.time}, wanted a second of {arrival.day}")
        day = self.log.days.index(arrival.day)
        if day not in self._layouts:
            self._layouts[day] = self._lay_out(day)
        return self._layouts[day]

    def _lay_out(self, day: int) -> _Layout:
        log = self.log
        same_class = np.flatnonzero(log.weekend == log.weekend[day])
        replay_order = np.roll(same_class, -int(np.searchsorted(same_class, day)))
        held_out = {day}
        while True:
            others = np.isin(np.arange(len(log.days)), [d for d in same_class if d not in held_out])
            if not others.any():
                raise InputError(
                    f"{log.source}: a world of {self.n_slots} slots replays all {same_class.size} recorded"
                    f" {day_class(log.days[day])} days, wanted at least one more to forecast from"
                )
            log_slot = self._assign(log.days[day], others) if self.mapping is None else self.mapping
            days = self._replay_days(log_slot, replay_order)
            # What is replayed must not have had a say in the ranks: rank again without it.
            if held_out.issuperset(days):
                break
            held_out.update(days)
        looks = log.intervals(log.max_gap_s)
        used = others[looks.day]
        if not used.any():
            raise InputError(
                f"{log.source}: no two consecutive looks on the days that are left to forecast from"
            )
        rates = fit_constant_rates((looks.end - looks.start)[used], looks.before[used], looks.after[used])
        return _Layout(
            log_slot,
            days * len(log.slot_ids) + log_slot,
            frozenset(held_out),
            log.replayed_share[:, others].sum(axis=1),
            log.recorded[:, others].sum(axis=1),
            sum(rates),
        )

    def _assign(self, day: str, others: BoolArray) -> IntArray:
        """(n,) log slot of each lot slot, by the rule of the ranks."""
        n, m = self.n_slots, len(self.log.slot_ids)
        mean = self.log.mean_occupancy(day_class(day), days=others)
        unknown = np.isnan(mean)
        mean[unknown] = 0.0 if unknown.all() else mean[~unknown].mean()
        log_slot = np.empty(n, np.int64)
        log_slot[np.argsort(self.walk_m, kind="stable")] = np.argsort(-mean, kind="stable")[
            np.arange(n) * m // n
        ]
        return log_slot

    def _replay_days(self, log_slot: IntArray, replay_order: IntArray) -> IntArray:
        """(n,) day that each lot slot replays: copies of a log slot, nearest first, take the days in turn."""
        recorded = self.log.recorded[:, replay_order]
        days = np.empty(self.n_slots, np.int64)
        left = {int(s): iter(replay_order[recorded[s]]) for s in np.unique(log_slot)}
        for slot in np.argsort(self.walk_m, kind="stable"):
            chosen = next(left[int(log_slot[slot])], None)
            if chosen is None:
                name = self.log.slot_ids[log_slot[slot]]
                n_copies, n_days = (
                    int((log_slot == log_slot[slot]).sum()),
                    int(recorded[log_slot[slot]].sum()),
                )
                raise InputError(
                    f"{self.log.source}: slot {name} would serve {n_copies} slots of the lot but was recorded"
                    f" on {n_days} days of the class; wanted a smaller lot or a longer log"
                )
            days[slot] = chosen
        return days
