"""The rules of parking from tags: price, hours when it is charged, longest stay, and who may park; as few zones.

Tags that say less than a zone needs are completed: parking with a fee but no `charge` costs `PRICE` an hour.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from parkenv.errors import InputError
from parkenv.lots.osm.rows import Side
from parkenv.world.tariff import PUBLIC, Hours, Price, Zone
from parkenv.world.week import DAY_S, HOUR_S

PRICE = 2.0  # assumed price of an hour where a fee is charged, in the currency of the town
RESERVED = {
    "loading": "delivery",
    "loading_only": "delivery",
    "delivery": "delivery",
    "charging": "charging",
    "charging_only": "charging",
    "disabled": "disabled",
    "private": "private",
    "employees": "private",
    "residents": "permit",
    "permit": "permit",
    "customers": "customers",
}
"""Class of users for each value of `access`, `parking:condition` and `restriction` that not everyone may park by."""
LONGEST_LIMIT = 24 * HOUR_S  # s; a longer `maxstay` is no limit for a day's parking
_CHARGE = re.compile(
    r"(\d+(?:[.,]\d+)?)[^\d/]{0,8}?(?:/|per)\s*(\d+(?:\.\d+)?)?\s*(h|hr|hours?|min|minutes?|days?|Stunde|Tag)\b",
    re.I,
)
_HOURS_OF = {"h": 1.0, "s": 1.0, "m": 1.0 / 60.0, "d": 24.0, "t": 24.0}
"""Hours of a unit, by its first letter."""
MOST_PER_HOUR = 1000.0  # a higher price is a mistake
_STAY = re.compile(r"(\d+(?:[.,]\d+)?)\s*(h|hr|hour|hours|m|min|minute|minutes)\b", re.I)
_HOURS = re.compile(r"[A-Z][a-z](?:[-,][A-Z][a-z])*\s+\d?\d:\d\d-\d?\d:\d\d")


@dataclass(frozen=True)
class Rules:
    """What tags say of parking somewhere; equal rules are one zone of a kind of facility."""

    users: str = PUBLIC
    per_hour: float = 0.0
    charged: str = ""  # hours, as OpenStreetMap writes them; empty: always
    max_stay_s: float | None = None
    assumed: bool = False  # whether the price is
    by_day: bool = False  # whether a day costs 24 `per_hour`, however short the stay
    hours: str = ""  # when it is open, as OpenStreetMap writes it; empty: always

    def zone(self, kind: str) -> Zone:
        """Return the zone of a kind of facility with these rules, named after them."""
        words = [kind]
        if self.users != PUBLIC:
            words.append(self.users)
        if self.per_hour:
            each = f"{24 * self.per_hour:g}/day" if self.by_day else f"{self.per_hour:g}/h"
            words.append("paid" if self.assumed else each)
            words += [self.charged] if self.charged else []
        elif self.users == PUBLIC:
            words.append("free")
        if self.max_stay_s is not None:
            words.append(f"{self.max_stay_s / 60:g} min")
        words += [f"open {self.hours}"] if self.hours else []
        charged = Hours.parse(self.charged) if self.charged and self.per_hour else None
        day = ((DAY_S, 24 * self.per_hour),) if self.by_day else ()
        price = Price(self.per_hour, day, charged=charged)
        hours = Hours.parse(self.hours) if self.hours else None
        return Zone(" ".join(words), price, hours, self.max_stay_s, (self.users,))


def rules_of(tags: Mapping[str, str]) -> Rules:
    """Return the rules of a car park, a garage or a drawn space."""
    users = RESERVED.get(tags.get("parking_space", ""), RESERVED.get(tags.get("access", ""), PUBLIC))
    rules = _rules(
        users, tags.get("fee"), tags.get("charge"), tags.get("fee:conditional"), tags.get("maxstay")
    )
    return replace(rules, hours=_open_hours(tags.get("opening_hours", "")))


def kerb_rules(tags: Mapping[str, str], side: Side) -> Rules:
    """Return the rules of one side of a street, of either tagging scheme."""

    def tag(key: str) -> str | None:
        return tags.get(key.format(side), tags.get(key.format("both")))

    condition = tag("parking:condition:{}") or ""
    user = next(
        (
            RESERVED[value]
            for value in (
                tag("parking:{}:restriction"),
                tag("parking:{}:access"),
                *re.split(r"[;,]", condition),
                tag("parking:lane:{}"),
            )
            if value in RESERVED
        ),
        PUBLIC,
    )
    # Where a ticket or a permit is wanted, everyone may park.
    if user == "permit" and re.search(r"ticket|free|disc", condition):
        user = PUBLIC
    fee = tag("parking:{}:fee")
    if fee is None and ("ticket" in condition or (not condition and "parking:ticket:zone" in tags)):
        fee = "yes"
    interval = tag("parking:condition:{}:time_interval") if fee == "yes" else None
    return _rules(
        user,
        fee,
        tag("parking:{}:charge"),
        tag("parking:{}:fee:conditional") or (f"yes @ ({interval})" if interval else None),
        tag("parking:{}:maxstay") or tag("parking:condition:{}:maxstay"),
    )


def _rules(
    users: str, fee: str | None, charge: str | None, conditional: str | None, maxstay: str | None
) -> Rules:
    per_hour, assumed, charged, by_day = 0.0, False, "", False
    if charge is not None and (match := _CHARGE.search(charge)):
        unit = match[3][0].lower()
        spans, by_day = float(match[2] or 1.0) * _HOURS_OF[unit], unit in "dt"
        per_hour = float(match[1].replace(",", ".")) / spans if spans else 0.0
        per_hour = per_hour if per_hour <= MOST_PER_HOUR else 0.0
    elif (fee or "no").lower() not in ("no", "free", "unknown") or (conditional or "").startswith("yes"):
        per_hour, assumed = PRICE, True
    if per_hour:
        charged = _known_hours(fee) or _known_hours(conditional) or _known_hours(charge)
    stay = None
    if maxstay is not None and (match := _STAY.search(maxstay)):
        seconds = float(match[1].replace(",", ".")) * (HOUR_S if match[2].lower().startswith("h") else 60.0)
        stay = seconds if 0.0 < seconds < LONGEST_LIMIT else None
    return Rules(
        users, round(per_hour, 4 if by_day else 2), charged, stay, assumed, by_day and per_hour > 0.0
    )


def _open_hours(text: str) -> str:
    """Return opening hours in their shortest form, but for holidays; empty if always, or if they cannot be read."""
    try:
        hours = Hours.parse(re.sub(r"[;,]?\s*(PH|SH)\b[^;]*", "", text).strip("; "))
    except InputError:
        return ""
    return "" if hours == Hours.parse("24/7") or not any(hours.days) else str(hours)


def _known_hours(text: str | None) -> str:
    """Return the hours within a text, in their shortest form; empty if there are none that can be read."""
    found = "; ".join(_HOURS.findall(text or ""))
    try:
        return str(Hours.parse(found)).removesuffix("; Sa,Su off").removesuffix("; Su off") if found else ""
    except InputError:
        return ""


def zones_of(used: Iterable[tuple[str, Rules]]) -> dict[str, Zone]:
    """Return the zones of kinds of facilities with their rules, by name."""
    zones = (rules.zone(kind) for kind, rules in dict.fromkeys(used))
    return {zone.name: zone for zone in zones}
