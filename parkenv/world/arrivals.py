"""When the cars of a world arrive: by a law, by the hour, at given times, or such that a lot fills as it was counted.

Every arrival is drawn from its own random number, a pure function of the world's key and the car: a process of twice
the rate has the same gaps, half as long.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from scipy.optimize import nnls

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.keyed_random import HEADWAY_STREAM, car_uniforms
from parkenv.errors import InputError, require_number, require_whole
from parkenv.files.known_names import MAX_CARS
from parkenv.world.durations import Duration, numbers_of, parked_share
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.process import Arrival, ArrivalDay, OccupancyModel
from parkenv.world.week import DAY_HOURS, DAY_S, HOUR_S

_RARE = 1e-12  # probability of more arrivals than `PoissonArrivals.max_cars`
_FOLLOWED_S = 300.0  # between the moments at which a lot is compared with its occupancy model
_NO_RATE = 1e-9  # cars an hour


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
            rates = numbers_of("PoissonArrivals.per_hour", self.per_hour)
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
        times = numbers_of("ListedArrivals.times_s", self.times_s)
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


def hours_between(start_s: float, end_s: float) -> FloatArray:
    """Return the full hours between two times, and these, s."""
    hours = np.arange(start_s // HOUR_S + 1, math.ceil(end_s / HOUR_S)) * HOUR_S
    return np.concatenate(([start_s], hours, [end_s]))


def uniforms(key: np.uint64, stream: int, n: int) -> FloatArray:
    """Return the random numbers of the first n cars in a stream, (n,) in (0, 1)."""
    values = np.empty(n)
    car_uniforms(key, stream, 0, values)
    return values


def _gaps(key: np.uint64, n: int) -> FloatArray:
    """Exponential times with mean 1 before each car's arrival."""
    return -np.log(uniforms(key, HEADWAY_STREAM, n))


def _require_second(name: str, value: Any) -> None:
    require_number(name, value, least=0.0)
    if value >= DAY_S:
        raise InputError(f"{name} is {value!r}, want seconds of the day in [0, 86400)")
