"""Aims and levers of a policy, as its specification names them."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_serializer, model_validator

from parkenv.errors import InputError
from parkenv.files.spec_file import Several, Spec
from parkenv.scenarios.spec import Hours, Probability
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.week import HOUR_S

Money = Annotated[float, Field(ge=0.0, le=1e6)]
Stay = Annotated[float, Field(ge=0.0, le=1e7)]


def _band(value: tuple[float, ...]) -> tuple[float, ...]:
    if not (len(value) == 2 and value[0] < value[1]):
        raise ValueError("two shares, the lower one first")
    return value


class Aims(Spec):
    """What is wanted; each aim is a number that must be reached, and what it lacks counts."""

    band: Annotated[Several[Probability], AfterValidator(_band)] = Field(
        (0.6, 0.85), description="Target range of a block's occupancy in each hour, as a mean over days."
    )
    in_band: Probability | None = Field(
        0.8, description="Target share of the block-hours in the band; 0: no aim."
    )
    hours: Hours = Field("10:00-18:00", description="Hours that count for the band.")
    cruised: float | None = Field(
        0.7, ge=0.0, le=10.0, description="Kilometres cruised, at most this multiple of today's."
    )
    time: float | None = Field(
        1.0,
        ge=0.0,
        le=10.0,
        description="Time of a car (drive, failed attempts, walk, penalties; without prices), at most this "
        "multiple of today's.",
    )
    revenue: float | None = Field(
        None, ge=0.0, le=1e3, description="Revenue, at least this multiple of today's."
    )
    loss_s: float | None = Field(
        None,
        ge=0.0,
        le=1e5,
        description="Largest loss of a purpose, prices as time, in the mean over its cars, s.",
    )

    @model_serializer
    def _with_none(self) -> dict[str, Any]:
        """Keep None, which is no aim, and not the default."""
        return {name: getattr(self, name) for name in type(self).model_fields}

    @property
    def clock(self) -> range:
        """The hours of the day that count for the band."""
        return clock_hours(ArrivalWindow.parse(self.hours))


def clock_hours(window: ArrivalWindow) -> range:
    """Return the hours of the day that a window, such as 08:00-12:00, touches; at least one."""
    first = int(window.start_s // HOUR_S)
    return range(first, max(-int(-window.end_s // HOUR_S), first + 1))


class Levers(Spec):
    """What a town may change; the first alternative of a list is what is so today."""

    zones: Several[str] = Field(
        (),
        description="Zones whose prices may change, * for any letters; those with a price for all if absent.",
    )
    by: Literal["block", "zone"] = Field(
        "block", description="Whether each block has its own price, or each zone."
    )
    hours: Several[Hours] = Field(
        ("08:00-12:00", "12:00-15:00", "15:00-18:00", "18:00-20:00"),
        min_length=1,
        description="Hours with separate prices; other hours are free of charge.",
    )
    step: float = Field(
        0.01,
        gt=0.0,
        le=1e4,
        description="Prices are multiples of this; small steps reach more of the band, see docs/policy.md.",
    )
    rule_step: Money = Field(0.25, description="Step of SFpark's rule, as in the city.")
    most: float = Field(8.0, gt=0.0, le=1e6, description="Highest price per hour.")
    spread: float = Field(0.5, gt=0.0, le=1e5, description="Spread of the first prices tried, per hour.")
    max_stay_s: dict[str, Several[Stay]] = Field(
        {}, description="Longest stays to choose from, s, by zone; 0: no limit."
    )
    users: dict[str, Several[Several[str]]] = Field(
        {}, description="Classes of drivers who may park there, to choose from, by zone."
    )
    open: dict[str, Several[str]] = Field(
        {}, description="Opening hours to choose from, by facility: 24/7, off, 'We 14:00-24:00'."
    )
    guided: Several[Probability] = Field((), description="Shares of guided drivers to choose from.")
    guidance: Literal["shared", "reserve", "full"] = Field(
        "shared", description="Information of guided drivers."
    )

    @model_validator(mode="after")
    def _bands_apart(self) -> Self:
        spans = sorted((its.start, its.stop) for its in self.bands)
        if any(end > begin for (_, end), (begin, _) in pairwise(spans)):
            raise ValueError("hours of prices that do not overlap")
        return self

    @property
    def bands(self) -> list[range]:
        """The hours of the day of each price."""
        return [clock_hours(ArrivalWindow.parse(hours)) for hours in self.hours]

    @property
    def choices(self) -> dict[str, tuple[Any, ...]]:
        """Alternatives of each lever but prices, by its name."""
        lists: dict[str, tuple[Any, ...]] = {
            f"max_stay_s.{zone}": its for zone, its in self.max_stay_s.items()
        }
        lists |= {f"users.{zone}": its for zone, its in self.users.items()}
        lists |= {f"open.{name}": its for name, its in self.open.items()}
        if self.guided:
            lists["guided"] = self.guided
        for name, its in lists.items():
            if len(its) < 2:
                raise InputError(f"levers.{name} has {len(its)} values, want at least 2, today's first")
        return lists
