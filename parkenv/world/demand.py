"""Demand for parking: when cars arrive, how long they stay, and how long they search before they go elsewhere.

Every number of a car is drawn from its own random number, a pure function of the world's key and the car. So demand
does not depend on what anybody does, and two demands with other rates or stays use the same random numbers: an arrival
process of twice the rate has the same gaps, half as long.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import nnls
from scipy.special import ndtri

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.keyed_random import (
    CLASS_STREAM,
    ENTRY_STREAM,
    GOAL_STREAM,
    HEADWAY_STREAM,
    KIND_STREAM,
    PATIENCE_STREAM,
    STAY_STREAM,
    car_uniforms,
    named_key,
)
from parkenv.errors import InputError, require_number, require_whole
from parkenv.files.known_names import MAX_CARS
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.log import OccupancyLog
from parkenv.world.occupancy.process import Arrival, ArrivalDay, OccupancyModel
from parkenv.world.week import DAY_HOURS, DAY_PERIODS, DAY_S, HOUR_S, PERIOD_S

MAX_CLASSES = 60
"""Maximum number of classes of drivers."""
CHARGING = "charging"
"""The class of cars that need to charge."""
_QUANTILES = 400  # equally probable stays that stand for their law
_RARE = 1e-12  # probability of more arrivals than `PoissonArrivals.max_cars`
_FOLLOWED_S = 300.0  # between the moments at which a lot is compared with its occupancy model
_NO_RATE = 1e-9  # cars an hour


class Duration(Protocol):
    """A law of durations, s."""

    @property
    def mean_s(self) -> float:
        """Mean, s."""

    def quantile(self, u: FloatArray) -> FloatArray:
        """Return the durations, (k,) s, that are exceeded with probability 1 - u, for u in (0, 1)."""


@dataclass(frozen=True)
class ConstantTime:
    """Always the same duration.

    Args:
        seconds: s, above 0; infinite: for ever.
    """

    seconds: float

    def __post_init__(self) -> None:
        require_number("ConstantTime.seconds", self.seconds, above=0.0, finite=False)

    @property
    def mean_s(self) -> float:
        """Mean, s."""
        return self.seconds

    def quantile(self, u: FloatArray) -> FloatArray:
        """Return the durations; see `Duration`."""
        return np.full(len(u), float(self.seconds))


@dataclass(frozen=True)
class ExponentialTime:
    """Exponentially distributed durations.

    Args:
        mean_s: s, above 0 and finite.
    """

    mean_s: float

    def __post_init__(self) -> None:
        require_number("ExponentialTime.mean_s", self.mean_s, above=0.0)

    def quantile(self, u: FloatArray) -> FloatArray:
        """Return the durations; see `Duration`."""
        return -self.mean_s * np.log1p(-u)


@dataclass(frozen=True)
class LogNormalTime:
    """Log-normally distributed durations.

    Args:
        mean_s: s, above 0 and finite.
        cv: coefficient of variation, standard deviation over mean, above 0.
    """

    mean_s: float
    cv: float = 1.0

    def __post_init__(self) -> None:
        require_number("LogNormalTime.mean_s", self.mean_s, above=0.0)
        require_number("LogNormalTime.cv", self.cv, above=0.0)

    def quantile(self, u: FloatArray) -> FloatArray:
        """Return the durations; see `Duration`."""
        variance = math.log1p(self.cv**2)
        return np.asarray(self.mean_s * np.exp(math.sqrt(variance) * ndtri(u) - variance / 2))


@dataclass(frozen=True)
class EmpiricalTime:
    """Durations drawn from a list, all with equal probability.

    Args:
        values_s: s, at least one, all above 0 and finite.
    """

    values_s: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "values_s", _numbers("EmpiricalTime.values_s", self.values_s))
        for i, value in enumerate(self.values_s):
            require_number(f"EmpiricalTime.values_s[{i}]", value, above=0.0)

    @property
    def mean_s(self) -> float:
        """Mean, s."""
        return float(np.mean(self.values_s))

    def quantile(self, u: FloatArray) -> FloatArray:
        """Return the durations; see `Duration`."""
        values = np.sort(self.values_s)
        return np.asarray(values[(u * len(values)).astype(np.int64)])


class Arrivals(Protocol):
    """When the cars of a world arrive."""

    @property
    def max_cars(self) -> int:
        """Maximum number of cars of a world."""

    def begin_s(self, arrival_s: float) -> float:
        """Return when the world begins, s of the day; `arrival_s` is the arrival drawn from the scenario's window."""

    def draw(self, key: np.uint64, arrival_s: float, day: ArrivalDay) -> FloatArray:
        """Draw the arrivals of the world with this key on a day, (n,) ascending s of the day, at least one."""


@dataclass(frozen=True)
class Headways:
    """A fixed number of cars: the first arrives at a time in the scenario's arrival window, the others after it.

    Args:
        cars: number of cars, at least 1.
        mean_s: mean of the exponentially distributed times between two arrivals, s.
    """

    cars: int = 1
    mean_s: float = 10.0

    def __post_init__(self) -> None:
        require_whole("Headways.cars", self.cars, least=1, most=MAX_CARS)
        require_number("Headways.mean_s", self.mean_s, above=0.0)

    @property
    def max_cars(self) -> int:
        """Number of cars."""
        return self.cars

    def begin_s(self, arrival_s: float) -> float:
        """Return the first car's arrival."""
        return arrival_s

    def draw(self, key: np.uint64, arrival_s: float, day: ArrivalDay) -> FloatArray:
        """Draw the arrivals; see `Arrivals`."""
        del day
        gaps = _gaps(key, self.cars) * self.mean_s
        gaps[0] = 0.0
        return arrival_s + np.cumsum(gaps)


@dataclass(frozen=True)
class PoissonArrivals:
    """Cars arrive as a Poisson process whose rate may change from hour to hour.

    Args:
        per_hour: cars an hour, one number or 24, one for each hour of the day; at least 0, not all 0 in the window.
        start_s: beginning of the world, s of the day, in [0, 86400).
        end_s: end of the arrivals, s, after `start_s`; above 86400, the rates of the day repeat.
    """

    per_hour: float | tuple[float, ...]
    start_s: float = 8 * HOUR_S
    end_s: float = 12 * HOUR_S

    def __post_init__(self) -> None:
        if np.ndim(self.per_hour) > 0:
            rates = _numbers("PoissonArrivals.per_hour", self.per_hour)
            if len(rates) != DAY_HOURS:
                raise InputError(
                    f"PoissonArrivals.per_hour has {len(rates)} numbers, want one or {DAY_HOURS}"
                )
            object.__setattr__(self, "per_hour", rates)
        for rate in np.atleast_1d(self.per_hour):
            require_number("PoissonArrivals.per_hour", float(rate), least=0.0)
        _require_second("PoissonArrivals.start_s", self.start_s)
        require_number("PoissonArrivals.end_s", self.end_s, above=self.start_s)
        if not self.expected > 0.0:
            raise InputError(
                f"PoissonArrivals.per_hour is {self.per_hour!r}, want a rate above 0 in the window: no car would arrive"
            )
        if self.max_cars > MAX_CARS:
            raise InputError(
                f"PoissonArrivals.per_hour: {self.expected:,.0f} cars arrive in the window, want at most {MAX_CARS:,}"
            )

    @property
    def expected(self) -> float:
        """Expected number of cars."""
        return float(self._times()[1][-1])

    @property
    def max_cars(self) -> int:
        """Number of cars that is exceeded once in 10^12 worlds; further arrivals are left out."""
        from scipy.stats import poisson  # it takes longer to load than a short comparison of agents

        return int(poisson.isf(_RARE, self.expected)) + 1

    def begin_s(self, arrival_s: float) -> float:
        """Return `start_s`."""
        del arrival_s
        return self.start_s

    def draw(self, key: np.uint64, arrival_s: float, day: ArrivalDay) -> FloatArray:
        """Draw the arrivals; see `Arrivals`. A world in which nobody would arrive has one car, at the end."""
        del arrival_s, day
        times, expected = self._times()
        arrivals = np.cumsum(_gaps(key, self.max_cars))
        arrivals = arrivals[arrivals < expected[-1]]
        if not len(arrivals):
            return np.array([self.end_s])
        return np.asarray(np.interp(arrivals, expected, times))

    def _times(self) -> tuple[FloatArray, FloatArray]:
        """Return full hours in the window, with its ends, s, and the expected number of arrivals until then."""
        times = hours_between(self.start_s, self.end_s)
        rates = np.broadcast_to(np.asarray(self.per_hour, np.float64), DAY_HOURS)
        hour = ((times[:-1] + 1e-9) // HOUR_S).astype(np.int64) % DAY_HOURS
        return times, np.concatenate(([0.0], np.cumsum(rates[hour] * np.diff(times) / HOUR_S)))


@dataclass(frozen=True)
class FollowingArrivals:
    """Cars arrive such that a lot becomes as full as its occupancy model says: as counted, recorded or expected.

    Residents leave and cars come: the rate of each hour is that with which the expected number of parked cars comes
    closest to the model's, every five minutes (least squares, no rate below 0), were the lot large enough for all. Of
    recorded days, each is followed for itself. A lot that empties faster than cars leave cannot be followed.

    Args:
        occupancy: the model of the lot.
        window: weekdays, beginning of the world, and end of the arrivals.
        stay: law of the time that a car stays in its slot.
        scale: factor of these arrivals, above 0.
    """

    occupancy: OccupancyModel
    window: ArrivalWindow
    stay: Duration
    scale: float = 1.0

    def __post_init__(self) -> None:
        require_number("FollowingArrivals.scale", self.scale, above=0.0)

    @property
    def max_cars(self) -> int:
        """Maximum number of cars of a day."""
        return max(self.rates_of(day).max_cars for day in self.occupancy.arrival_days(self.window))

    def begin_s(self, arrival_s: float) -> float:
        """Return the beginning of the window."""
        del arrival_s
        return self.window.start_s

    def draw(self, key: np.uint64, arrival_s: float, day: ArrivalDay) -> FloatArray:
        """Draw the arrivals of a day; see `Arrivals`."""
        return self.rates_of(day).draw(key, arrival_s, day)

    def rates_of(self, day: ArrivalDay) -> PoissonArrivals:
        """Return the arrivals of one of the days, with their rates by hour."""
        start, end = self.window.start_s, self.window.end_s
        seconds = np.append(np.arange(start + _FOLLOWED_S, end, _FOLLOWED_S), end).astype(np.float64)
        midnight = day.weekday * DAY_S
        course = self.occupancy.course(Arrival(midnight + start, day.date), midnight + seconds)
        edges = hours_between(start, end)
        wanted = self.occupancy.n_slots * (course.occupied - course.residents)
        rates, _ = nnls(parked_share(self.stay, edges, seconds), wanted)
        # Where nobody has to come, arrivals still need some rate above 0.
        by_hour = np.full(DAY_HOURS, _NO_RATE)
        by_hour[(edges[:-1] // HOUR_S).astype(np.int64)] += self.scale * rates
        return PoissonArrivals(tuple(by_hour), start, end)


@dataclass(frozen=True)
class ListedArrivals:
    """Cars arrive at given times.

    Args:
        times_s: s of the day, in [0, 86400), ascending, at least one.
    """

    times_s: tuple[float, ...]

    def __post_init__(self) -> None:
        times = _numbers("ListedArrivals.times_s", self.times_s)
        for i, time in enumerate(times):
            _require_second(f"ListedArrivals.times_s[{i}]", time)
            if i > 0 and time < times[i - 1]:
                raise InputError(
                    f"ListedArrivals.times_s[{i}] is {time}, want at least {times[i - 1]}, the one before"
                )
        object.__setattr__(self, "times_s", times)

    @property
    def max_cars(self) -> int:
        """Number of cars."""
        return len(self.times_s)

    def begin_s(self, arrival_s: float) -> float:
        """Return the first arrival."""
        del arrival_s
        return self.times_s[0]

    def draw(self, key: np.uint64, arrival_s: float, day: ArrivalDay) -> FloatArray:
        """Return the arrivals; they are the same in every world."""
        del key, arrival_s, day
        return np.array(self.times_s)


@dataclass(frozen=True)
class NoArrivals:
    """Nobody arrives: the cars of a purpose are all parked when the world begins.

    Args:
        start_s: beginning of the world, s of the day, in [0, 86400).
    """

    start_s: float

    def __post_init__(self) -> None:
        _require_second("NoArrivals.start_s", self.start_s)

    @property
    def max_cars(self) -> int:
        """None."""
        return 0

    def begin_s(self, arrival_s: float) -> float:
        """Return `start_s`."""
        del arrival_s
        return self.start_s

    def draw(self, key: np.uint64, arrival_s: float, day: ArrivalDay) -> FloatArray:
        """Return no arrival."""
        del key, arrival_s, day
        return np.zeros(0)


class CarPlans(NamedTuple):
    """What is known of the cars of a world before anybody drives, (n,) each, in order of arrival.

    Attributes:
        arrival_s: float64, s of the day.
        stay_s: float64, s, time in the slot; of parked cars, what is left of it.
        patience_s: float64, s, length of the search after which the car goes elsewhere.
        entry: int64, index of the entry.
        goal: int64, index of the goal among those with a weight.
        kind: float64 in (0, 1), number that decides the kind of driver.
        purpose: int64, index of the purpose.
        value_of_time: float64, value of an hour of the driver's time; NaN: the scenario's.
        classes: int64, bit k is set for drivers of the class `class_names[k]` of the demand.
        walks_back: bool, whether the walk back from the goal counts, too.
        kwh: float64, energy that the car takes where it can charge.
        parked: bool, whether the car stands in a slot when the world begins; these come first.
    """

    arrival_s: FloatArray
    stay_s: FloatArray
    patience_s: FloatArray
    entry: IntArray
    goal: IntArray
    kind: FloatArray
    purpose: IntArray
    value_of_time: FloatArray
    classes: IntArray
    walks_back: BoolArray
    kwh: FloatArray
    parked: BoolArray

    @classmethod
    def joined(cls, parts: Sequence[CarPlans]) -> CarPlans:
        """Return the cars of several plans, one after another."""
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in cls._fields})

    def at(self, order: IntArray) -> CarPlans:
        """Return the cars with these indices."""
        return self._replace(**{name: getattr(self, name)[order] for name in self._fields})


@dataclass(frozen=True)
class Demand:
    """The demand for parking in one lot, of drivers with one purpose; `TownDemand` is that of several.

    Args:
        arrivals: when cars arrive.
        stay: law of the time that a car stays in its slot.
        patience: law of the time after which a searching car *balks*: at its next decision it goes elsewhere, at the
            cost of the scenario's `give_up_s`. In a town, the shortest way to its goal does not count.
        entry_weights: relative number of cars of each entry of the lot; empty: as in a single search, the scenario's
            entry, or all alike.
        goal_weights: relative number of cars of each goal of the lot; empty: the scenario's goal.
        name: the purpose, such as `commuters`. Purposes of different names have different random numbers, so that one
            can be changed without the others.
        value_of_time: value of an hour of the drivers' time, in the currency of the prices; None: the scenario's.
        classes: share of the drivers of each class, by its name, such as `permit-a`; independent of each other.
        walks_back: whether the walk back from the goal counts as much as that to it.
        kwh: energy that a car of the class `charging` takes.
        parked: number of cars that stand in slots when the world begins. They leave after the rest of their stay, as
            cars do that have come and gone by this law for long.

    Raises:
        InputError: a value out of its range; the message names the field.
    """

    arrivals: Arrivals = field(default_factory=Headways)
    stay: Duration = field(default_factory=lambda: ExponentialTime(HOUR_S))
    patience: Duration = field(default_factory=lambda: ConstantTime(math.inf))
    entry_weights: tuple[float, ...] = ()
    goal_weights: tuple[float, ...] = ()
    name: str = ""
    value_of_time: float | None = None
    classes: Mapping[str, float] = field(default_factory=dict)
    walks_back: bool = False
    kwh: float = 0.0
    parked: int = 0

    def __post_init__(self) -> None:
        for name, wanted in (("arrivals", "draw"), ("stay", "quantile"), ("patience", "quantile")):
            value = getattr(self, name)
            if not hasattr(value, wanted):
                examples = (
                    "arrivals such as Headways" if name == "arrivals" else "a law such as ExponentialTime"
                )
                raise InputError(f"Demand.{name} is {value!r:.60}, want {examples}")
        for name in ("entry_weights", "goal_weights"):
            object.__setattr__(self, name, _weights(f"Demand.{name}", getattr(self, name)))
        if self.value_of_time is not None:
            require_number("Demand.value_of_time", self.value_of_time, above=0.0)
        for name, share in self.classes.items():
            require_number(f"Demand.classes[{name!r}]", share, least=0.0, most=1.0)
        if len(self.classes) > MAX_CLASSES:
            raise InputError(f"Demand.classes has {len(self.classes)} names, want at most {MAX_CLASSES}")
        require_number("Demand.kwh", self.kwh, least=0.0)
        require_whole("Demand.parked", self.parked, most=MAX_CARS)

    @property
    def purposes(self) -> tuple[Demand, ...]:
        """The demand itself: its one purpose."""
        return (self,)

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the classes, in the order of the bits of `CarPlans.classes`."""
        return tuple(self.classes)

    @property
    def max_cars(self) -> int:
        """Maximum number of cars of a world."""
        return self.arrivals.max_cars + self.parked

    @property
    def expected(self) -> float:
        """Expected number of arrivals, of a Poisson process; else the maximum."""
        return getattr(self.arrivals, "expected", self.arrivals.max_cars)

    def begin_s(self, arrival_s: float) -> float:
        """Return when the world begins, s of the day; see `Arrivals`."""
        return self.arrivals.begin_s(arrival_s)

    def scaled(self, factor: float) -> Demand:
        """Return the demand with so many times the arrivals of a Poisson process, and the same cars parked."""
        if not isinstance(self.arrivals, PoissonArrivals):
            return self
        rates = np.asarray(self.arrivals.per_hour) * factor
        return replace(self, arrivals=replace(self.arrivals, per_hour=rates.tolist()))

    def draw(self, key: np.uint64, arrival_s: float, n_entries: int, day: ArrivalDay) -> CarPlans:
        """Draw the cars of the world with this key.

        Args:
            key: key of the world.
            arrival_s: arrival drawn from the scenario's window, s of the day.
            n_entries: number of entries among which cars choose if there are no `entry_weights`.
            day: day of the world.
        """
        own = named_key(key, self.name) if self.name else key
        arriving = self._plans(own, self.arrivals.draw(own, arrival_s, day), n_entries, parked=False)
        if not self.parked:
            return arriving
        since = np.full(self.parked, self.begin_s(arrival_s))
        parked = self._plans(named_key(own, "parked"), since, n_entries, parked=True)
        return CarPlans.joined([parked, arriving])

    def _plans(self, key: np.uint64, arrival: FloatArray, n_entries: int, *, parked: bool) -> CarPlans:
        n, u_stay = len(arrival), _uniforms(key, STAY_STREAM, len(arrival))
        entries = self.entry_weights or (1.0,) * n_entries
        classes = np.zeros(n, np.int64)
        for bit, (name, share) in enumerate(self.classes.items()):
            drawn = _uniforms(named_key(key, name), CLASS_STREAM, n) < share
            classes |= drawn.astype(np.int64) << bit
        charges = classes >> self.class_names.index(CHARGING) & 1 if CHARGING in self.classes else 0
        return CarPlans(
            arrival,
            rest_of_stay(self.stay, u_stay) if parked else self.stay.quantile(u_stay),
            self.patience.quantile(_uniforms(key, PATIENCE_STREAM, n)),
            _choices(_uniforms(key, ENTRY_STREAM, n), entries),
            _choices(_uniforms(key, GOAL_STREAM, n), self.goal_weights or (1.0,)),
            _uniforms(key, KIND_STREAM, n),
            np.zeros(n, np.int64),
            np.full(n, math.nan if self.value_of_time is None else self.value_of_time),
            classes,
            np.full(n, self.walks_back),
            np.full(n, self.kwh) * charges,
            np.full(n, parked),
        )

    @classmethod
    def fitted_to(cls, log: OccupancyLog, n_slots: int, kind: str = "weekday") -> Demand:
        """Fit arrivals and stays to a log, such that occupancy comes out as recorded.

        The cars of a slot are the periods in which it was observed taken. A car that was there at a day's first
        observation is a resident, and no arrival. Stays are estimated with regard to those that are cut off by the end
        of a day's observations; then the arrivals of each hour are those with which the expected number of arrived cars
        comes closest to the recorded one, half-hour by half-hour (least squares, no rate below 0). A car that takes
        the place of another one between two observations is not seen: the two count as one that stays longer.

        Args:
            log: the log.
            n_slots: number of slots of the lot to fill; the arrivals of the log's slots are scaled to it.
            kind: class of the days, `weekday` or `weekend`.

        Raises:
            InputError: no such days, or no car came and left on them.
        """
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
        return cls(PoissonArrivals(tuple(map(float, n_slots * per_slot)), *window), EmpiricalTime(stays))


@dataclass(frozen=True)
class TownDemand:
    """The demand of drivers with several purposes.

    Args:
        purposes: the demand of each, of different names; either all of them weigh the lot's entries, or none does, and
            so with goals.

    Raises:
        InputError: a value out of its range; the message names the field.
    """

    purposes: tuple[Demand, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "purposes", tuple(self.purposes))
        names = [one.name for one in self.purposes]
        if not names or len(set(names)) < len(names):
            raise InputError(f"TownDemand.purposes are named {names}, want at least one, of different names")
        if not any(one.arrivals.max_cars for one in self.purposes):
            raise InputError("TownDemand.purposes: nobody arrives, want a rate above 0 in the window")
        for name in ("entry_weights", "goal_weights"):
            if len({len(getattr(one, name)) for one in self.purposes}) > 1:
                raise InputError(f"TownDemand.purposes: {name} are of different lengths, want one for all")
        if self.max_cars > MAX_CARS:
            raise InputError(f"TownDemand.purposes: {self.max_cars:,} cars, want at most {MAX_CARS:,}")
        if len(self.class_names) > MAX_CLASSES:
            raise InputError(
                f"TownDemand.purposes have {len(self.class_names)} classes, want at most {MAX_CLASSES}"
            )

    @property
    def entry_weights(self) -> tuple[float, ...]:
        """Those of the first purpose: as many as those of all."""
        return self.purposes[0].entry_weights

    @property
    def goal_weights(self) -> tuple[float, ...]:
        """Those of the first purpose: as many as those of all."""
        return self.purposes[0].goal_weights

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the classes, in the order of the bits of `CarPlans.classes`."""
        return tuple(dict.fromkeys(name for one in self.purposes for name in one.classes))

    @property
    def max_cars(self) -> int:
        """Maximum number of cars of a world."""
        return sum(one.max_cars for one in self.purposes)

    @property
    def expected(self) -> float:
        """Expected number of arrivals."""
        return sum(one.expected for one in self.purposes)

    def begin_s(self, arrival_s: float) -> float:
        """Return when the world begins, s of the day: with the first purpose."""
        return min(one.begin_s(arrival_s) for one in self.purposes)

    def scaled(self, factor: float) -> TownDemand:
        """Return the demand with so many times the arrivals, and the same cars parked."""
        return TownDemand(tuple(one.scaled(factor) for one in self.purposes))

    def draw(self, key: np.uint64, arrival_s: float, n_entries: int, day: ArrivalDay) -> CarPlans:
        """Draw the cars of the world with this key; see `Demand.draw`."""
        bits, drawn = {name: bit for bit, name in enumerate(self.class_names)}, []
        for number, one in enumerate(self.purposes):
            plans = one.draw(key, arrival_s, n_entries, day)
            classes = np.zeros_like(plans.classes)
            for bit, name in enumerate(one.classes):
                classes |= (plans.classes >> bit & 1) << bits[name]
            drawn.append(plans._replace(purpose=np.full_like(classes, number), classes=classes))
        plans = CarPlans.joined(drawn)
        plans.arrival_s[plans.parked] = self.begin_s(arrival_s)
        return plans.at(np.lexsort((~plans.parked, plans.arrival_s)))


class _RecordedCars(NamedTuple):
    """The cars that arrived in a log.

    Attributes:
        stay_s: (k,) float64, s, until they left or were observed last.
        ended: (k,) bool, whether they were observed to leave.
        arrived: (48,) float64, over all slots and days: slots taken by a car that arrived, at full and half hours.
        seen: (48,) float64, slots observed before and after that time on that day.
    """

    stay_s: FloatArray
    ended: NDArray[np.bool_]
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


def weights_of_all(weights: Mapping[str, FloatArray]) -> tuple[float, ...]:
    """Return the weights of a lot's entries or goals over all purposes; none if it has none."""
    return tuple(np.sum([*weights.values()], axis=0).tolist()) if weights else ()


def hours_between(start_s: float, end_s: float) -> FloatArray:
    """Return the full hours between two times, and these, s."""
    hours = np.arange(start_s // HOUR_S + 1, math.ceil(end_s / HOUR_S)) * HOUR_S
    return np.concatenate(([start_s], hours, [end_s]))


def parked_share(stay: Duration, edges: FloatArray, times: FloatArray) -> FloatArray:
    """Return the expected cars at k times, (k, m), if one car an hour arrives from one edge, (m + 1,), to the next.

    The share that arrived at u and stays at t is P(stay > t - u); its integral over u is the mean of min(stay, t - u).
    """
    since = np.maximum(times[:, None] - edges, 0.0)
    stayed = np.minimum(_equally_likely(stay), since[:, :, None]).mean(axis=2)
    return np.asarray(-np.diff(stayed, axis=1) / HOUR_S)


def staying_share(stay: Duration, since_s: FloatArray) -> FloatArray:
    """Return which share of the cars that are met parked is still there after k times, (k,); see `rest_of_stay`."""
    stays = _equally_likely(stay)
    return np.asarray(1.0 - np.minimum(stays, since_s[:, None]).mean(axis=1) / stays.mean())


def _equally_likely(stay: Duration) -> FloatArray:
    """Return stays that stand for their law, s, ascending."""
    return stay.quantile((np.arange(_QUANTILES) + 0.5) / _QUANTILES)


def _stay_quantiles(stays: FloatArray, ended: NDArray[np.bool_]) -> tuple[float, ...]:
    """Return stays at equally likely quantiles, s, from stays of which some are known from below only.

    The estimator of Kaplan and Meier; beyond the longest stay whose end was observed, an exponential law whose mean is
    the time stayed for each observed end.
    """
    times, ends = np.unique(stays[ended], return_counts=True)
    staying = len(stays) - np.searchsorted(np.sort(stays), times, side="left")
    survival = np.cumprod(1.0 - ends / staying)
    levels = 1.0 - (np.arange(_QUANTILES) + 0.5) / _QUANTILES
    # The first time at which at most this fraction still stays.
    at = np.searchsorted(-survival, -levels, side="left")
    last, mean = times[-1], float(stays.sum() / ended.sum())
    left = max(float(survival[-1]), levels[-1] / 2)
    beyond = last + mean * np.log(np.maximum(left / levels, 1.0))
    return tuple(map(float, np.where(at < len(times), times[np.minimum(at, len(times) - 1)], beyond)))


def rest_of_stay(stay: Duration, u: FloatArray) -> FloatArray:
    """Return what is left of the stays of cars that are met parked, (k,) s, for uniform u in (0, 1).

    Long stays are met more often, and each at a uniform moment: the law of the excess of a renewal process.
    """
    if not math.isfinite(stay.mean_s):
        return np.full(len(u), math.inf)
    stays = _equally_likely(stay)
    until = np.cumsum(stays) / stays.sum()
    met = np.minimum(np.searchsorted(until, u, side="right"), _QUANTILES - 1)
    return np.asarray((until[met] - u) * stays.sum())


def _uniforms(key: np.uint64, stream: int, n: int) -> FloatArray:
    values = np.empty(n)
    car_uniforms(key, stream, 0, values)
    return values


def _gaps(key: np.uint64, n: int) -> FloatArray:
    """Exponential times with mean 1 before each car's arrival."""
    return -np.log(_uniforms(key, HEADWAY_STREAM, n))


def _choices(u: FloatArray, weights: Sequence[float]) -> IntArray:
    """Return the index that each uniform number chooses by weight; equal weights as `int(u * n)`."""
    if len(set(weights)) == 1:
        return (u * len(weights)).astype(np.int64)
    shares = np.cumsum(weights) / np.sum(weights)
    return np.minimum(np.searchsorted(shares, u, side="right"), len(weights) - 1).astype(np.int64)


def _require_second(name: str, value: Any) -> None:
    require_number(name, value, least=0.0)
    if value >= DAY_S:
        raise InputError(f"{name} is {value!r}, want seconds of the day in [0, 86400)")


def _numbers(name: str, values: ArrayLike) -> tuple[float, ...]:
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name} is {values!r:.60}, want numbers") from None
    if array.ndim != 1 or not array.size:
        raise InputError(f"{name} has shape {array.shape}, want a list of at least one number")
    return tuple(map(float, array))


def _weights(name: str, values: Sequence[float]) -> tuple[float, ...]:
    if not len(values):
        return ()
    weights = _numbers(name, values)
    if not all(math.isfinite(w) and w >= 0.0 for w in weights) or not sum(weights) > 0.0:
        raise InputError(f"{name} is {values!r:.60}, want finite numbers of at least 0, not all 0")
    return weights
