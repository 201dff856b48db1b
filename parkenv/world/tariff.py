"""Zones of a lot: who may park there, when and for how long, and what it costs by stay and clock time."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import pairwise
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import AfterValidator, Field, InstanceOf

from parkenv.compiled.arrays import BoolArray, FloatArray
from parkenv.errors import InputError, naming, nearest, require, require_number
from parkenv.files.field_types import Name, NotNegative, Positive, Validated
from parkenv.world.week import DAY_S, HOUR_S, WEEK_S

NO_ZONE = "other"  # zone of the slots for which a lot names none
PUBLIC = "public"  # the class of users that every driver belongs to
VALUE_OF_TIME = 12.0
"""Default value of an hour of a driver's time, in the currency of the prices.

The US Department of Transportation values local personal travel at half of the household income: 13.60 dollars of 2015,
12.3 euros (Revised Departmental Guidance on Valuation of Travel Time in Economic Analysis, 2016).
"""
DAYS = ("Mo", "Tu", "We", "Th", "Fr", "Sa", "Su")
_RULE = re.compile(r"(?:(?P<days>[A-Z][a-z](?:[-,][A-Z][a-z])*) +)?(?P<times>off|\d?\d:\d\d-\d.*)")
_SPAN = re.compile(r"(\d?\d):(\d\d)-(\d?\d):(\d\d)")


@dataclass(frozen=True)
class Hours:
    """Hours of the week.

    Examples:
        >>> hours = Hours.parse("Mo-Fr 08:00-18:00; Sa 09:00-13:00")
        >>> float(hours.within(0.0, 2 * 86400.0)) / 3600
        20.0
    """

    # for each day from Monday on, pairs of begin and end, minutes since midnight
    days: tuple[tuple[tuple[int, int], ...], ...]

    @classmethod
    def parse(cls, text: object, field: str = "hours") -> Hours:
        """Read hours in OpenStreetMap's notation: `Mo-Fr 08:00-12:00,13:00-18:00; Sa 09:00-13:00`, or `24/7`.

        A rule without days is for all of them, `off` empties its days, and a later rule replaces earlier ones on its
        days. A span across midnight is written as two. Messages call the hours as `field` says.
        """
        days: list[tuple[tuple[int, int], ...]] = [()] * 7
        for rule in str(text).replace("24/7", "00:00-24:00").split(";"):
            match = _RULE.fullmatch(rule.strip())
            if match is None or not isinstance(text, str):
                raise InputError(f"{field} is {text!r:.40}, want hours such as 'Mo-Sa 08:00-20:00'")
            spans = () if match["times"] == "off" else _spans(match["times"], field)
            for day in _days(match["days"] or "Mo-Su", field):
                days[day] = spans
        return cls(tuple(days))

    def __str__(self) -> str:
        # Days with equal hours share a rule; `parse` reads the text back.
        by_spans: dict[tuple[tuple[int, int], ...], list[str]] = {}
        for name, spans in zip(DAYS, self.days, strict=True):
            by_spans.setdefault(spans, []).append(name)
        rules = []
        for spans, names in by_spans.items():
            times = ",".join(f"{a // 60:02}:{a % 60:02}-{b // 60:02}:{b % 60:02}" for a, b in spans) or "off"
            run = len(names) > 2 and list(DAYS[DAYS.index(names[0]) :][: len(names)]) == names
            rules.append(f"{f'{names[0]}-{names[-1]}' if run else ','.join(names)} {times}")
        return "; ".join(rules)

    @cached_property
    def _week(self) -> tuple[FloatArray, FloatArray]:
        spans = [(DAY_S * d + 60.0 * a, DAY_S * d + 60.0 * b) for d in range(7) for a, b in self.days[d]]
        edges = np.array([0.0, *(t for span in spans for t in span), WEEK_S])
        open_s = np.diff(edges)
        open_s[::2] = 0.0
        return edges, np.r_[0.0, np.cumsum(open_s)]

    def within(self, begin_s: ArrayLike, stay_s: ArrayLike) -> FloatArray:
        """Return how many s of stays, (...) s, fall into these hours; begins are s since Monday 00:00."""
        edges, before = self._week
        begin, stay = np.asarray(begin_s, np.float64), np.asarray(stay_s, np.float64)
        known = np.where(np.isfinite(stay), stay, 0.0)

        def until(time: FloatArray) -> FloatArray:
            weeks, rest = np.divmod(time, WEEK_S)
            return np.asarray(weeks * before[-1] + np.interp(rest, edges, before))

        endless = np.inf if before[-1] else 0.0
        return np.where(np.isfinite(stay), until(begin + known) - until(begin), endless)


def _days(text: str, field: str) -> list[int]:
    days = []
    for part in text.split(","):
        names = part.split("-")
        for name in names:
            require(name in DAYS, f"{field} has the day {name!r}, want one of {', '.join(DAYS)}")
        first, last = DAYS.index(names[0]), DAYS.index(names[-1])
        days += [(first + k) % 7 for k in range((last - first) % 7 + 1)]
    return days


def _spans(text: str, field: str) -> tuple[tuple[int, int], ...]:
    spans = []
    for part in text.split(","):
        match = _SPAN.fullmatch(part.strip())
        h, m, end_h, end_m = map(int, match.groups()) if match else (0, 60, 0, 60)
        begin, end = 60 * h + m, 60 * end_h + end_m
        if max(m, end_m) > 59 or max(begin, end) > 24 * 60 or end <= begin:
            raise InputError(
                f"{field} has {part!r:.40}, want an end after the begin, such as 08:00-20:00; write two spans across "
                "midnight"
            )
        spans.append((begin, end))
    spans.sort()
    for (_, end), (begin, _) in pairwise(spans):
        require(begin >= end, f"{field} has {text!r:.40}, want spans that do not overlap")
    return tuple(spans)


def _rising(steps: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    for (stay_s, price), (before_s, least) in zip(steps, ((0.0, 0.0), *steps), strict=False):
        if stay_s <= before_s or price < least:
            raise ValueError("pairs of a stay in seconds and a price; stays rise, and prices must not fall")
    return steps


@dataclass(frozen=True)
class Price(Validated):
    """What a stay costs, in any currency.

    Examples:
        >>> price = Price(steps=((3600.0, 1.0), (7200.0, 3.0)), per_hour=2.0, daily_cap=8.0)
        >>> price.amount(0.0, np.array([1800.0, 7200.0, 10800.0, 86400.0])).tolist()
        [1.0, 3.0, 5.0, 8.0]
    """

    per_hour: NotNegative = 0.0  # price of an hour; with steps, of each hour beyond the last one
    # pairs of a stay, s, and the price of stays up to it, both increasing: a ticket machine's table
    steps: Annotated[tuple[tuple[NotNegative, NotNegative], ...], AfterValidator(_rising)] = ()
    free_s: NotNegative = 0.0  # s, first charged seconds of a stay that cost nothing
    # the most that 24 hours from the begin of the stay cost; with it, each 24 hours are a stay of their own
    daily_cap: NotNegative | None = None
    charged: Hours | None = None  # hours when parking is charged; only they count as stay. None: always.
    per_kwh: NotNegative = 0.0  # price of each kWh charged into the car, on top
    # pairs of hours, which do not overlap, and the price of an hour then, instead of `per_hour`, `steps`, `free_s`
    # and `charged`; other hours are free
    hourly: tuple[tuple[InstanceOf[Hours], NotNegative], ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.hourly and (self.per_hour or self.steps or self.free_s or self.charged):
            raise InputError("hourly is given, want neither per_hour, steps, free_s nor charged beside it")
        for day, name in enumerate(DAYS):
            spans = sorted(span for hours, _ in self.hourly for span in hours.days[day])
            if any(end > begin for (_, end), (begin, _) in pairwise(spans)):
                raise InputError(f"hourly has two prices at a time on {name}, want hours that do not overlap")

    @classmethod
    def parse(cls, given: Any, field: str = "price") -> Price:
        """Read a price: a number or a text such as `2/h`, prices by hours as OpenStreetMap writes them, or members.

        Examples:
            >>> price = Price.parse("1 @ 08:00-12:00; 3 @ Mo-Sa 12:00-15:00")
            >>> price.amount([9 * 3600.0, 11 * 3600.0], 2 * 3600.0).tolist()
            [2.0, 4.0]
            >>> Price.parse({"per_hour": 2, "charged": "Mo-Fr 08:00-18:00"}) == Price.parse("2/h")
            False
        """
        if type(given) in (int, float):
            return cls(float(given))
        if isinstance(given, str):
            if "@" not in given and not given.startswith("+"):  # of a tariff alone
                return cls(_per_hour(given, field, given))
            parts = (part.partition("@") for part in given.split(";"))
            return cls(
                hourly=tuple(
                    (Hours.parse(hours.strip(), field), _per_hour(amount, field, given))
                    for amount, _, hours in parts
                )
            )
        members = members_of(given, [f.name for f in fields(cls)], field)
        if "charged" in members:
            members["charged"] = Hours.parse(members["charged"], "charged")
        if "hourly" in members:
            members["hourly"] = cls.parse(str(members["hourly"]), "hourly").hourly
        return cls(**members)

    def members(self) -> dict[str, Any]:
        members = {f.name: value for f in fields(self) if (value := getattr(self, f.name)) != f.default}
        if self.charged is not None:
            members["charged"] = str(self.charged)
        if self.hourly:
            members["hourly"] = "; ".join(f"{amount:.12g} @ {hours}" for amount, hours in self.rules)
        return members

    @property
    def rules(self) -> list[tuple[float, str]]:
        rules = ((price, rule) for hours, price in self.hourly for rule in str(hours).split("; "))
        return [(price, rule) for price, rule in rules if not rule.endswith(" off")]

    def __bool__(self) -> bool:
        amounts = (price for _, price in (*self.steps, *self.hourly))
        return any((self.per_hour, self.per_kwh, *amounts))

    def raised(self, per_hour: float) -> Price:
        if self.hourly:
            return replace(self, hourly=tuple((hours, price + per_hour) for hours, price in self.hourly))
        steps = tuple((stay_s, price + per_hour * stay_s / HOUR_S) for stay_s, price in self.steps)
        beyond = self.per_hour + per_hour if self.per_hour or not steps else 0.0
        return replace(self, per_hour=beyond, steps=steps)

    def amount(self, begin_s: ArrayLike, stay_s: ArrayLike, kwh: ArrayLike = 0.0) -> FloatArray:
        """Return what stays cost, (...); they are (...) s, may be infinite, and begin at s since Monday 00:00."""
        begin, stay = np.broadcast_arrays(np.asarray(begin_s, np.float64), np.asarray(stay_s, np.float64))
        if self.daily_cap is None:
            cost = self._of(begin, stay)
        else:
            known = np.where(np.isfinite(stay), stay, 0.0)
            weeks, rest = np.divmod(known, WEEK_S)
            week = self._of_days(begin, np.full_like(stay, WEEK_S))
            cost = np.where(weeks > 0.0, weeks * week, 0.0) + self._of_days(begin, rest)
            cost = np.where(np.isfinite(stay), cost, np.where(week > 0.0, np.inf, 0.0))
        return np.asarray(cost + self.per_kwh * np.asarray(kwh) if self.per_kwh else cost)

    def of_hours(self, seconds: Mapping[Hours, FloatArray]) -> FloatArray:
        # A stay for ever is free where an hour is.
        stays = ((np.where(price, seconds[hours], 0.0), price) for hours, price in self.hourly)
        return np.asarray(sum(stay * (price / HOUR_S) for stay, price in stays))

    def _of_days(self, begin: FloatArray, stay: FloatArray) -> FloatArray:
        cap = np.inf if self.daily_cap is None else self.daily_cap
        days = range(math.ceil(float(np.max(stay, initial=0.0)) / DAY_S))
        parts = [self._of(begin + DAY_S * k, np.clip(stay - DAY_S * k, 0.0, DAY_S)) for k in days]
        return np.asarray(sum(np.minimum(part, cap) for part in parts) + np.zeros_like(stay))

    def _of(self, begin: FloatArray, stay: FloatArray) -> FloatArray:
        if self.hourly:
            return self.of_hours({hours: hours.within(begin, stay) for hours, _ in self.hourly})
        charged = stay if self.charged is None else self.charged.within(begin, stay)
        charged = np.maximum(charged - self.free_s, 0.0)
        if not self.steps:
            # A stay for ever is free where an hour is.
            return charged / HOUR_S * self.per_hour if self.per_hour else np.zeros_like(charged)
        until, price = np.array(self.steps, np.float64).T
        row = np.minimum(np.searchsorted(until, charged), len(until) - 1)
        beyond = np.maximum(charged - until[-1], 0.0) / HOUR_S * self.per_hour if self.per_hour else 0.0
        return np.where(charged > 0.0, price[row] + beyond, 0.0)


@dataclass(frozen=True)
class Zone(Validated):
    """The rules of a zone: its price, and who may park there, when and for how long."""

    name: str  # its name
    price: Price = field(default_factory=Price)  # what stays cost
    hours: Hours | None = None  # when cars may be parked there; a stay must lie within. None: always.
    max_stay_s: Positive | None = None  # s, longest stay; where the price has charged hours, only these count
    # classes of users, one of which a driver must belong to: `public` (everyone), or names such as `permit-a`,
    # `disabled`, `charging`, `customers`, `delivery`, `private`
    users: Annotated[tuple[Annotated[Name, Field(min_length=1)], ...], Field(min_length=1)] = (PUBLIC,)

    def admits(self, begin_s: ArrayLike, stay_s: ArrayLike) -> BoolArray:
        begin, stay = np.broadcast_arrays(np.asarray(begin_s, np.float64), np.asarray(stay_s, np.float64))
        allowed = np.ones(stay.shape, bool)
        if self.hours is not None:
            # A tolerance for rounding: a millisecond.
            allowed &= self.hours.within(begin, stay) >= stay - 1e-3
        if self.max_stay_s is not None:
            counted = stay if self.price.charged is None else self.price.charged.within(begin, stay)
            allowed &= counted <= self.max_stay_s
        return allowed


@dataclass(frozen=True)
class Tariff:
    """Prices per hour that replace those of a lot's zones, or are added to them."""

    # price of an hour by zone, at least 0, in any currency; a text such as `+1` is added to what an hour of the zone
    # costs, with its hours and steps as they are; other texts are read by `Price.parse`. A name may have `*` for any
    # letters: that of all such zones that cost something. The first name of a zone counts; other zones keep their
    # prices.
    per_hour: Mapping[str, float | str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for zone, price in self.per_hour.items():
            with naming(f"price of zone {zone!r:.40}"):
                parse_change(price)
        object.__setattr__(self, "per_hour", MappingProxyType(dict(self.per_hour)))

    def __bool__(self) -> bool:
        return bool(self.per_hour)

    def __reduce__(self) -> tuple[type[Tariff], tuple[dict[str, float | str]]]:
        return Tariff, (dict(self.per_hour),)

    def priced(self, zone: Zone) -> Zone:
        price = next((price for name, price in self.per_hour.items() if _means(name, zone)), None)
        if price is None:
            return zone
        given, is_added = parse_change(price)
        return replace(zone, price=zone.price.raised(given.per_hour) if is_added else given)

    def require_zones(self, zones: Sequence[Zone], lot: str) -> None:
        for name in self.per_hour:
            if not any(_means(name, zone) for zone in zones):
                near = nearest(name, [zone.name for zone in zones])
                what = "paid zone" if "*" in name else "zone"
                raise InputError(f"price: lot {lot!r:.40} has no {what} {name!r:.40}; {near}")


def parse_change(given: float | str) -> tuple[Price, bool]:
    """Return the price of a tariff, and whether it is added to that of a zone, as a text such as `+1/h` says."""
    is_added = isinstance(given, str) and given.startswith("+") and "@" not in given
    return Price.parse(str(given)[1:] if is_added else given), is_added


def _per_hour(text: str, field: str, whole: str) -> float:
    try:
        require_number(field, amount := float(text.strip().removesuffix("/h")), least=0.0)
        return amount
    except ValueError:
        raise InputError(
            f"{field} is {whole!r:.60}, want an amount such as 2/h, one that is added, such as +1/h, or amounts by "
            "hours, such as 1.5 @ 08:00-12:00"
        ) from None


def members_of(given: Any, known: Collection[str], what: str) -> dict[str, Any]:
    if not isinstance(given, dict):
        raise InputError(f"{what} is {given!r:.40}, want an object with some of {', '.join(known)}")
    for name in given:
        if name not in known:
            raise InputError(f"no member {name!r:.40} of {what}; {nearest(name, known)}")
    return dict(given)


def _means(name: str, zone: Zone) -> bool:
    """Whether a name is that of a zone, or one with `*` for all zones like it that cost something."""
    parts = [re.escape(part) for part in name.split("*")]
    return name == zone.name or (
        len(parts) > 1 and bool(zone.price) and bool(re.fullmatch(".*".join(parts), zone.name))
    )
