"""Occupancy over time: the base classes of worlds and forecasts, and a process that generates worlds.

Times are seconds since Monday 00:00 of the scenario's week; rates are 1/s.
"""

from __future__ import annotations

import ctypes
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, ClassVar, NamedTuple, Self
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.jit import kernel
from parkenv.compiled.keyed_random import world_key
from parkenv.compiled.memory import address_of
from parkenv.errors import InputError, naming, require, require_number
from parkenv.files.field_types import Probability, Validated, as_array
from parkenv.files.limited_reading import JsonFormat
from parkenv.world.occupancy import kernel as kernels
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.centred_logits import centring_table
from parkenv.world.occupancy.day_error import EXACT, DayError, nearness
from parkenv.world.occupancy.kernel import (
    EXTERNAL_KIND,
    FUNCTIONS,
    PROCESS_KIND,
    draw_arrival,
    hour_of_week,
)
from parkenv.world.occupancy.log import weekday_of
from parkenv.world.week import DAY_S, HOUR_S, WEEK_HOURS, WEEK_S

MAX_RATE = 1e3
_FORMAT = JsonFormat("parkenv-occupancy-process", 1, "an occupancy process")


@dataclass(frozen=True)
class Arrival:
    time: float  # s since Monday 00:00
    day: str = ""  # ISO date of the recorded day that the world replays; empty without a replay


@dataclass(frozen=True, eq=False)
class Forecast:
    p_occupied: FloatArray  # (n,) float64, P(taken) at the arrival
    # (n,) float64, 1/s, arrival rate plus departure rate: how fast an observation loses its value
    decay_rate: FloatArray
    day_error: DayError = EXACT  # by how much whole days differ from `p_occupied`


class SlotLaw(NamedTuple):
    """Independent two-state Markov chains from an arrival on, one per slot, with rates by the hour.

    Examples:
        Half of the cars leave within ln 2 mean stays; nobody comes.

        >>> law = SlotLaw(np.ones(1), np.zeros((2, 1)), np.full((2, 1), 1 / 600.0), 100.0)
        >>> round(float(law.p_taken_after(600 * np.log(2))[0]), 6)
        0.5
        >>> round(float(law.stays(50.0, 50.0 + 600 * np.log(2))[0]), 6)
        0.5
    """

    p_taken: FloatArray  # (n,) float64, P(taken) at the arrival
    # (2, n) float64, 1/s, rates at which free slots are taken in the hour of the arrival, and in the next
    arriving: FloatArray
    leaving: FloatArray  # (2, n) float64, 1/s, rates at which taken slots become free
    hour_ends_s: float  # s from the arrival to the end of its hour

    @property
    def known_for_s(self) -> float:
        return self.hour_ends_s + HOUR_S

    def take(self, slots: IntArray) -> SlotLaw:
        return SlotLaw(self.p_taken[slots], self.arriving[:, slots], self.leaving[:, slots], self.hour_ends_s)

    def p_taken_after(self, seconds: ArrayLike) -> FloatArray:
        """Return P(taken) of each slot at a time of its own, (..., n) s after the arrival."""
        p, end = self.p_taken, np.asarray(seconds, np.float64)
        for arriving, leaving, spent in zip(self.arriving, self.leaving, self._spent(0.0, end), strict=True):
            rate = arriving + leaving
            usual = np.divide(arriving, rate, out=np.zeros_like(rate), where=rate > 0.0)
            p = usual + (p - usual) * np.exp(-rate * spent)
        return np.asarray(p)

    def stays(self, begin: ArrayLike, end: ArrayLike) -> FloatArray:
        """Return P(one car stays until `end`), given that the slot is taken at `begin`; times as above."""
        spent = self._spent(np.asarray(begin, np.float64), np.asarray(end, np.float64))
        hazard = sum(leaving * seconds for leaving, seconds in zip(self.leaving, spent, strict=True))
        return np.asarray(np.exp(-hazard))

    def _spent(self, begin: ArrayLike, end: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the seconds of a span that are in the hour of the arrival, and after it."""
        first = np.clip(end, None, self.hour_ends_s) - np.clip(begin, None, self.hour_ends_s)
        return first, np.asarray(end) - np.asarray(begin) - first


class World(ABC):
    """The hidden occupancy of one episode; accepts any slots and times from the arrival on, in any order."""

    @abstractmethod
    def occupied(self, slots: ArrayLike, time: float) -> BoolArray:
        """(k,) bool, whether each of the slots (k,) is taken at `time`."""

    @abstractmethod
    def next_free(self, slots: ArrayLike, time: float) -> FloatArray:
        """(k,) float64, s: the earliest time >= `time` at which each slot is free; inf if never."""

    @abstractmethod
    def sojourn(self, slots: ArrayLike, time: float) -> IntArray:
        """(k,) int64, number of the current sojourn (period of constant state) of each slot; distinguishes cars."""

    def law(self) -> SlotLaw | None:
        return None

    def next_change(self, slots: ArrayLike, time: float, until: float) -> FloatArray:
        """(k,) float64, s: the first time in (`time`, `until`] of another sojourn of each slot; inf if there is none.

        By default the first float64 at which `sojourn` differs, found by bisection.
        """
        changes = np.full(np.size(slots), np.inf)
        for i, slot in enumerate(np.ravel(slots)):
            before, after, now = time, until, self.sojourn([slot], time)
            if self.sojourn([slot], until) != now:
                while before < (middle := before + (after - before) / 2) < after:
                    before, after = (
                        (middle, after) if self.sojourn([slot], middle) == now else (before, middle)
                    )
                changes[i] = after
        return changes

    @property
    def address(self) -> int:
        """Address of the record by which compiled code asks this world; valid while this object lives.

        By default that of a FUNCTIONS record, whose functions call this object's methods. A world with compiled
        functions of its own returns the address of a record that holds theirs.
        """
        if _worlds.get(id(self)) is not self:
            addresses = (ctypes.cast(function, ctypes.c_void_p).value for function in _FUNCTIONS)
            _worlds[id(self)] = self
            # Kept in the world itself; a copy of the world is not among `_worlds` yet and gets a record of its own.
            vars(self)["_functions"] = np.array([(id(self), *addresses)], FUNCTIONS)
        return address_of(vars(self)["_functions"], FUNCTIONS)


_worlds: WeakValueDictionary[int, World] = WeakValueDictionary()
_errors: list[BaseException] = []
_TYPE = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_int64, ctypes.c_int64, ctypes.c_double)


def _function(method: str) -> Any:
    """Return a function (number of the world, slot, time, s) that calls a method of the world for a slot."""

    def call(number: int, slot: int, time: float) -> float:
        try:
            return float(np.asarray(getattr(_worlds[number], method)(np.array([slot]), time)).item())
        except BaseException as error:
            _errors.append(error)
            return time

    return _TYPE(call)


# By which compiled code asks a world that is written in Python; in the order of the fields of FUNCTIONS.
_FUNCTIONS = tuple(_function(method) for method in ("occupied", "next_free"))


def raise_error() -> None:
    """Raise the first exception of a world in Python that compiled code has asked since the last call, if any."""
    if _errors:
        first = _errors[0]
        _errors.clear()
        raise first


def checked_slots(slots: ArrayLike, n: int) -> IntArray:
    slots = np.ascontiguousarray(slots, np.int64)
    if slots.size and not (slots.min() >= 0 and slots.max() < n):
        raise IndexError("slot index out of range")
    return slots


class ArrivalDay(NamedTuple):
    weekday: int  # Monday = 0
    date: str = ""  # ISO date of a recorded day; else empty


class Course(NamedTuple):
    """Expected occupancy of a lot at k times, shares of its slots, (k,) float64."""

    occupied: FloatArray  # taken
    residents: FloatArray  # taken by the same car since the course began


class CompiledModel(NamedTuple):
    """The records by which compiled code reads a model without calling Python."""

    record: NDArray[np.void]  # PROCESS; or RECORDED_DAY, one for each of the days of the arrivals
    # Arrays that the fields of a PROCESS record point to and that may be moved, by field
    tables: Mapping[str, NDArray[Any]]
    kept: tuple[Any, ...]  # further arrays that the record points to, or objects that hold them


class PriorModel(ABC):
    """Forecasts occupancy: the base class of all forecasts."""

    # which records compiled code reads, see `compiled` and `World.address`
    kind: ClassVar[int] = EXTERNAL_KIND
    adjustable: ClassVar[bool] = False  # whether `at_mean_occupancy` and `with_day_error` can be called

    @property
    @abstractmethod
    def n_slots(self) -> int:
        """Number of slots."""

    @abstractmethod
    def forecast(self, arrival: Arrival) -> Forecast:
        """Return the forecast for the arrival; it does not depend on the world."""

    def compiled(self, window: ArrivalWindow) -> CompiledModel | None:  # noqa: ARG002 - subclasses use it
        """Return the records of this model, if it has any, for arrivals in a window.

        Without records, the model is asked in Python, once when a search begins, and its worlds by their `address`.
        """
        return None

    def at_mean_occupancy(self, target: float, time: float) -> Self:
        """Return this model with a mean occupancy of `target` at a time, s."""
        raise NotImplementedError(f"{type(self).__name__} is not adjustable: {target}, {time}")

    def with_day_error(self, day_error: DayError, walk: ArrayLike | None = None) -> Self:  # noqa: ARG002
        """Return this model with days that differ from its forecast by `day_error`, where it can be set."""
        return self

    def for_world(self, world: OccupancyModel) -> PriorModel:  # noqa: ARG002 - subclasses use it
        return self


class OccupancyModel(PriorModel):
    """Base class of world models: gives the days of searches, makes worlds, and forecasts occupancy.

    A subclass needs `n_slots`, `forecast` and `world`; it then works in environments and their batches, in fleets and
    in studies.
    """

    recorded: ClassVar[bool] = False  # whether worlds replay dated days, see `days_in`
    averaged: ClassVar[int] = 100  # number of worlds whose mean is the expectation of a day

    @abstractmethod
    def world(self, key: np.uint64, arrival: Arrival) -> World:
        """Return the world of the episode with this key."""

    def days_in(self, window: ArrivalWindow) -> list[str]:  # noqa: ARG002 - subclasses use it
        """Return the ISO dates of the recorded days in a window; none if days are not recorded."""
        return []

    def arrival_days(self, window: ArrivalWindow) -> list[ArrivalDay]:
        if self.recorded:
            return [ArrivalDay(weekday_of(day), day) for day in self.days_in(window)]
        return [ArrivalDay(weekday) for weekday in window.weekdays]

    def course(self, arrival: Arrival, times: ArrayLike) -> Course:
        """Return the expected course of the occupancy on a day: by default the mean over `averaged` worlds.

        Args:
            arrival: moment from which on residents are followed, and its day.
            times: (k,) s since Monday 00:00, ascending, not before the arrival.
        """
        slots, times = np.arange(self.n_slots), np.asarray(times, np.float64)
        occupied, residents = np.zeros((2, times.size))
        for number in range(self.averaged):
            world = self.world(world_key(0, number), arrival)
            residents += (world.next_free(slots, arrival.time)[:, None] > times).mean(axis=0)
            occupied += [world.occupied(slots, float(time)).mean() for time in times]
        return Course(occupied / self.averaged, residents / self.averaged)

    def draw_arrival(self, window: ArrivalWindow, key: np.uint64) -> Arrival:
        days = self.arrival_days(window)
        day, second = draw_arrival(np.uint64(key), len(days), float(window.start_s), float(window.end_s))
        return Arrival(days[day].weekday * DAY_S + second, days[day].date)

    def with_fixed_slots(self, window: ArrivalWindow) -> Self:  # noqa: ARG002 - subclasses use it
        """Return this model with every slot of its data at the same slot of the lot on all days of a window."""
        return self


@dataclass(frozen=True, eq=False)
class ConstantForecast(Validated, PriorModel):
    """A `prior` of a `Scenario` with the same occupancy probability for every slot.

    Examples:
        >>> from parkenv import make_scenario
        >>> mini = make_scenario("mini")
        >>> ConstantForecast(1.0, mini.occupancy).forecast(Arrival(0.0)).p_occupied[:2].tolist()
        [0.999, 0.999]
    """

    p_occupied: Probability  # the probability, 0 to 1; clipped to the range of forecasts
    true: PriorModel  # provides the decay rates and the day error, which remain correct

    @property
    def kind(self) -> int:  # type: ignore[override]
        return PROCESS_KIND if self.true.kind == PROCESS_KIND else EXTERNAL_KIND

    def compiled(self, window: ArrivalWindow) -> CompiledModel | None:
        model = self.true.compiled(window) if self.kind == PROCESS_KIND else None
        if model is None:
            return None
        record = model.record.copy()
        record["flat"] = min(max(self.p_occupied, kernels.MIN_PROBABILITY), kernels.MAX_PROBABILITY)
        return model._replace(record=record)

    @property
    def n_slots(self) -> int:
        return self.true.n_slots

    def with_day_error(self, day_error: DayError, walk: ArrayLike | None = None) -> ConstantForecast:
        return replace(self, true=self.true.with_day_error(day_error, walk))

    def for_world(self, world: OccupancyModel) -> ConstantForecast:
        return replace(self, true=world)

    def forecast(self, arrival: Arrival) -> Forecast:
        p = min(max(self.p_occupied, kernels.MIN_PROBABILITY), kernels.MAX_PROBABILITY)
        return replace(self.true.forecast(arrival), p_occupied=np.full(self.n_slots, p))


@kernel
def _seek(
    process: int,
    world: int,
    slots: IntArray,
    time: float,
    cursors: int,
    occupied: BoolArray,
    ends: FloatArray,
) -> None:
    of_all, here = kernels.process_at(process, 0), kernels.world_at(world, 0)
    for i in range(slots.size):
        slot, cursor = slots[i], kernels.cursor_at(cursors, slots[i])
        if time < cursor.since:
            cursor.sojourn, cursor.valid_until = 0, 0.0
        occupied[i] = kernels.process_state(of_all, here, slot, cursor, time)
        if ends.size > 0:
            kernels.find_sojourn_end(of_all, here, slot, cursor)
            ends[i] = cursor.valid_until


@kernel
def _draw_day(process: int, world: int) -> None:
    kernels.draw_day(kernels.process_at(process, 0), kernels.world_at(world, 0))


@kernel
def _marginals(process: int, hour: int, second: float, marginals: FloatArray) -> None:
    for slot in range(marginals.size):
        marginals[slot] = kernels.process_forecast(kernels.process_at(process, 0), hour, second, slot)[0]


@kernel
def _laws(process: int, world: int, p_taken: FloatArray, rates: FloatArray) -> None:
    for slot in range(p_taken.size):
        p_taken[slot], rates[0, slot], rates[1, slot], rates[2, slot], rates[3, slot] = kernels.process_law(
            kernels.process_at(process, 0), kernels.world_at(world, 0), slot
        )


class ProcessWorld(World):
    """One episode of an `OccupancyProcess`: a pure function of (process, key, arrival).

    Evaluation is lazy: only queried slots cost time. A slot keeps a cursor on its latest sojourn; a query before the
    cursor restarts that slot, so answers never depend on the order of the queries.
    """

    def __init__(self, process: OccupancyProcess, key: np.uint64, arrival: Arrival) -> None:
        require(math.isfinite(arrival.time), f"Arrival.time is {arrival.time}, want finite seconds")
        # np.zeros does not touch its memory, so a million slots cost nothing until they are queried.
        self._cursors = np.zeros(process.n_slots, kernels.CURSOR)
        self.process = process
        self.key = np.uint64(key)
        self.arrival = arrival
        _, hour, second = hour_of_week(float(arrival.time))
        self._record = np.array([(self.key, arrival.time, hour, second, 1.0, 0.0)], kernels.WORLD)
        _draw_day(process.address, address_of(self._record, kernels.WORLD))

    @property
    def address(self) -> int:
        return self.process.address

    def occupied(self, slots: ArrayLike, time: float) -> BoolArray:
        return self._seek(slots, time)[0]

    def next_free(self, slots: ArrayLike, time: float) -> FloatArray:
        occupied, ends = self._seek(slots, time, with_ends=True)
        return np.where(occupied, ends, time)

    def sojourn(self, slots: ArrayLike, time: float) -> IntArray:
        self._seek(slots, time)
        return self._cursors["sojourn"][np.asarray(slots, np.int64)].astype(np.int64)

    def next_change(self, slots: ArrayLike, time: float, until: float) -> FloatArray:
        _, ends = self._seek(slots, time, with_ends=True)
        return np.where(ends <= until, ends, np.inf)

    def law(self) -> SlotLaw:
        p_taken, rates = np.empty(len(self._cursors)), np.empty((4, len(self._cursors)))
        _laws(self.process.address, address_of(self._record, kernels.WORLD), p_taken, rates)
        return SlotLaw(p_taken, rates[:2], rates[2:], HOUR_S - float(self._record["second_of_hour"][0]))

    def _seek(self, slots: ArrayLike, time: float, with_ends: bool = False) -> tuple[BoolArray, FloatArray]:
        arrival, chosen = float(self.arrival.time), checked_slots(slots, self.process.n_slots)
        if not arrival <= time < math.inf:
            raise InputError(f"time is {time}, want finite seconds at or after the arrival at {arrival}")
        occupied, ends = np.empty(chosen.size, np.bool_), np.empty(chosen.size if with_ends else 0)
        cursors = address_of(self._cursors, kernels.CURSOR)
        world = address_of(self._record, kernels.WORLD)
        _seek(self.process.address, world, chosen, float(time), cursors, occupied, ends)
        return occupied, ends


@dataclass(frozen=True, eq=False)
class OccupancyProcess(OccupancyModel):
    """Independent two-state continuous-time Markov chains, one per slot, with weekly periodic rates.

    A free slot s is taken at the rate `arrival_factor[s] * arrival_profile[h]`, a taken one becomes free at the
    rate `departure_factor[s] * departure_profile[h]`; h is the hour of the week, 0 = Monday 00:00 to 01:00.

    With a day error, every episode draws the level L and the slope S of its day. The odds that a slot is taken at the
    arrival are those of its forecast times c·exp(L + S·nearness), and its arrival rate is multiplied by the same factor
    throughout the episode, so that its equilibrium moves along. The centring c makes the forecast the mean over days
    (see `parkenv.world.occupancy.day_error`); in the arrival rate of an hour, it is that of the forecast when the hour
    begins, or at the arrival if that is later.

    Args:
        arrival_factor: (n,) float64, no unit, >= 0.
        arrival_profile: (168,) float64, 1/s, >= 0.
        departure_factor: (n,) float64, no unit, >= 0.
        departure_profile: (168,) float64, 1/s, >= 0.
        day_error: how far days differ from the forecast.
        nearness: (n,) float64, from -1 to 1, see `parkenv.world.occupancy.day_error.nearness`; needed for a slope only.

    Attributes:
        factors: (2, n) float64, read-only, the two factors stacked; row = the state before the change.
        profiles: (2, 168) float64, 1/s, read-only, the two profiles stacked in the same way.
        hazards: (2, 169) float64, read-only, integrals of the profiles from Monday 00:00 to full hours.
        hourly_marginals: (168, n) float64, P(taken) at full hours, computed when first needed; 0 before.
        record: (1,) of the dtype PROCESS, for compiled code.

    Raises:
        InputError: a wrong shape, a value that is negative or not finite, a rate above 1000/s, or a slope without
            nearness.
    """

    kind: ClassVar[int] = PROCESS_KIND
    adjustable: ClassVar[bool] = True
    arrival_factor: FloatArray
    arrival_profile: FloatArray
    departure_factor: FloatArray
    departure_profile: FloatArray
    day_error: DayError = EXACT
    nearness: FloatArray | None = None
    factors: FloatArray = field(init=False, repr=False)
    profiles: FloatArray = field(init=False, repr=False)
    hazards: FloatArray = field(init=False, repr=False)
    hourly_marginals: FloatArray = field(init=False, repr=False)
    record: NDArray[np.void] = field(init=False, repr=False)
    _centring: FloatArray = field(init=False, repr=False)  # `record` holds its address

    def __post_init__(self) -> None:
        arrival = as_array("arrival_factor", self.arrival_factor, -1, least=0.0)
        departure = as_array("departure_factor", self.departure_factor, arrival.size, least=0.0)
        names = ("arrival_profile", "departure_profile")
        profiles = np.stack([as_array(name, getattr(self, name), WEEK_HOURS, least=0.0) for name in names])
        factors = np.stack([arrival, departure])
        with np.errstate(over="ignore"):
            fastest = float((factors.max(axis=1) * profiles.max(axis=1)).max())
        require(
            fastest <= MAX_RATE,
            f"OccupancyProcess has a rate of {fastest:g}/s, want factor * profile <= {MAX_RATE:g}",
        )
        hazards = np.pad(np.cumsum(profiles * HOUR_S, axis=1), ((0, 0), (1, 0)))
        for array in (factors, profiles, hazards):
            array.flags.writeable = False
        # Untouched memory costs nothing, so even a million slots can have a whole week.
        marginals = np.zeros((WEEK_HOURS, arrival.size))
        near, centring = self.nearness, centring_table(self.day_error)
        if near is not None:
            near = as_array("nearness", near, arrival.size, least=-1.0, most=1.0)
        require(
            near is not None or self.day_error.slope == 0.0,
            "nearness is None, want numbers: days have a slope",
        )
        addresses = [address_of(a, np.float64) for a in (factors, profiles, hazards, marginals, centring)]
        near_at = 0 if near is None else address_of(near, np.float64)
        sizes = self.day_error.level, self.day_error.slope
        record = np.array([(arrival.size, *addresses, near_at, sizes, np.nan)], kernels.PROCESS)
        rates = zip(_RATES, (factors[0], profiles[0], factors[1], profiles[1]), strict=True)
        values: dict[str, Any] = {
            "factors": factors,
            "profiles": profiles,
            "hazards": hazards,
            "nearness": near,
        }
        values |= {"hourly_marginals": marginals, "_centring": centring, "record": record, **dict(rates)}
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def __reduce__(self) -> tuple[Any, ...]:
        return OccupancyProcess, tuple(getattr(self, name) for name in _FIELDS)

    def __deepcopy__(self, memo: dict[int, Any]) -> OccupancyProcess:
        return self  # immutable: copies share it

    @classmethod
    def from_demand(cls, attraction: ArrayLike, demand: ArrayLike, mean_stay_s: float = 2 * HOUR_S) -> Self:
        """Return a process whose equilibrium occupancy has the logit `attraction[s] + demand[h]`.

        Args:
            attraction: (n,) float64, logit, popularity of each slot.
            demand: (168,) float64, logit, by hour of the week.
            mean_stay_s: s, mean parking duration, the same for all slots and hours.
        """
        require_number("mean_stay_s", mean_stay_s, above=0.0)
        attraction, demand = np.asarray(attraction, float), np.asarray(demand, float)
        for name, logits in (("attraction", attraction), ("demand", demand)):
            # Beyond this, the exponential exceeds the floating-point range.
            require(np.all(np.abs(logits) <= 300), f"{name}: want finite logits between -300 and 300")
        return cls(
            np.exp(attraction),
            np.exp(demand) / mean_stay_s,
            np.ones(attraction.shape),
            np.full(WEEK_HOURS, 1 / mean_stay_s),
        )

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file written by `to_file`; InputError names the file and the problem."""
        # A file of rates alone has no day error.
        content = {"day_error": {}, "nearness": None, **_FORMAT.read(path)}
        wanted = set(_FIELDS)
        if content.keys() != wanted:
            odd = ", ".join(sorted(content.keys() ^ wanted))
            raise InputError(f"{path}: missing or unknown fields: {odd}; want {', '.join(sorted(wanted))}")
        sizes = content.pop("day_error")
        with naming(path):
            if not isinstance(sizes, dict) or not sizes.keys() <= {"level", "slope"}:
                raise InputError(f"day_error is {sizes!r:.60}, want an object with level and slope")
            return cls(**content, day_error=DayError(**sizes))

    def to_file(self, path: str | os.PathLike[str]) -> None:
        """Write as JSON, replacing an existing file atomically."""
        content: dict[str, Any] = {name: getattr(self, name).tolist() for name in _RATES}
        content["day_error"] = asdict(self.day_error)
        content["nearness"] = None if self.nearness is None else self.nearness.tolist()
        _FORMAT.write(path, content)

    @property
    def n_slots(self) -> int:
        return int(self.factors.shape[1])

    @property
    def address(self) -> int:
        """Address of the PROCESS record, for compiled code; valid while this process lives."""
        return address_of(self.record, kernels.PROCESS)

    def compiled(self, window: ArrivalWindow) -> CompiledModel:  # noqa: ARG002 - the same on all days
        tables = {name: getattr(self, name) for name in _TABLES}
        arrays = tuple(array for array in (self._centring, self.nearness) if array is not None)
        return CompiledModel(self.record, tables, arrays)

    def take(self, slots: ArrayLike) -> OccupancyProcess:
        """Return a process whose slot i has the rates of this process's slot `slots[i]`; (n,) int64."""
        chosen = np.asarray(slots, np.int64)
        arrival, departure = self.factors[:, chosen]
        near = None if self.nearness is None else self.nearness[chosen]
        return replace(self, arrival_factor=arrival, departure_factor=departure, nearness=near)

    def with_day_error(self, day_error: DayError, walk: ArrayLike | None = None) -> OccupancyProcess:
        """Return this process with days that differ from its forecast; `walk`, (n,) m, ranks its slots anew."""
        near = self.nearness if walk is None else nearness(walk)
        return replace(self, day_error=day_error, nearness=near)

    def mapped_to_lot(self, walk_m: ArrayLike) -> OccupancyProcess:
        """Map the process by rank to a lot of any size: the fullest slots go nearest to the goal.

        Args:
            walk_m: (n,) float64, m, walking distance from each slot of that lot to its goal. The slot of rank r gets
                the rates of this process's slot of rank r * n_slots // n by mean occupancy over the week.
        """
        walk = np.asarray(walk_m, float)
        mean = np.mean([self.marginal(hour * HOUR_S) for hour in range(WEEK_HOURS)], axis=0)
        slots = np.empty(walk.size, np.int64)
        ranks = np.arange(walk.size) * self.n_slots // walk.size
        slots[np.argsort(walk, kind="stable")] = np.argsort(-mean, kind="stable")[ranks]
        taken = self.take(slots)
        return taken if self.nearness is None else taken.with_day_error(self.day_error, walk)

    def at_mean_occupancy(self, target: float, time: float) -> OccupancyProcess:
        """Scale all arrival rates by one factor such that the lot's mean marginal at `time` is `target`.

        Scaling the arrival rates shifts every slot's attraction by the same logit.
        """
        require_number("target mean occupancy", target, above=0.0, below=1.0)

        def scaled(shift: float) -> OccupancyProcess:
            return replace(self, arrival_factor=self.arrival_factor * math.exp(shift))

        def excess(shift: float) -> float:
            return float(scaled(shift).marginal(time).mean()) - target

        fastest = float(self.arrival_factor.max() * self.arrival_profile.max())
        low, high = -100.0, math.log(0.99 * MAX_RATE / fastest) if fastest > 0 else 0.0
        require(
            excess(low) < 0 < excess(high),
            f"target mean occupancy: {target} cannot be reached by scaling the arrival rates",
        )
        return scaled(brentq(excess, low, high, xtol=1e-10))

    def marginal(self, time: float) -> FloatArray:
        """Return P(taken) at `time` before any observation, (n,) float64."""
        _, hour, second = hour_of_week(float(time))
        marginals = np.empty(self.n_slots)
        _marginals(self.address, hour, second, marginals)
        return marginals

    def course(self, arrival: Arrival, times: ArrayLike) -> Course:
        times = np.asarray(times, np.float64)
        week, second = np.divmod(np.append(times, arrival.time), WEEK_S)
        # The departure rate of a slot with factor 1, integrated over time.
        sums = self.hazards[1]
        gone = week * sums[-1] + np.interp(second, np.arange(WEEK_HOURS + 1) * HOUR_S, sums)
        leaving = (gone[:-1] - gone[-1])[:, None] * self.departure_factor
        return Course(
            np.array([self.marginal(time).mean() for time in times]),
            np.asarray((self.marginal(arrival.time) * np.exp(-leaving)).mean(axis=1)),
        )

    def world(self, key: np.uint64, arrival: Arrival) -> ProcessWorld:
        """Return the world of the episode with this key; its initial state is drawn from the marginal on its day."""
        return ProcessWorld(self, key, arrival)

    def forecast(self, arrival: Arrival) -> Forecast:
        """Return the marginal at the arrival, clipped to [0.001, 0.999], and the rates of that hour."""
        _, hour, _ = hour_of_week(float(arrival.time))
        rates = self.factors * self.profiles[:, hour, None]
        return Forecast(
            np.clip(self.marginal(arrival.time), kernels.MIN_PROBABILITY, kernels.MAX_PROBABILITY),
            rates[0] + rates[1],
            self.day_error,
        )


_FIELDS = tuple(f.name for f in fields(OccupancyProcess) if f.init)
_RATES = _FIELDS[:4]
_TABLES = ("factors", "profiles", "hazards", "hourly_marginals")
