"""Specification of the demand of a scenario: the tables `[demand.NAME]`, one for each purpose of drivers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, WithJsonSchema

from parkenv.errors import InputError, naming, nearest
from parkenv.files.known_names import MAX_CARS
from parkenv.files.spec_file import Several, Spec
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.tariff import PUBLIC
from parkenv.world.week import DAY_HOURS

if TYPE_CHECKING:  # help and completion read fields alone
    from parkenv.world.demand import Arrivals, Duration, TownDemand
    from parkenv.world.lot import ParkingLot

MAX_RATE = 1e6  # maximum number of cars an hour
_RATES = f"a number from 0 to {MAX_RATE:g}, or {DAY_HOURS} of these, one for each hour of the day"


def _rates(value: object) -> object:
    numbers: list[Any] = list(value) if isinstance(value, list | tuple) else [value] * DAY_HOURS
    if len(numbers) != DAY_HOURS:
        raise ValueError(_RATES)
    for hour, rate in enumerate(numbers):
        if isinstance(rate, bool) or not isinstance(rate, int | float) or not 0.0 <= rate <= MAX_RATE:
            raise ValueError(f"{_RATES}" + (f": hour {hour} has {rate!r:.40}" if value is not rate else ""))
    return tuple(map(float, numbers))


_RATE = {"type": "number", "minimum": 0, "maximum": MAX_RATE}
Rates = Annotated[
    tuple[float, ...],
    BeforeValidator(_rates),
    WithJsonSchema(
        {"anyOf": [_RATE, {"type": "array", "items": _RATE, "minItems": DAY_HOURS, "maxItems": DAY_HOURS}]}
    ),
]
Weights = Several[Annotated[float, Field(ge=0.0, le=1e12)]]


def _purpose(value: str) -> str:
    if not 0 < len(value) <= 80 or not value.isprintable():
        raise ValueError("a name of 1 to 80 printable characters")
    return value


PurposeName = Annotated[str, AfterValidator(_purpose)]


class PurposeSpec(Spec):
    """Drivers with one purpose: when they arrive, how long they stay, where they go, and what they may and mind."""

    arrivals_per_hour: Rates = Field(
        description="Cars an hour, one number or 24, one for each hour of the day."
    )
    stay_s: float = Field(3600.0, ge=1.0, le=1e7, description="Mean stay.")
    stay_law: Literal["exponential", "log-normal", "constant"] = "exponential"
    stay_cv: float = Field(1.0, gt=0.0, le=10.0, description="Coefficient of variation of log-normal stays.")
    value_of_time: float | None = Field(
        None,
        gt=0.0,
        le=1e6,
        description="Value of an hour of the drivers' time, in the currency of the prices; that of `costs` if "
        "absent.",
    )
    classes: dict[str, Annotated[float, Field(ge=0.0, le=1.0)]] = Field(
        {}, description="Share of the drivers of each class, for example permit-a, disabled or charging."
    )
    walks_back: bool = Field(False, description="Whether the walk back to the car counts, too.")
    patience_s: float = Field(
        600.0,
        gt=0.0,
        le=1e7,
        description="Search time, without the drive to the goal, after which cars go elsewhere.",
    )
    kwh: float = Field(0.0, ge=0.0, le=1e3, description="Energy that a car of the class charging takes, kWh.")
    parked: int = Field(0, ge=0, le=MAX_CARS, description="Cars that are parked when the hours begin.")
    goals: Weights = Field(
        (), description="Weight of each goal of the lot; those of the lot for this purpose if absent."
    )
    entries: Weights = Field(
        (), description="Weight of each entry of the lot; those of the lot for this purpose if absent."
    )

    @property
    def stay(self) -> Duration:
        from parkenv.world.demand import ConstantTime, ExponentialTime, LogNormalTime

        if self.stay_law == "log-normal":
            return LogNormalTime(self.stay_s, self.stay_cv)
        return (ConstantTime if self.stay_law == "constant" else ExponentialTime)(self.stay_s)

    def arrivals(self, window: ArrivalWindow) -> Arrivals:
        from parkenv.world.demand import NoArrivals, PoissonArrivals

        start, end = int(window.start_s // 3600), math.ceil(window.end_s / 3600)
        if not any(self.arrivals_per_hour[start:end]):
            return NoArrivals(window.start_s)
        return PoissonArrivals(self.arrivals_per_hour, window.start_s, window.end_s)


def demand_of(
    purposes: Mapping[str, PurposeSpec], lot: ParkingLot, window: ArrivalWindow
) -> TownDemand | None:
    """Return the demand of the tables of a scenario; None if there are none.

    A purpose that the lot has no weights for has the sum of those for its purposes; where the lot has none at all, all
    weights are equal if another table has weights, or else goal and entry are those of the scenario.
    """
    from parkenv.world.demand import ConstantTime, Demand, TownDemand, weights_of_all

    if not purposes:
        return None
    if window.end_s <= window.start_s:
        raise InputError("arrivals.hours are one time, want hours in which the cars of `demand` arrive")
    ends = {"goals": (lot.goals, lot.goal_weights), "entries": (lot.entries, lot.entry_weights)}
    defaults: dict[str, tuple[float, ...]] = {}
    for field, (points, of_lot) in ends.items():
        some = any(getattr(spec, field) for spec in purposes.values())
        defaults[field] = weights_of_all(of_lot) or ((1.0,) * len(points) if some else ())
    users = {zone.name: zone.users for zone in lot.zone_rules.values()}
    spaces = [
        (users.get(zone, (PUBLIC,)), int(lot.capacity[lot.zone_of_slot == k].sum()))
        for k, zone in enumerate(lot.zones)
    ]
    demands = []
    for name, spec in purposes.items():
        table = f"demand.{name}"
        for user in (user for user in spec.classes if user not in lot.classes[1:]):
            raise InputError(
                f"{table}.classes has {user!r:.40}, no class of lot {lot.name!r:.40} beside {PUBLIC}; "
                f"{nearest(user, lot.classes[1:])}"
            )
        room = sum(n for may, n in spaces if PUBLIC in may or set(may) & set(spec.classes))
        if spec.parked > room:
            raise InputError(
                f"{table}.parked is {spec.parked}, want at most the {room:,} spaces that it may use"
            )
        weights: dict[str, tuple[float, ...]] = {}
        for field, (points, of_lot) in ends.items():
            weights[field] = own = getattr(spec, field) or tuple(of_lot.get(name, defaults[field]))
            if own and len(own) != len(points):
                raise InputError(
                    f"{table}.{field} has {len(own)} numbers, the lot has {len(points)} of these"
                )
        rest = spec.model_dump(include={"value_of_time", "classes", "walks_back", "kwh", "parked"})
        laws = spec.arrivals(window), spec.stay, ConstantTime(spec.patience_s)
        with naming(table):
            demands.append(Demand(*laws, weights["entries"], weights["goals"], name=name, **rest))
    with naming("demand"):
        return TownDemand(tuple(demands))
