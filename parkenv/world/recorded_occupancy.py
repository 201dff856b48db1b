"""Worlds that replay the days of a log on the slots of a lot."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parkenv.errors import InputError
from parkenv.files.limited_reading import csv_rows
from parkenv.world.day_error import EXACT, DayError
from parkenv.world.keyed_random import ARRIVAL_STREAM, keyed_uniform
from parkenv.world.occupancy import (
    DAY_NAMES,
    Arrival,
    ArrivalWindow,
    BoolArray,
    FloatArray,
    Forecast,
    IntArray,
)
from parkenv.world.occupancy_fit import fit_constant_rates
from parkenv.world.occupancy_kernel import (
    RECORDED_DAY,
    kernel,
    recorded_day_at,
    recorded_forecast,
    recorded_index,
)
from parkenv.world.occupancy_log import OccupancyLog, csv_columns, day_class, weekday_of
from parkenv.world.pointers import address_of, float64s, int64s, uint8s
from parkenv.world.week import DAY_S


def read_mapping(path: str | os.PathLike[str], lot_slot_ids: Sequence[str], log: OccupancyLog) -> IntArray:
    """Read the mapping from the slots of a lot to the slots of a log.

    Args:
        path: CSV file with the columns `slot_id` (of the lot) and `log_slot_id`, one line per slot.
        lot_slot_ids: ids of the lot's slots, n.
        log: the log.

    Returns:
        (n,) int64, indices into `log.slot_ids`, in the order of `lot_slot_ids`.

    Raises:
        InputError: an invalid file; the message names file, line and value.
    """
    path = Path(path)
    log_index = {slot_id: i for i, slot_id in enumerate(log.slot_ids)}
    lot_index = {slot_id: i for i, slot_id in enumerate(lot_slot_ids)}
    mapping = np.full(len(lot_slot_ids), -1, np.int64)
    rows = csv_rows(path)
    at_slot, at_log_slot = csv_columns(path, rows, ("slot_id", "log_slot_id"), ("slot_id", "log_slot_id"))
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


@kernel
def _occupied(days: int, slots: IntArray, second: float, occupied: BoolArray) -> None:
    """Write whether each slot is taken at a second of the day."""
    day = recorded_day_at(days, 0)
    for i in range(slots.size):
        occupied[i] = uint8s(day.occupied)[recorded_index(day, slots[i], second)] != 0


@kernel
def _next_free(days: int, slots: IntArray, second: float, free_from: FloatArray) -> None:
    """Write the first second >= `second` at which each slot is free; inf if never."""
    day = recorded_day_at(days, 0)
    for i in range(slots.size):
        k, end = recorded_index(day, slots[i], second), int64s(day.first)[int64s(day.record)[slots[i]] + 1]
        free_from[i] = second
        while k < end and uint8s(day.occupied)[k] != 0:
            k += 1
            free_from[i] = float64s(day.from_s)[k] if k < end else np.inf


@kernel
def _changes(days: int, slots: IntArray, second: float, count: IntArray) -> None:
    """Write how often each slot's state has changed between its first observation and `second`."""
    day = recorded_day_at(days, 0)
    taken = uint8s(day.occupied)
    for i in range(slots.size):
        first = int64s(day.first)[int64s(day.record)[slots[i]]]
        count[i] = 0
        for k in range(first + 1, recorded_index(day, slots[i], second) + 1):
            count[i] += taken[k] != taken[k - 1]


@kernel
def _forecast(days: int, second: float, p: FloatArray) -> None:
    for slot in range(p.size):
        p[slot] = recorded_forecast(recorded_day_at(days, 0), slot, second)


class RecordedWorld:
    """A replayed recorded day; after the end of the day its last state holds."""

    def __init__(self, occupancy: "RecordedOccupancy", arrival: Arrival) -> None:
        self.arrival = arrival
        self._occupancy = occupancy  # keeps the record's arrays alive
        self._day = occupancy.day_records([arrival.day])
        self._midnight = float(self._day["midnight"][0])

    def occupied(self, slots: ArrayLike, time: float) -> BoolArray:
        """(k,) bool, whether each of the slots (k,) is taken at `time`, at or after the arrival."""
        slots, second = self._checked(slots), self._second(time)
        occupied = np.empty(slots.size, np.bool_)
        _occupied(address_of(self._day, RECORDED_DAY), slots, second, occupied)
        return occupied

    def next_free(self, slots: ArrayLike, time: float) -> FloatArray:
        """(k,) float64, s: the earliest time >= `time` at which each slot is free; inf if never."""
        slots, second = self._checked(slots), self._second(time)
        free_from = np.empty(slots.size)
        _next_free(address_of(self._day, RECORDED_DAY), slots, second, free_from)
        return np.maximum(free_from + self._midnight, time)

    def sojourn(self, slots: ArrayLike, time: float) -> IntArray:
        """(k,) int64, how often the state of each slot has changed since its first observation of the day."""
        slots, second = self._checked(slots), self._second(time)
        count = np.empty(slots.size, np.int64)
        _changes(address_of(self._day, RECORDED_DAY), slots, second, count)
        return count

    def _checked(self, slots: ArrayLike) -> IntArray:
        slots = np.ascontiguousarray(slots, np.int64)
        if slots.size and not (slots.min() >= 0 and slots.max() < self._occupancy.n_slots):
            raise IndexError("slot index out of range")
        return slots

    def _second(self, time: float) -> float:
        """Second of the recorded day."""
        if not self.arrival.time <= time < math.inf:
            raise InputError(
                f"time: got {time}, wanted finite seconds from the arrival at {self.arrival.time} on"
            )
        return float(time) - self._midnight


class MappedLog(NamedTuple):
    """The log mapped to the lot for one replayed day, independent of the time of arrival."""

    log_slot: IntArray  # (n,)
    record: IntArray  # (n,)
    held_out: frozenset[int]  # days that the world replays; the forecast must not use them
    share: FloatArray  # (m * 24,) fraction of each hour taken, summed over the other days
    lot_share: FloatArray  # (24,) the same, also summed over the slots
    n_days: IntArray  # (m,) number of other days with a record
    n_records: int  # sum of n_days
    decay_rate: float
    day_error: DayError = EXACT


@dataclass(frozen=True, eq=False)
class RecordedOccupancy:
    """A log mapped to the n slots of a lot: every episode replays a recorded day.

    The lot's slots, nearest to the goal first, get the log's m slots, fullest first (mean occupancy on the
    days of the arrival's class, weekday or weekend): rank r gets log rank floor(r·m/n). If the lot is larger,
    several lot slots share a log slot: the k-th copy replays the k-th next recorded day of the class on which the log
    slot was observed, cyclically, so no two slots share a record. If it is smaller, the ranks are thinned evenly.

    The days that a world replays are not used to map or forecast it.

    Args:
        log: the recorded observations.
        walk_m: (n,) float64, m, walking distance from each slot to the goal.
        mapping: (n,) int64, log slot of each lot slot, instead of this rule (see `read_mapping`).
    """

    log: OccupancyLog
    walk_m: FloatArray
    mapping: IntArray | None = None
    _mapped_logs: dict[int, MappedLog] = field(init=False, repr=False, default_factory=dict)

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
        """Draw a recorded day among those on the window's weekdays, and a time of day, both uniform."""
        days = self.days_in(window)
        day = days[int(keyed_uniform(key, ARRIVAL_STREAM, 0, 0) * len(days))]
        return Arrival(weekday_of(day) * DAY_S + window.draw_second(key), day)

    def days_in(self, window: ArrivalWindow) -> list[str]:
        """Return the recorded days on the window's weekdays; InputError if there are none."""
        days = [day for day in self.log.days if weekday_of(day) in window.weekdays]
        if not days:
            names = ",".join(DAY_NAMES[weekday] for weekday in window.weekdays)
            raise InputError(f"{self.log.source}: no recorded day is one of {names}")
        return days

    def world(self, key: np.uint64, arrival: Arrival) -> RecordedWorld:  # noqa: ARG002 - the day decides all
        """Return the replay of the arrival's day."""
        self._at(arrival)
        return RecordedWorld(self, arrival)

    def forecast(self, arrival: Arrival) -> Forecast:
        """Forecast the occupancy from the hour around the arrival on the other days of its class.

        P(taken) is the mean of a log slot over the days that the world does not replay, shrunk by a Beta prior worth
        one day to the mean of all the log's slots, and clipped to [0.001, 0.999]. The decay rate is that of one chain
        with constant rates, fitted to all observations on those days.
        """
        mapped = self._at(arrival)
        p = np.empty(self.n_slots)
        day = self.day_records([arrival.day])
        _forecast(address_of(day, RECORDED_DAY), arrival.time - float(day["midnight"][0]), p)
        return Forecast(p, np.full(self.n_slots, mapped.decay_rate), mapped.day_error)

    def day_records(self, days: Sequence[str]) -> NDArray[np.void]:
        """Return recorded days for compiled code, (k,) of the dtype RECORDED_DAY; valid while this object lives."""
        log = self.log
        records = np.empty(len(days), RECORDED_DAY)
        for record, day in zip(records, days, strict=True):
            mapped = self.mapped_log(day)
            record["midnight"], record["decay_rate"] = weekday_of(day) * DAY_S, mapped.decay_rate
            record["n_records"] = mapped.n_records
            record["day_error"] = mapped.day_error.level, mapped.day_error.slope
            for name in ("log_slot", "record", "n_days"):
                record[name] = address_of(getattr(mapped, name), np.int64)
            for name in ("share", "lot_share"):
                record[name] = address_of(getattr(mapped, name), np.float64)
            record["first"], record["from_s"] = (
                address_of(log.first, np.int64),
                address_of(log.from_s, np.float64),
            )
            record["occupied"] = address_of(log.occupied, np.bool_)
        return records

    def _at(self, arrival: Arrival) -> MappedLog:
        if arrival.day not in self.log.days:
            raise InputError(f"Arrival.day: got {arrival.day!r}, wanted a recorded day of {self.log.source}")
        second = arrival.time - weekday_of(arrival.day) * DAY_S
        if not 0 <= second < DAY_S:
            raise InputError(f"Arrival.time: got {arrival.time}, wanted a second of {arrival.day}")
        return self.mapped_log(arrival.day)

    def mapped_log(self, day: str) -> MappedLog:
        """Return the log mapped to the lot for the replay of `day`, a day of the log."""
        index = self.log.days.index(day)
        if index not in self._mapped_logs:
            self._mapped_logs[index] = self._map_log(index)
        return self._mapped_logs[index]

    def _map_log(self, day: int) -> MappedLog:
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
            # Replayed days must not affect the ranks: rank again without them.
            if held_out.issuperset(days):
                break
            held_out.update(days)
        pairs = log.intervals(log.max_gap_s)
        used = others[pairs.day]
        if not used.any():
            raise InputError(
                f"{log.source}: no two consecutive observations on the days that are left to forecast from"
            )
        rates = fit_constant_rates((pairs.end - pairs.start)[used], pairs.before[used], pairs.after[used])
        share = log.replayed_share[:, others].sum(axis=1)
        n_days = log.recorded[:, others].sum(axis=1)
        return MappedLog(
            log_slot,
            days * len(log.slot_ids) + log_slot,
            frozenset(held_out),
            share.ravel(),
            share.sum(axis=0),
            n_days,
            int(n_days.sum()),
            sum(rates),
        )

    def _assign(self, day: str, others: BoolArray) -> IntArray:
        """Return the log slot of each lot slot by rank, (n,)."""
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
        """Return each lot slot's replay day, (n,): copies of a log slot, nearest first, cycle through the days."""
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
