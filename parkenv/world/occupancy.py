"""Which slots are taken when: the contracts of a world, and a process that generates worlds.

Times are seconds since Monday 00:00 of the scenario's week; rates are 1/s.
"""

import math
import os
import re
from dataclasses import dataclass, field, fields
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from parkenv.errors import InputError
from parkenv.files.versioned_json import JsonFormat
from parkenv.world.decay import decay_factor
from parkenv.world.keyed_random import ARRIVAL_STREAM, OCCUPANCY_STREAM, keyed_exponential, keyed_uniform
from sim_sensors.compilation import compiled

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

HOUR_S = 3600.0
DAY_S = 86_400.0
WEEK_S = 604_800.0
WEEK_HOURS = 168
DAY_NAMES = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
DAY_GROUPS = {"weekdays": (0, 1, 2, 3, 4), "weekend": (5, 6), "all": (0, 1, 2, 3, 4, 5, 6)}

# No forecast is certain: a planner must be able to recover from a wrong one.
MIN_PROBABILITY = 0.001
MAX_PROBABILITY = 0.999

MAX_RATE = 1e3
_NEVER_WEEKS = 1e9
_FORGOTTEN = 1e-17
_FORMAT = JsonFormat("parkenv-occupancy-process", 1, "an occupancy process")


@dataclass(frozen=True)
class ArrivalWindow:
    """When searches begin: on which weekdays, and between which times of day.

    Args:
        weekdays: Monday = 0 ... Sunday = 6, none twice.
        start_s: first second of the day, in [0, 86400).
        end_s: end of the window (not in it), in [start_s, 86400]; equal to start_s means that very moment.
    """

    weekdays: tuple[int, ...] = (0, 1, 2, 3, 4)
    start_s: float = 8 * HOUR_S
    end_s: float = 13 * HOUR_S

    def __post_init__(self) -> None:
        days = tuple(self.weekdays)
        if not days or len(set(days)) != len(days) or not set(days) <= set(range(7)):
            raise InputError(
                f"ArrivalWindow.weekdays: got {days}, wanted different numbers from 0 (Mon) to 6 (Sun)"
            )
        if not 0 <= self.start_s < DAY_S:
            raise InputError(f"ArrivalWindow.start_s: got {self.start_s}, wanted seconds in [0, 86400)")
        if not self.start_s <= self.end_s <= DAY_S:
            raise InputError(
                f"ArrivalWindow.end_s: got {self.end_s}, wanted seconds in [start_s={self.start_s}, 86400]"
            )
        object.__setattr__(self, "weekdays", days)

    @classmethod
    def parse(cls, hours: str, days: str = "weekdays") -> Self:
        """Read a window as a user types it.

        >>> ArrivalWindow.parse("08:00-09:30", days="mon,sat")
        ArrivalWindow(weekdays=(0, 5), start_s=28800.0, end_s=34200.0)

        Args:
            hours: `HH:MM-HH:MM`, with 24:00 allowed as the end.
            days: `weekdays`, `weekend`, `all`, or names as in `mon,tue`.
        """
        match = re.fullmatch(r"\s*(\d{1,2}):([0-5]\d)\s*-\s*(\d{1,2}):([0-5]\d)\s*", hours)
        if match is None:
            raise InputError(f"arrival hours: got {hours!r}, wanted HH:MM-HH:MM, for example 08:00-13:00")
        start_h, start_min, end_h, end_min = map(int, match.groups())
        names = [name.strip() for name in days.lower().split(",")]
        if days.lower() in DAY_GROUPS:
            weekdays: tuple[int, ...] = DAY_GROUPS[days.lower()]
        elif set(names) <= set(DAY_NAMES):
            weekdays = tuple(DAY_NAMES.index(name) for name in names)
        else:
            wanted = f"{', '.join(DAY_GROUPS)}, or some of {','.join(DAY_NAMES)}"
            raise InputError(f"arrival days: got {days!r}, wanted {wanted}")
        return cls(weekdays, start_h * HOUR_S + start_min * 60.0, end_h * HOUR_S + end_min * 60.0)

    def draw_second(self, key: np.uint64) -> float:
        """Second of the day, uniform in the window; the world's key decides."""
        return self.start_s + float(keyed_uniform(key, ARRIVAL_STREAM, 0, 1)) * (self.end_s - self.start_s)


@dataclass(frozen=True)
class Arrival:
    """The moment at which a search begins.

    Args:
        time: s since Monday 00:00.
        day: ISO date of the recorded day that the world replays; empty where nothing is replayed.
    """

    time: float
    day: str = ""


@dataclass(frozen=True, eq=False)
class Forecast:
    """What is known of a lot before anything has been seen.

    Args:
        p_occupied: (n,) float64, probability at the arrival.
        decay_rate: (n,) float64, 1/s, arrival rate plus departure rate: how fast a sighting goes stale.
    """

    p_occupied: FloatArray
    decay_rate: FloatArray


class World(Protocol):
    """The hidden truth of one episode; any slots, any times from the arrival on, in any order."""

    def occupied(self, slots: ArrayLike, time: float) -> BoolArray:
        """(k,) bool: is each of the slots (k,) taken at `time`?"""

    def next_free(self, slots: ArrayLike, time: float) -> FloatArray:
        """(k,) float64, s: the earliest time >= `time` at which each slot is free; inf if never."""

    def stretch(self, slots: ArrayLike, time: float) -> IntArray:
        """(k,) int64: the number of the stretch of constant state that each slot is in; it tells cars apart."""


class PriorModel(Protocol):
    """Says what can be known beforehand."""

    @property
    def n_slots(self) -> int:
        """Number of slots."""

    def forecast(self, arrival: Arrival) -> Forecast:
        """What is known at the arrival; it never peeks at the world."""


class OccupancyModel(PriorModel, Protocol):
    """Draws arrivals and worlds, and says what can be known beforehand."""

    def draw_arrival(self, window: ArrivalWindow, key: np.uint64) -> Arrival:
        """The arrival of the episode with this key."""

    def world(self, key: np.uint64, arrival: Arrival) -> World:
        """The world of the episode with this key."""


@compiled
def hour_of_week(time: float) -> tuple[float, int, float]:
    """Week, hour of the week and second of the hour."""
    week = np.floor(time / WEEK_S)
    second = time - week * WEEK_S
    hour = min(int(second // HOUR_S), WEEK_HOURS - 1)
    return week, hour, second - hour * HOUR_S


@compiled
def _time_after(profile: FloatArray, table: FloatArray, since: float, hazard: float) -> float:
    """When the hazard that a unit slot has gathered since `since` reaches `hazard`; table[-1] must be > 0."""
    week, hour, second = hour_of_week(since)
    target = table[hour] + profile[hour] * second + hazard
    more_weeks = np.floor(target / table[WEEK_HOURS])
    if not more_weeks < _NEVER_WEEKS:
        return np.inf
    rest = target - more_weeks * table[WEEK_HOURS]
    # table[hour] < rest <= table[hour + 1], hence a positive rate, but for rounding at the ends.
    hour = min(max(np.searchsorted(table, rest) - 1, 0), WEEK_HOURS - 1)
    second = min((rest - table[hour]) / profile[hour], HOUR_S) if profile[hour] > 0.0 else 0.0
    end: float = max((week + more_weeks) * WEEK_S + hour * HOUR_S + second, since)
    return end


@compiled
def _marginal_at_hour(
    arrival_factor: float,
    departure_factor: float,
    arrival_profile: FloatArray,
    departure_profile: FloatArray,
    now: int,
) -> float:
    """P(occupied) when hour `now` of the week begins, in the periodic regime of p' = λ(t)(1−p) − μ(t)p.

    The affine map over the week that ends at `time` is gathered backwards, latest piece first, so it can
    stop as soon as the past is forgotten. A slot that never changes has no regime; it gets 0.5.
    """
    p, gain, gathered = 0.0, 1.0, 0.0
    for back in range(1, WEEK_HOURS + 1):
        hour = (now - back) % WEEK_HOURS
        arrival = arrival_factor * arrival_profile[hour]
        rate = arrival + departure_factor * departure_profile[hour]
        if rate > 0.0:
            moved = -math.expm1(-rate * HOUR_S)
            p += gain * (arrival / rate) * moved
            gain *= 1.0 - moved
            gathered += rate * HOUR_S
            if gain < _FORGOTTEN:
                return float(p)
    return float(p / -math.expm1(-gathered)) if gathered > 0.0 else 0.5


@compiled
def marginal_from(
    arrival_factor: float,
    departure_factor: float,
    arrival_profile: FloatArray,
    departure_profile: FloatArray,
    hour: int,
    second: float,
    kept: FloatArray,
    row: int,
) -> float:
    """P(occupied) of one slot at a second of an hour of the week (compiled; for batches too).

    Args:
        arrival_factor: of the slot.
        departure_factor: of the slot.
        arrival_profile: (168,) 1/s.
        departure_profile: (168,) 1/s.
        hour: of the week.
        second: of the hour.
        kept: what was worked out before; 0 where nothing was.
        row: where in `kept` the slot's probability at the beginning of the hour is, or goes.
    """
    start = kept[row]
    if start == 0.0:
        start = _marginal_at_hour(arrival_factor, departure_factor, arrival_profile, departure_profile, hour)
        kept[row] = start
    arrival = arrival_factor * arrival_profile[hour]
    rate = arrival + departure_factor * departure_profile[hour]
    p: float = marginal_later(start, arrival, rate, second)
    return p


@compiled(inline="always")
def marginal_later(start: float, arrival: float, rate: float, second: float) -> float:
    """P(occupied) some seconds after it was `start`, by constant rates of arrival, and of arrival plus departure."""
    equilibrium = arrival / rate if rate > 0.0 else 0.0
    return float(equilibrium + (start - equilibrium) * decay_factor(rate * second))


@compiled
def _marginals(
    factors: FloatArray, profiles: FloatArray, hour: int, second: float, kept: FloatArray
) -> FloatArray:
    n = factors.shape[1]
    p = np.empty(n)
    for s in range(n):
        p[s] = marginal_from(
            factors[0, s], factors[1, s], profiles[0], profiles[1], hour, second, kept, hour * n + s
        )
    return p


@compiled
def holding_end(
    key: np.uint64, slot: int, flip: int, since: float, factor: float, profile: FloatArray, table: FloatArray
) -> float:
    """When the stretch of constant state ends that began at `since`, s (compiled; for batches too).

    Args:
        key: the world's key.
        slot: index of the slot.
        flip: number of the stretch, 1 for the first.
        since: s.
        factor: of the rate at which the state is left.
        profile: (168,) 1/s, of that rate.
        table: (169,) its hazard, gathered since Monday 00:00, at full hours.
    """
    if factor * table[WEEK_HOURS] <= 0.0:
        return np.inf
    hazard = keyed_exponential(key, OCCUPANCY_STREAM, slot, flip) / factor
    end: float = _time_after(profile, table, since, hazard)
    return end


@compiled
def _seek(
    slot: int,
    time: float,
    key: np.uint64,
    arrival: float,
    factors: FloatArray,
    profiles: FloatArray,
    tables: FloatArray,
    kept: FloatArray,
    span: FloatArray,
    flips: IntArray,
    states: NDArray[np.uint8],
) -> None:
    """Move one slot's cursor to the stretch of constant state that holds `time`, s, at or after `arrival`.

    Rows of factors, profiles and tables are the rates of leaving state 0 and state 1. Changed in place:
    span, (n, 2) s, begin and end of the stretch; flips, (n,) stretches begun so far, 0 = cursor not set;
    states, (n,) 1 = occupied.
    """
    if flips[slot] == 0 or time < span[slot, 0]:
        _, hour, second = hour_of_week(arrival)
        row = hour * flips.size + slot
        p = marginal_from(
            factors[0, slot], factors[1, slot], profiles[0], profiles[1], hour, second, kept, row
        )
        state = 1 if keyed_uniform(key, OCCUPANCY_STREAM, slot, 0) < p else 0
        states[slot] = state
        flips[slot] = 1
        span[slot, 0] = arrival
        span[slot, 1] = holding_end(
            key, slot, 1, arrival, factors[state, slot], profiles[state], tables[state]
        )
    while time >= span[slot, 1]:
        state = 1 - states[slot]
        states[slot] = state
        flips[slot] += 1
        span[slot, 0] = span[slot, 1]
        span[slot, 1] = holding_end(
            key, slot, flips[slot], span[slot, 0], factors[state, slot], profiles[state], tables[state]
        )


@compiled
def _look(
    slots: IntArray,
    time: float,
    key: np.uint64,
    arrival: float,
    factors: FloatArray,
    profiles: FloatArray,
    tables: FloatArray,
    kept: FloatArray,
    span: FloatArray,
    flips: IntArray,
    states: NDArray[np.uint8],
) -> BoolArray:
    occupied = np.empty(slots.size, np.bool_)
    for i, slot in enumerate(slots):
        if not 0 <= slot < flips.size:
            raise IndexError("slot index out of range")
        _seek(slot, time, key, arrival, factors, profiles, tables, kept, span, flips, states)
        occupied[i] = states[slot] == 1
    return occupied


class ProcessWorld:
    """One episode of an `OccupancyProcess`: a pure function of (process, key, arrival).

    Lazy: only slots that are looked at cost anything. A slot keeps a cursor on its latest stretch; a query
    before the cursor starts that slot again, so answers never depend on the order of the queries.
    """

    def __init__(self, process: "OccupancyProcess", key: np.uint64, arrival: Arrival) -> None:
        if not math.isfinite(arrival.time):
            raise InputError(f"Arrival.time: got {arrival.time}, wanted finite seconds")
        n = process.n_slots
        # np.zeros takes memory from the system untouched, so a million slots that nobody sees cost nothing.
        self._span = np.zeros((n, 2))
        self._flips = np.zeros(n, np.int64)
        self._states = np.zeros(n, np.uint8)
        self.process = process
        self.key = np.uint64(key)
        self.arrival = arrival

    def occupied(self, slots: ArrayLike, time: float) -> BoolArray:
        """(k,) bool: is each of the slots (k,) taken at `time`, which is at or after the arrival?"""
        return self._look(np.asarray(slots, np.int64), time)

    def next_free(self, slots: ArrayLike, time: float) -> FloatArray:
        """(k,) float64, s: the earliest time >= `time` at which each slot is free; inf if never."""
        slots = np.asarray(slots, np.int64)
        return np.where(self._look(slots, time), self._span[slots, 1], time)

    def stretch(self, slots: ArrayLike, time: float) -> IntArray:
        """(k,) int64: how many stretches of constant state each slot has begun since the arrival."""
        slots = np.asarray(slots, np.int64)
        self._look(slots, time)
        begun: IntArray = self._flips[slots]
        return begun

    def _look(self, slots: IntArray, time: float) -> BoolArray:
        arrival = self.arrival.time
        if not arrival <= time < math.inf:
            raise InputError(f"time: got {time}, wanted finite seconds at or after the arrival at {arrival}")
        process = self.process
        occupied: BoolArray = _look(
            slots,
            float(time),
            self.key,
            float(arrival),
            process.factors,
            process.profiles,
            process.tables,
            process.kept,
            self._span,
            self._flips,
            self._states,
        )
        return occupied


@dataclass(frozen=True, eq=False)
class OccupancyProcess:
    """Every slot an independent two-state Markov chain in continuous time, with rates that repeat weekly.

    A free slot s is taken at the rate `arrival_factor[s] * arrival_profile[h]`, a taken one is left at the
    rate `departure_factor[s] * departure_profile[h]`; h is the hour of the week, 0 = Monday 00:00 to 01:00.

    Args:
        arrival_factor: (n,) float64, no unit, >= 0.
        arrival_profile: (168,) float64, 1/s, >= 0.
        departure_factor: (n,) float64, no unit, >= 0.
        departure_profile: (168,) float64, 1/s, >= 0.

    Attributes:
        factors: (2, n) float64, read-only, the two factors stacked; row = the state that is left.
        profiles: (2, 168) float64, 1/s, read-only, likewise.
        tables: (2, 169) float64, read-only, the profiles' hazard gathered since Monday 00:00, at full hours.
        kept: (168 * n,) float64, marginals at full hours, hour by hour, that have been asked for; 0 elsewhere.

    Raises:
        InputError: a wrong shape, a value that is negative or not finite, or a rate above 1000/s.
    """

    arrival_factor: FloatArray
    arrival_profile: FloatArray
    departure_factor: FloatArray
    departure_profile: FloatArray
    factors: FloatArray = field(init=False, repr=False)
    profiles: FloatArray = field(init=False, repr=False)
    tables: FloatArray = field(init=False, repr=False)
    kept: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        arrival = _checked("arrival_factor", self.arrival_factor)
        factors = np.stack([arrival, _checked("departure_factor", self.departure_factor, arrival.size)])
        names = ("arrival_profile", "departure_profile")
        profiles = np.stack([_checked(name, getattr(self, name), WEEK_HOURS) for name in names])
        fastest = float((factors.max(axis=1) * profiles.max(axis=1)).max())
        if not fastest <= MAX_RATE:
            raise InputError(
                f"OccupancyProcess: got a rate of {fastest:g}/s, wanted factor * profile <= {MAX_RATE:g}"
            )
        tables = np.pad(np.cumsum(profiles * HOUR_S, axis=1), ((0, 0), (1, 0)))
        for name, array in (("factors", factors), ("profiles", profiles), ("tables", tables)):
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        # Memory that nobody has touched costs nothing, so a million slots may have their whole week.
        object.__setattr__(self, "kept", np.zeros(WEEK_HOURS * arrival.size))
        for name, row in zip(_FIELDS, (factors[0], profiles[0], factors[1], profiles[1]), strict=True):
            object.__setattr__(self, name, row)

    def __reduce__(self) -> tuple[Any, ...]:
        return OccupancyProcess, tuple(getattr(self, name) for name in _FIELDS)

    def __deepcopy__(self, memo: dict[int, Any]) -> "OccupancyProcess":
        return self  # immutable: copies of a world share it

    @classmethod
    def from_demand(cls, attraction: ArrayLike, demand: ArrayLike, mean_stay_s: float = 2 * HOUR_S) -> Self:
        """Process whose equilibrium occupancy has the logit `attraction[s] + demand[h]`.

        Args:
            attraction: (n,) float64, logit, how much a slot is liked.
            demand: (168,) float64, logit, by hour of the week.
            mean_stay_s: s, mean time that a car stays, the same for all slots and hours.
        """
        if not 0 < mean_stay_s < math.inf:
            raise InputError(f"mean_stay_s: got {mean_stay_s}, wanted seconds > 0")
        attraction, demand = np.asarray(attraction, float), np.asarray(demand, float)
        for name, logits in (("attraction", attraction), ("demand", demand)):
            # Past this even the exponential leaves the floating-point range.
            if not np.all(np.abs(logits) <= 300):
                raise InputError(f"{name}: wanted finite logits between -300 and 300")
        return cls(
            np.exp(attraction),
            np.exp(demand) / mean_stay_s,
            np.ones(attraction.shape),
            np.full(WEEK_HOURS, 1 / mean_stay_s),
        )

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> Self:
        """Read what `to_file` wrote; InputError names the file and what is wrong with it."""
        content = _FORMAT.read(path)
        wanted = set(_FIELDS)
        if content.keys() != wanted:
            odd = ", ".join(sorted(content.keys() ^ wanted))
            raise InputError(f"{path}: missing or unknown fields: {odd}; wanted {', '.join(sorted(wanted))}")
        try:
            return cls(*(content[name] for name in _FIELDS))
        except InputError as error:
            raise InputError(f"{path}: {error}") from error

    def to_file(self, path: str | os.PathLike[str]) -> None:
        """Write as JSON; a file that is there stays whole until the new one is complete."""
        rates = {name: getattr(self, name).tolist() for name in _FIELDS}
        _FORMAT.write(path, rates)

    @property
    def n_slots(self) -> int:
        """Number of slots."""
        return int(self.factors.shape[1])

    def take(self, slots: ArrayLike) -> "OccupancyProcess":
        """Process of a lot whose slot i has the rates of our slot `slots[i]`; (n,) int64."""
        arrival, departure = self.factors[:, np.asarray(slots, np.int64)]
        return OccupancyProcess(arrival, self.arrival_profile, departure, self.departure_profile)

    def mapped_to_lot(self, walk_m: ArrayLike) -> "OccupancyProcess":
        """Process of a lot of any size, from ours by rank: the fullest slots go nearest to the goal.

        Args:
            walk_m: (n,) float64, m, walking distance from each slot of that lot to its goal. The slot of
                rank r among them gets the rates of our slot of rank r * n_slots // n by mean occupancy over
                the week.
        """
        walk = np.asarray(walk_m, float)
        mean = np.mean([self.marginal(hour * HOUR_S) for hour in range(WEEK_HOURS)], axis=0)
        slots = np.empty(walk.size, np.int64)
        ranks = np.arange(walk.size) * self.n_slots // walk.size
        slots[np.argsort(walk, kind="stable")] = np.argsort(-mean, kind="stable")[ranks]
        return self.take(slots)

    def at_mean_occupancy(self, target: float, time: float) -> "OccupancyProcess":
        """Process with all arrival rates scaled alike, so that the lot's mean marginal at `time` is `target`.

        Scaling the arrival rates shifts every slot's attraction by the same logit.
        """
        if not 0 < target < 1:
            raise InputError(f"target mean occupancy: got {target}, wanted a number between 0 and 1")

        def scaled(shift: float) -> OccupancyProcess:
            arrival, departure = self.factors * [[math.exp(shift)], [1.0]]
            return OccupancyProcess(arrival, self.arrival_profile, departure, self.departure_profile)

        def excess(shift: float) -> float:
            return float(scaled(shift).marginal(time).mean()) - target

        fastest = float(self.arrival_factor.max() * self.arrival_profile.max())
        low, high = -100.0, math.log(0.99 * MAX_RATE / fastest) if fastest > 0 else 0.0
        if not excess(low) < 0 < excess(high):
            raise InputError(
                f"target mean occupancy: {target} cannot be reached by scaling the arrival rates"
            )
        return scaled(brentq(excess, low, high, xtol=1e-10))

    def marginal(self, time: float) -> FloatArray:
        """(n,) float64: P(occupied) at `time`, when nothing has been seen."""
        _, hour, second = hour_of_week(time)
        marginals: FloatArray = _marginals(self.factors, self.profiles, hour, second, self.kept)
        return marginals

    def draw_arrival(self, window: ArrivalWindow, key: np.uint64) -> Arrival:
        """Weekday and time of day, both uniform in the window."""
        index = int(keyed_uniform(key, ARRIVAL_STREAM, 0, 0) * len(window.weekdays))
        return Arrival(window.weekdays[index] * DAY_S + window.draw_second(key))

    def world(self, key: np.uint64, arrival: Arrival) -> ProcessWorld:
        """The world of the episode with this key; it begins in a state drawn from the marginal."""
        return ProcessWorld(self, key, arrival)

    def forecast(self, arrival: Arrival) -> Forecast:
        """The marginal at the arrival, clipped to [0.001, 0.999], and the rates of that hour."""
        _, hour, _ = hour_of_week(arrival.time)
        rates = self.factors * self.profiles[:, hour, None]
        return Forecast(
            np.clip(self.marginal(arrival.time), MIN_PROBABILITY, MAX_PROBABILITY), rates[0] + rates[1]
        )


_FIELDS = tuple(f.name for f in fields(OccupancyProcess) if f.init)


def _checked(name: str, values: Any, size: int | None = None) -> FloatArray:
    try:
        array = np.array(values, float)
    except (TypeError, ValueError) as error:
        raise InputError(f"OccupancyProcess.{name}: {error}, wanted numbers") from error
    if array.ndim != 1 or not array.size or array.size != (size or array.size):
        raise InputError(
            f"OccupancyProcess.{name}: got shape {array.shape}, wanted ({size or 'n'},), not empty"
        )
    for i in np.flatnonzero(~((array >= 0) & np.isfinite(array))):
        raise InputError(f"OccupancyProcess.{name}[{i}]: got {array[i]}, wanted a finite number >= 0")
    return array
