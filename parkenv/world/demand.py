"""Demand for parking: whose cars come, when, how long they stay, and how long they search before they go elsewhere.

Every number of a car is drawn from its own random number, a pure function of the world's key and the car. So demand
does not depend on what anybody does, and two demands with other rates or stays use the same random numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import AfterValidator, Field, InstanceOf

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.keyed_random import (
    CLASS_STREAM,
    ENTRY_STREAM,
    GOAL_STREAM,
    KIND_STREAM,
    PATIENCE_STREAM,
    STAY_STREAM,
    named_key,
)
from parkenv.errors import InputError, require
from parkenv.files.field_types import OF_ARRAY, NotNegative, Positive, Probability, Validated, Whole
from parkenv.files.known_names import MAX_CARS
from parkenv.world.arrivals import (
    Arrivals,
    FollowingArrivals,
    Headways,
    ListedArrivals,
    NoArrivals,
    PoissonArrivals,
    uniforms,
)
from parkenv.world.durations import (
    ConstantTime,
    Duration,
    EmpiricalTime,
    ExponentialTime,
    LogNormalTime,
    rest_of_stay,
)
from parkenv.world.occupancy.process import ArrivalDay
from parkenv.world.week import HOUR_S

__all__ = [
    "Arrivals", "CarPlans", "ConstantTime", "Demand", "Duration", "EmpiricalTime", "ExponentialTime",
    "FollowingArrivals", "Headways", "ListedArrivals", "LogNormalTime", "NoArrivals", "PoissonArrivals", "TownDemand",
    "weights_of_all",
]  # fmt: skip

MAX_CLASSES = 60  # maximum number of classes of drivers
CHARGING = "charging"  # the class of cars that need to charge


class CarPlans(NamedTuple):
    """What is known of the cars of a world before anybody drives, (n,) each, in order of arrival."""

    arrival_s: FloatArray  # float64, s of the day
    stay_s: FloatArray  # float64, s, time in the slot; of parked cars, what is left of it
    patience_s: FloatArray  # float64, s, length of the search after which the car goes elsewhere
    entry: IntArray  # int64, index of the entry
    goal: IntArray  # int64, index of the goal among those with a weight
    kind: FloatArray  # float64 in (0, 1), number that decides the kind of driver
    purpose: IntArray  # int64, index of the purpose
    value_of_time: FloatArray  # float64, value of an hour of the driver's time; NaN: the scenario's
    classes: IntArray  # int64, bit k is set for drivers of the class `class_names[k]` of the demand
    walks_back: BoolArray  # bool, whether the walk back from the goal counts, too
    kwh: FloatArray  # float64, energy that the car takes where it can charge
    parked: BoolArray  # bool, whether the car stands in a slot when the world begins; these come first

    @classmethod
    def joined(cls, parts: Sequence[CarPlans]) -> CarPlans:
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in cls._fields})

    def at(self, order: IntArray) -> CarPlans:
        return self._replace(**{name: getattr(self, name)[order] for name in self._fields})


def _not_all_0(weights: tuple[float, ...]) -> tuple[float, ...]:
    if weights and not sum(weights) > 0.0:
        raise ValueError("finite numbers of at least 0, not all 0")
    return weights


Weights = Annotated[tuple[NotNegative, ...], OF_ARRAY, AfterValidator(_not_all_0)]


@dataclass(frozen=True)
class Demand(Validated):
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

    arrivals: InstanceOf[Arrivals] = field(default_factory=Headways)
    stay: InstanceOf[Duration] = field(default_factory=lambda: ExponentialTime(HOUR_S))
    patience: InstanceOf[Duration] = field(default_factory=lambda: ConstantTime(math.inf))
    entry_weights: Weights = ()
    goal_weights: Weights = ()
    name: str = ""
    value_of_time: Positive | None = None
    classes: Annotated[dict[str, Probability], Field(max_length=MAX_CLASSES)] = field(default_factory=dict)
    walks_back: bool = False
    kwh: NotNegative = 0.0
    parked: Annotated[Whole, Field(le=MAX_CARS)] = 0

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
        n, u_stay = len(arrival), uniforms(key, STAY_STREAM, len(arrival))
        entries = self.entry_weights or (1.0,) * n_entries
        classes = np.zeros(n, np.int64)
        for bit, (name, share) in enumerate(self.classes.items()):
            drawn = uniforms(named_key(key, name), CLASS_STREAM, n) < share
            classes |= drawn.astype(np.int64) << bit
        charges = classes >> self.class_names.index(CHARGING) & 1 if CHARGING in self.classes else 0
        return CarPlans(
            arrival,
            rest_of_stay(self.stay, u_stay) if parked else self.stay.quantile(u_stay),
            self.patience.quantile(uniforms(key, PATIENCE_STREAM, n)),
            _choices(uniforms(key, ENTRY_STREAM, n), entries),
            _choices(uniforms(key, GOAL_STREAM, n), self.goal_weights or (1.0,)),
            uniforms(key, KIND_STREAM, n),
            np.zeros(n, np.int64),
            np.full(n, math.nan if self.value_of_time is None else self.value_of_time),
            classes,
            np.full(n, self.walks_back),
            np.full(n, self.kwh) * charges,
            np.full(n, parked),
        )


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
        names = [purpose.name for purpose in self.purposes]
        if not names or len(set(names)) < len(names):
            raise InputError(f"TownDemand.purposes are named {names}, want at least one, of different names")
        require(
            any(purpose.arrivals.max_cars for purpose in self.purposes),
            "TownDemand.purposes: nobody arrives, want a rate above 0 in the window",
        )
        for name in ("entry_weights", "goal_weights"):
            if len({len(getattr(purpose, name)) for purpose in self.purposes}) > 1:
                raise InputError(f"TownDemand.purposes: {name} are of different lengths, want one for all")
        require(
            self.max_cars <= MAX_CARS,
            f"TownDemand.purposes: {self.max_cars:,} cars, want at most {MAX_CARS:,}",
        )
        require(
            len(self.class_names) <= MAX_CLASSES,
            f"TownDemand.purposes have {len(self.class_names)} classes, want at most {MAX_CLASSES}",
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
        return tuple(dict.fromkeys(name for purpose in self.purposes for name in purpose.classes))

    @property
    def max_cars(self) -> int:
        """Maximum number of cars of a world."""
        return sum(purpose.max_cars for purpose in self.purposes)

    @property
    def expected(self) -> float:
        """Expected number of arrivals."""
        return sum(purpose.expected for purpose in self.purposes)

    def begin_s(self, arrival_s: float) -> float:
        """Return when the world begins, s of the day: with the first purpose."""
        return min(purpose.begin_s(arrival_s) for purpose in self.purposes)

    def scaled(self, factor: float) -> TownDemand:
        """Return the demand with so many times the arrivals, and the same cars parked."""
        return TownDemand(tuple(purpose.scaled(factor) for purpose in self.purposes))

    def draw(self, key: np.uint64, arrival_s: float, n_entries: int, day: ArrivalDay) -> CarPlans:
        """Draw the cars of the world with this key; see `Demand.draw`."""
        bits, drawn = {name: bit for bit, name in enumerate(self.class_names)}, []
        for number, purpose in enumerate(self.purposes):
            plans = purpose.draw(key, arrival_s, n_entries, day)
            classes = np.zeros_like(plans.classes)
            for bit, name in enumerate(purpose.classes):
                classes |= (plans.classes >> bit & 1) << bits[name]
            drawn.append(plans._replace(purpose=np.full_like(classes, number), classes=classes))
        plans = CarPlans.joined(drawn)
        plans.arrival_s[plans.parked] = self.begin_s(arrival_s)
        return plans.at(np.lexsort((~plans.parked, plans.arrival_s)))


def weights_of_all(weights: Mapping[str, FloatArray]) -> tuple[float, ...]:
    return tuple(np.sum([*weights.values()], axis=0).tolist()) if weights else ()


def _choices(u: FloatArray, weights: Sequence[float]) -> IntArray:
    if len(set(weights)) == 1:
        return (u * len(weights)).astype(np.int64)
    shares = np.cumsum(weights) / np.sum(weights)
    return np.minimum(np.searchsorted(shares, u, side="right"), len(weights) - 1).astype(np.int64)
