"""When the cars of a world arrive: by a law, by the hour, at given times, or such that a lot fills as it was counted.

Every arrival is drawn from its own random number, a pure function of the world's key and the car: a process of twice
the rate has the same gaps, half as long.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from pydantic import Field, InstanceOf
from scipy.optimize import nnls

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.keyed_random import HEADWAY_STREAM, car_uniforms
from parkenv.errors import InputError, require
from parkenv.files.field_types import NotNegative, Number, Numbers, Positive, Validated, Whole
from parkenv.files.known_names import MAX_CARS
from parkenv.world.durations import Duration, LogNormalTime, parked_share, staying_share
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.process import Arrival, ArrivalDay, OccupancyModel
from parkenv.world.week import DAY_HOURS, DAY_S, HOUR_S

Second = Annotated[NotNegative, Field(lt=DAY_S)]
_RARE = 1e-12  # probability of more arrivals than `PoissonArrivals.max_cars`
_FOLLOWED_S = 300.0  # between the moments at which a lot is compared with its occupancy model
_NO_RATE = 1e-9  # cars an hour
STAYS_H = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0, 14.0, 24.0)  # mean stays that are tried to follow counts, h
STAY_CV = 1.0  # standard deviation of these stays over their mean
TOLERANCE = 0.005  # share of the places by which the fit may be off in the mean, for a longer stay


class Arrivals(ABC):
    """When the cars of a world arrive."""

    @property
    @abstractmethod
    def max_cars(self) -> int:
        """Maximum number of cars of a world."""

    @abstractmethod
    def begin_s(self, arrival_s: float) -> float:
        """Return when the world begins, s of the day; `arrival_s` is the arrival drawn from the scenario's window."""

    @abstractmethod
    def draw(self, key: np.uint64, arrival_s: float, day: ArrivalDay) -> FloatArray:
        """Draw the arrivals of the world with this key on a day, (n,) ascending s of the day, at least one."""


@dataclass(frozen=True)
class Headways(Validated, Arrivals):
    """A fixed number of cars: the first arrives at a time in the scenario's arrival window, the others after it.

    Args:
        cars: number of cars, at least 1.
        mean_s: mean of the exponentially distributed times between two arrivals, s.
    """

    cars: Annotated[Whole, Field(ge=1, le=MAX_CARS)] = 1
    mean_s: Positive = 10.0

    @property
    def max_cars(self) -> int:
        return self.cars

    def begin_s(self, arrival_s: float) -> float:
        return arrival_s

    def draw(self, key: np.uint64, arrival_s: float, day: ArrivalDay) -> FloatArray:  # noqa: ARG002
        gaps = _gaps(key, self.cars) * self.mean_s
        gaps[0] = 0.0
        return arrival_s + np.cumsum(gaps)


@dataclass(frozen=True)
class PoissonArrivals(Validated, Arrivals):
    """Cars arrive as a Poisson process whose rate may change from hour to hour.

    A world in which nobody would arrive has one car, at the end.

    Args:
        per_hour: cars an hour, one number or 24, one for each hour of the day; at least 0, not all 0 in the window.
        start_s: beginning of the world, s of the day, in [0, 86400).
        end_s: end of the arrivals, s, after `start_s`; above 86400, the rates of the day repeat.
    """

    per_hour: NotNegative | Annotated[Numbers[NotNegative], Field(min_length=DAY_HOURS, max_length=DAY_HOURS)]
    start_s: Second = 8 * HOUR_S
    end_s: Number = 12 * HOUR_S

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.end_s > self.start_s, f"end_s is {self.end_s}, want a number above start_s, {self.start_s:g}"
        )
        require(
            self.expected > 0.0 and self.max_cars <= MAX_CARS,
            f"per_hour: {self.expected:,.0f} cars arrive in the window, want more than 0, at most {MAX_CARS:,}",
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

    def begin_s(self, arrival_s: float) -> float:  # noqa: ARG002
        return self.start_s

    def draw(self, key: np.uint64, arrival_s: float, day: ArrivalDay) -> FloatArray:  # noqa: ARG002
        times, expected = self._times()
        arrivals = np.cumsum(_gaps(key, self.max_cars))
        arrivals = arrivals[arrivals < expected[-1]]
        return np.asarray(np.interp(arrivals, expected, times)) if len(arrivals) else np.array([self.end_s])

    def _times(self) -> tuple[FloatArray, FloatArray]:
        times = hours_between(self.start_s, self.end_s)
        rates = np.broadcast_to(np.asarray(self.per_hour, np.float64), DAY_HOURS)
        hour = ((times[:-1] + 1e-9) // HOUR_S).astype(np.int64) % DAY_HOURS
        return times, np.concatenate(([0.0], np.cumsum(rates[hour] * np.diff(times) / HOUR_S)))


@dataclass(frozen=True)
class FollowingArrivals(Validated, Arrivals):
    """Cars arrive such that a lot becomes as full as its occupancy model says: as counted, recorded or expected.

    Residents leave and cars come: the rate of each hour is that with which the expected number of parked cars comes
    closest to the model's, every five minutes (least squares, no rate below 0), were the lot large enough for all. Of
    recorded days, each is followed for itself. A lot that empties faster than cars leave cannot be followed.
    """

    occupancy: InstanceOf[OccupancyModel]  # the model of the lot
    window: InstanceOf[ArrivalWindow]  # weekdays, beginning of the world, and end of the arrivals
    stay: InstanceOf[Duration]  # law of the time that a car stays in its slot
    scale: Positive = 1.0  # factor of these arrivals, above 0

    @property
    def max_cars(self) -> int:
        return max(self.rates_of(day).max_cars for day in self.occupancy.arrival_days(self.window))

    def begin_s(self, arrival_s: float) -> float:  # noqa: ARG002
        return self.window.start_s

    def draw(self, key: np.uint64, arrival_s: float, day: ArrivalDay) -> FloatArray:
        return self.rates_of(day).draw(key, arrival_s, day)

    def rates_of(self, day: ArrivalDay) -> PoissonArrivals:
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
class ListedArrivals(Validated, Arrivals):
    """Cars arrive at given times, the same in every world.

    Args:
        times_s: s of the day, in [0, 86400), ascending, at least one.
    """

    times_s: Numbers[Second]

    def __post_init__(self) -> None:
        super().__post_init__()
        if list(self.times_s) != sorted(self.times_s):
            raise InputError(f"times_s is {self.times_s!r:.60}, want ascending times")

    @property
    def max_cars(self) -> int:
        return len(self.times_s)

    def begin_s(self, arrival_s: float) -> float:  # noqa: ARG002
        return self.times_s[0]

    def draw(self, key: np.uint64, arrival_s: float, day: ArrivalDay) -> FloatArray:  # noqa: ARG002
        return np.array(self.times_s)


@dataclass(frozen=True)
class NoArrivals(Validated, Arrivals):
    """Nobody arrives: the cars of a purpose are all parked when the world begins, at `start_s` of the day."""

    start_s: Second
    max_cars: ClassVar[int] = 0

    def begin_s(self, arrival_s: float) -> float:  # noqa: ARG002
        return self.start_s

    def draw(self, key: np.uint64, arrival_s: float, day: ArrivalDay) -> FloatArray:  # noqa: ARG002
        return np.zeros(0)


class FollowedCounts(NamedTuple):
    """Cars with which a car park becomes as full as counted."""

    per_hour: FloatArray  # (n_hours,) cars an hour in the hours of the window
    stay: LogNormalTime
    expected: FloatArray  # (n_hours,) cars at the ends of the hours


def follow_counts(
    at_first: float, cars: FloatArray, start_s: float, end_s: float, stays_h: tuple[float, ...] = STAYS_H
) -> FollowedCounts:
    """Return the arrivals with which the expected number of cars is nearest to the counts, by least squares.

    Counts, `cars` at the end of each hour, or part of one, of the window, NaN where nobody counted, say how many cars
    there are, not how often they change, so the stay is not in them. Of the stays that are tried, h, the longest is
    taken with which the counts can be followed, so that the fewest cars come; else the one that is off least.
    """
    edges, known = hours_between(start_s, end_s), np.isfinite(cars)
    tried = []
    for hours in sorted(stays_h, reverse=True):
        stay = LogNormalTime(HOUR_S * hours, STAY_CV)
        # Those who are there at first leave after the rest of such a stay.
        rest = at_first * staying_share(stay, edges[1:] - edges[0])
        there = parked_share(stay, edges, edges[1:])
        rates, _ = nnls(there[known], (cars - rest)[known])
        expected = rest + there @ rates
        off = float(np.abs(expected - cars)[known].mean())
        tried.append((off, FollowedCounts(rates, stay, expected)))
        if off <= TOLERANCE * np.nanmax(cars):
            return tried[-1][1]
    return min(tried, key=lambda pair: pair[0])[1]


def hours_between(start_s: float, end_s: float) -> FloatArray:
    hours = np.arange(start_s // HOUR_S + 1, math.ceil(end_s / HOUR_S)) * HOUR_S
    return np.concatenate(([start_s], hours, [end_s]))


def uniforms(key: np.uint64, stream: int, n: int) -> FloatArray:
    values = np.empty(n)
    car_uniforms(key, stream, values)
    return values


def _gaps(key: np.uint64, n: int) -> FloatArray:
    return -np.log(uniforms(key, HEADWAY_STREAM, n))
