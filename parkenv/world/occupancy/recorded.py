"""Worlds that replay the days of a log on the slots of a lot."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import logit

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.jit import kernel
from parkenv.compiled.memory import address_of, uint8s
from parkenv.errors import InputError, require, require_one_of
from parkenv.files.field_types import as_array
from parkenv.files.known_names import CHANGES, FORECAST_FROM, SAME_SLOTS, Changes, ForecastFrom
from parkenv.files.limited_reading import csv_rows
from parkenv.forecast.slot_days import MAX_DAYS, fit_slot_days
from parkenv.world.occupancy.arrival_window import DAY_NAMES, ArrivalWindow
from parkenv.world.occupancy.day_error import MAX_LOGITS, DayError
from parkenv.world.occupancy.fit import fit_hourly_decay_rates
from parkenv.world.occupancy.gaps import DayStates, StateLaw, day_states, states_between_looks
from parkenv.world.occupancy.kernel import (
    LOG_KIND,
    MAX_PROBABILITY,
    MIN_PROBABILITY,
    RECORDED_DAY,
    recorded_changes,
    recorded_day_at,
    recorded_day_level,
    recorded_forecast,
    recorded_index,
    recorded_next_free,
)
from parkenv.world.occupancy.log import OccupancyLog, day_class, weekday_of
from parkenv.world.occupancy.process import (
    Arrival,
    CompiledModel,
    Forecast,
    OccupancyModel,
    World,
    checked_slots,
)
from parkenv.world.week import DAY_S

_SOME = 0.1  # of the most slots that a day has, which a day needs at least to be replayed


def read_mapping(
    path: str | os.PathLike[str], lot_slot_ids: Sequence[str], names: Sequence[str], source: str
) -> IntArray:
    """Return the log's slot of each slot of the lot, (n,) indices of its `names`; -1 for those without a record.

    Raises:
        InputError: names the file, the line and the value; or none has a record.
    """
    path = Path(path)
    log_index = {slot_id: i for i, slot_id in enumerate(names)}
    lot_index = {slot_id: i for i, slot_id in enumerate(lot_slot_ids)}
    seen = set[str]()
    mapping = np.full(len(lot_slot_ids), -1, np.int64)
    rows = csv_rows(path)
    _, header = next(rows, (0, []))
    if sorted(header) != ["log_slot_id", "slot_id"]:
        raise InputError(f"{path}: has the columns {', '.join(header)!r:.120}, want slot_id,log_slot_id")
    at_slot, at_log_slot = header.index("slot_id"), header.index("log_slot_id")
    for line, row in rows:
        slot_id, log_slot_id = row[at_slot], row[at_log_slot]
        if slot_id not in lot_index:
            raise InputError(f"{path}: line {line}: slot_id is {slot_id!r}, want a slot of the lot")
        if slot_id in seen:
            raise InputError(f"{path}: line {line}: slot_id: {slot_id!r} a second time, want it once")
        seen.add(slot_id)
        mapping[lot_index[slot_id]] = log_index.get(log_slot_id, -1)
    return some_mapped(mapping, f"{path}: log_slot_id", names, source)


def some_mapped(mapping: IntArray, what: str, names: Sequence[str], source: str) -> IntArray:
    if not (mapping >= 0).any():
        raise InputError(
            f"{what}: none is among the {len(names):,} names of {source}, whose first is {names[0]!r:.60}"
        )
    return mapping


def _decay_rates(log: OccupancyLog, days: IntArray) -> FloatArray:
    pairs = log.intervals(log.max_gap_s)
    used = np.isin(pairs.day, days)
    require(
        used.any(), f"{log.source}: no two observations in a row on the days that are left to forecast from"
    )
    return fit_hourly_decay_rates(pairs.start[used], pairs.end[used], pairs.before[used], pairs.after[used])


def same_slots(lot_slot_ids: Sequence[str], log: OccupancyLog) -> IntArray:
    log_index = {slot_id: i for i, slot_id in enumerate(log.slot_ids)}
    mapping = np.array([log_index.get(slot_id, -1) for slot_id in lot_slot_ids], np.int64)
    return some_mapped(mapping, f"mapping {SAME_SLOTS!r}: slot", log.slot_ids, log.source)


@kernel
def _query(
    days: int, slots: IntArray, second: float, occupied: BoolArray, free_from: FloatArray, changes: IntArray
) -> None:
    """Write whether each slot is taken at a second of the day, and how often its state has changed until then.

    `free_from` is the first second from then on at which it is free, infinite if never.
    """
    day = recorded_day_at(days, 0)
    for i in range(slots.size):
        occupied[i] = uint8s(day.occupied)[recorded_index(day, slots[i], second)] != 0
        free_from[i] = recorded_next_free(day, slots[i], second)
        changes[i] = recorded_changes(day, slots[i], second)


@kernel
def _forecast(days: int, second: float, p: FloatArray, decay_rate: FloatArray) -> float:
    """Write the forecast of the slots at a second of the day, and return the deviation of their level, logits."""
    day = recorded_day_at(days, 0)
    for slot in range(p.size):
        p[slot], decay_rate[slot] = recorded_forecast(day, slot, second)
    return float(recorded_day_level(day, second))


class RecordedWorld(World):
    """A replayed recorded day; after the end of the day its last state holds."""

    def __init__(self, occupancy: RecordedOccupancy, arrival: Arrival) -> None:
        self.arrival = arrival
        self._occupancy = occupancy  # keeps the record's arrays alive
        self._day = occupancy.day_records([arrival.day], forecast=False)
        self._midnight = float(self._day["midnight"][0])

    def __reduce__(self) -> tuple[Any, ...]:
        """Copies and pickles make a record of their own: it holds addresses."""
        return RecordedWorld, (self._occupancy, self.arrival)

    def occupied(self, slots: ArrayLike, time: float) -> BoolArray:
        return self._query(slots, time)[0]

    def next_free(self, slots: ArrayLike, time: float) -> FloatArray:
        return np.maximum(self._query(slots, time)[1] + self._midnight, time)

    def sojourn(self, slots: ArrayLike, time: float) -> IntArray:
        return self._query(slots, time)[2]

    def _query(self, slots: ArrayLike, time: float) -> tuple[BoolArray, FloatArray, IntArray]:
        if not self.arrival.time <= time < math.inf:
            raise InputError(
                f"time is {time}, want finite seconds from the arrival at {self.arrival.time} on"
            )
        slots = checked_slots(slots, self._occupancy.n_slots)
        answers = np.empty(slots.size, np.bool_), np.empty(slots.size), np.empty(slots.size, np.int64)
        _query(address_of(self._day, RECORDED_DAY), slots, float(time) - self._midnight, *answers)
        return answers


class MappedLog(NamedTuple):
    """The log mapped to the lot for one replayed day, independent of the time of arrival."""

    log_slot: IntArray  # (n,); -1: no record
    record: IntArray  # (n,); -1: none
    held_out: frozenset[int]  # days that the world replays; the forecast must not use them
    known: IntArray  # (k,) days that it is made from
    replayed: IntArray  # (n,) day that each slot replays


class ReplayForecast(NamedTuple):
    log_odds: FloatArray  # (n, 48) of P(taken), in the middles of the half-hours
    day_level: FloatArray  # (48,) standard deviation of the error of the lot's level, logits
    decay_rate: FloatArray  # (24,) 1/s, by hour


@dataclass(frozen=True, eq=False)
class RecordedOccupancy(OccupancyModel):
    """A log mapped to the n slots of a lot: every episode replays a recorded day.

    The lot's slots, nearest to the goal first, get the log's m slots, fullest first (mean occupancy on the
    days of the arrival's class, weekday or weekend): rank r gets log rank floor(r·m/n). If the lot is larger,
    several lot slots share a log slot: the k-th copy replays the k-th next recorded day of the class on which the log
    slot was observed, so no two slots share a record. After the last day follows the first one with `others`, else the
    day before the arrival's, and so back. If it is smaller, the ranks are thinned evenly.

    The days that a world replays are not used to map or forecast it; nor, unless with `others`, is any later day.

    What the record does not know is drawn from the forecast's law, the same on a day for every episode (see
    `parkenv.world.occupancy.gaps`). So is a slot without a record, with the mean forecast of the slots of its group.

    Args:
        log: the recorded observations.
        walk_m: (n,) float64, m, walking distance from each slot to the goal.
        mapping: (n,) int64, log slot of each lot slot, -1 for none, instead of this rule (see `read_mapping`).
        replay_from: first day that is replayed; all days by default.
        forecast_from: the days of the arrival's class that the forecast and the ranks are made from: `others`, all
            that the world does not replay; `rolling`, those before the earliest that the world replays; `past`, those
            before `replay_from`. The last two need a `replay_from`.
        group: (n,) int64, group of each slot, such as its facility; one by default.
        changes: when a state changes between two looks at a slot, of a log of looks: `midway`, for all slots of a
            round at once; `drawn`, each at its own moment, from the forecast's law given both looks.
    """

    kind: ClassVar[int] = LOG_KIND
    recorded: ClassVar[bool] = True
    averaged: ClassVar[int] = 1
    log: OccupancyLog
    walk_m: FloatArray
    mapping: IntArray | None = None
    replay_from: date | None = None
    forecast_from: ForecastFrom = "others"
    group: IntArray | None = None
    changes: Changes = "midway"
    _mapped_logs: dict[int, MappedLog] = field(init=False, repr=False, default_factory=dict)
    _forecasts: dict[int, ReplayForecast] = field(init=False, repr=False, default_factory=dict)
    _states: dict[int, DayStates] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "walk_m", as_array("walk_m", self.walk_m, -1, least=0.0))
        if self.mapping is not None:
            mapping, m = (
                as_array("mapping", self.mapping, self.n_slots, dtype=np.int64),
                len(self.log.slot_ids),
            )
            if mapping.min() < -1 or mapping.max() >= m:
                raise InputError(f"mapping: want ({self.n_slots},) indices of log slots from -1 to {m - 1}")
            object.__setattr__(self, "mapping", mapping)
        require_one_of("forecast_from", self.forecast_from, FORECAST_FROM)
        require_one_of("changes", self.changes, CHANGES)
        if self.replay_from is None and self.forecast_from != "others":
            raise InputError(f"forecast_from is {self.forecast_from!r}, want replay_from with it")

    @property
    def n_slots(self) -> int:
        return int(self.walk_m.size)

    def with_fixed_slots(self, window: ArrivalWindow) -> RecordedOccupancy:
        """Return the same days with the log's slots at the same slots of the lot on every day.

        The ranks are those over all days of the class of the window's first day: before `replay_from`, or all with
        `others`. A mapping is kept.
        """
        if self.mapping is not None:
            return self
        log, day = self.log, self.days_in(window)[0]
        same_class = np.flatnonzero(log.weekend == log.weekend[log.days.index(day)])
        known = same_class if self.forecast_from == "others" else same_class[same_class < self._first]
        return dataclasses.replace(self, mapping=self._assign(day, known))

    @property
    def _first(self) -> int:
        first = "" if self.replay_from is None else self.replay_from.isoformat()
        return int(np.searchsorted(self.log.days, first))

    def compiled(self, window: ArrivalWindow) -> CompiledModel:
        return CompiledModel(self.day_records(self.days_in(window)), {}, (self,))

    def days_in(self, window: ArrivalWindow) -> list[str]:
        n = self.log.recorded.sum(axis=0)  # a day of which a few slots alone are known is none to search on
        days = [
            day
            for day, recorded in zip(
                self.log.days[self._first :], n[self._first :] >= _SOME * n.max(), strict=True
            )
            if recorded and weekday_of(day) in window.weekdays
        ]
        if not days:
            names = ",".join(DAY_NAMES[weekday] for weekday in window.weekdays)
            there = f"its {len(n)} days are from {self.log.days[0]} to {self.log.days[-1]}"
            since = "" if self.replay_from is None else f" from {self.replay_from} on"
            raise InputError(f"{self.log.source}: no recorded day{since} is one of {names}; {there}")
        return days

    def world(self, key: np.uint64, arrival: Arrival) -> RecordedWorld:  # noqa: ARG002 - the day decides all
        self._second(arrival)
        return RecordedWorld(self, arrival)

    def forecast(self, arrival: Arrival) -> Forecast:
        """Forecast the occupancy at the arrival by `parkenv.forecast.slot_days`, clipped to [0.001, 0.999].

        The decay rates are those of the hour, fitted to all observations on the days that the forecast is made from.
        The day error is that of the lot as a whole: where several days are replayed at once, their errors partly
        cancel.
        """
        second = self._second(arrival)
        day = self.day_records([arrival.day])
        p, decay_rate = np.empty(self.n_slots), np.empty(self.n_slots)
        level = _forecast(address_of(day, RECORDED_DAY), second, p, decay_rate)
        return Forecast(p, decay_rate, DayError(level))

    def day_records(self, days: Sequence[str], forecast: bool = True) -> NDArray[np.void]:
        """Return recorded days for compiled code, (k,) of the dtype RECORDED_DAY; valid while this object lives."""
        records = np.zeros(len(days), RECORDED_DAY)
        for record, day in zip(records, days, strict=True):
            record["midnight"] = weekday_of(day) * DAY_S
            states = self.day_states(day)
            record["first"] = address_of(states.first, np.int64)
            record["from_s"] = address_of(states.from_s, np.float64)
            record["occupied"] = address_of(states.occupied, np.bool_)
            if forecast:
                for name, values in self.day_forecast(day)._asdict().items():
                    record[name] = address_of(values, np.float64)
        return records

    def _second(self, arrival: Arrival) -> float:
        if arrival.day not in self.log.days[self._first :]:
            raise InputError(f"Arrival.day is {arrival.day!r}, want a recorded day of {self.log.source}")
        second = arrival.time - weekday_of(arrival.day) * DAY_S
        if not 0 <= second < DAY_S:
            raise InputError(f"Arrival.time is {arrival.time}, want a second of {arrival.day}")
        return second

    def mapped_log(self, day: str) -> MappedLog:
        """Return the log mapped to the lot for the replay of `day`, a day of the log."""
        index = self.log.days.index(day)
        if index not in self._mapped_logs:
            self._mapped_logs[index] = self._map_log(index)
        return self._mapped_logs[index]

    def _map_log(self, day: int) -> MappedLog:
        log = self.log
        same_class = np.flatnonzero(log.weekend == log.weekend[day])
        later, earlier = same_class[same_class >= max(day, self._first)], same_class[same_class < day]
        earlier = earlier[earlier >= self._first]
        replay_order = np.append(later, earlier if self.forecast_from == "others" else earlier[::-1])
        held_out = {day}
        while True:
            known = self._known(same_class, held_out)
            log_slot = self._assign(log.days[day], known) if self.mapping is None else self.mapping
            days, log_slot = self._replay_days(log_slot, replay_order)
            # Replayed days must not affect the ranks: rank again without them.
            if held_out.issuperset(days):
                break
            held_out.update(days)
        record = np.where(log_slot < 0, -1, days * len(log.slot_ids) + log_slot)
        return MappedLog(log_slot, record, frozenset(held_out), known, days)

    def day_states(self, day: str) -> DayStates:
        """Return the states of the lot's slots in the replay of `day`, a day of the log."""
        index = self.log.days.index(day)
        if index not in self._states:
            forecast, rng = self.day_forecast(day), np.random.default_rng(date.fromisoformat(day).toordinal())
            law = StateLaw(forecast.log_odds, forecast.decay_rate)
            drawn = self.changes == "drawn" and not self.log.continuous
            states = states_between_looks if drawn else day_states
            self._states[index] = states(self.log, self.mapped_log(day).record, law, rng)
        return self._states[index]

    def day_forecast(self, day: str) -> ReplayForecast:
        """Return the forecast of the lot for the replay of `day`, a day of the log."""
        index = self.log.days.index(day)
        if index not in self._forecasts:
            self._forecasts[index] = self._forecast_day(index, self.mapped_log(day))
        return self._forecasts[index]

    def _known(self, same_class: IntArray, held_out: set[int]) -> IntArray:
        log = self.log
        if self.forecast_from == "others":
            known, left = np.setdiff1d(same_class, list(held_out)), "one more"
        else:
            end = self._first if self.forecast_from == "past" else min(held_out)
            known, left = same_class[same_class < end], f"one before {log.days[end]}"
        if not known.size:
            raise InputError(
                f"{log.source}: a world of {self.n_slots} slots replays {len(held_out)} of {same_class.size} recorded"
                f" {day_class(log.days[same_class[0]])} days, want at least {left} to forecast from"
            )
        return known

    def _forecast_day(self, day: int, mapped: MappedLog) -> ReplayForecast:
        log, known = self.log, mapped.known
        rates = log.fitted("decay rates", known, lambda days: _decay_rates(log, days))
        days_away = np.abs(log.dates(known).number - log.dates([day]).number)
        nearest = np.sort(known[np.argsort(days_away, kind="stable")[:MAX_DAYS]])
        fitted = log.fitted("slot days", nearest, lambda days: fit_slot_days(log.slot_days(days)))
        replayed, which = np.unique(mapped.replayed, return_inverse=True)
        forecast = fitted.forecast(log.dates(replayed))
        share = np.bincount(which) / which.size
        level = np.sqrt(np.einsum("j,pjk,k->p", share, forecast.level_covariance, share))
        p = np.clip(forecast.p_taken[which, mapped.log_slot], MIN_PROBABILITY, MAX_PROBABILITY)
        recorded = mapped.log_slot >= 0
        if not recorded.all():
            p[~recorded] = p[recorded].mean(axis=0) if recorded.any() else forecast.p_taken[0].mean(axis=0)
            for group in np.unique(self.group[~recorded]) if self.group is not None else ():
                if (alike := recorded & (self.group == group)).any():
                    p[~recorded & (self.group == group)] = p[alike].mean(axis=0)
        return ReplayForecast(np.ascontiguousarray(logit(p)), np.minimum(level, MAX_LOGITS), rates)

    def _assign(self, day: str, known: IntArray) -> IntArray:
        n, m = self.n_slots, len(self.log.slot_ids)
        mean = self.log.mean_occupancy(day_class(day), days=np.isin(np.arange(len(self.log.days)), known))
        unknown = np.isnan(mean)
        mean[unknown] = 0.0 if unknown.all() else mean[~unknown].mean()
        log_slot, ranks = np.empty(n, np.int64), np.arange(n) * m // n
        log_slot[np.argsort(self.walk_m, kind="stable")] = np.argsort(-mean, kind="stable")[ranks]
        return log_slot

    def _replay_days(self, log_slot: IntArray, replay_order: IntArray) -> tuple[IntArray, IntArray]:
        recorded = self.log.recorded[:, replay_order]
        since = "" if self.replay_from is None else f" from {self.replay_from} on"
        days = np.empty(self.n_slots, np.int64)
        left = {int(s): iter(replay_order[recorded[s]]) for s in np.unique(log_slot[log_slot >= 0])}
        if self.mapping is not None:  # a slot whose own day is not recorded has no record
            log_slot = np.where((log_slot >= 0) & recorded[log_slot, 0], log_slot, -1)
        for slot in np.argsort(self.walk_m, kind="stable"):
            chosen = replay_order[0] if log_slot[slot] < 0 else next(left[int(log_slot[slot])], None)
            if chosen is None and self.mapping is not None:
                chosen, log_slot[slot] = replay_order[0], -1
            if chosen is None:
                name = self.log.slot_ids[log_slot[slot]]
                n_copies, n_days = (log_slot == log_slot[slot]).sum(), recorded[log_slot[slot]].sum()
                raise InputError(
                    f"{self.log.source}: slot {name} would serve {n_copies} slots of the lot but was recorded"
                    f" on {n_days} days of the class{since}; want a smaller lot or a longer log"
                )
            days[slot] = chosen
        return days, log_slot
