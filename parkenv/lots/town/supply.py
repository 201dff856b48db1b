"""Rules, capacities and facilities of a town's parking, from tags and from a city's list of car parks.

Tags that say less than a zone needs are completed: parking with a fee but no `charge` costs `PRICE` an hour.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.files.csv_tables import TEXT, WHOLE, Kind, typed_records
from parkenv.files.file_names import is_plain
from parkenv.files.limited_reading import require_file
from parkenv.lots.draft import LotDraft
from parkenv.lots.generators import NO_SLOTS, Slots
from parkenv.lots.osm.rows import Side
from parkenv.world.facility import Facility
from parkenv.world.tariff import PUBLIC, Hours, Price, Zone, charge_in
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
    users = RESERVED.get(tags.get("parking_space", ""), RESERVED.get(tags.get("access", ""), PUBLIC))
    rules = _rules(
        users, tags.get("fee"), tags.get("charge"), tags.get("fee:conditional"), tags.get("maxstay")
    )
    return replace(rules, hours=_open_hours(tags.get("opening_hours", "")))


def kerb_rules(tags: Mapping[str, str], side: Side) -> Rules:
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
    if charge is not None and (known := charge_in(charge)) is not None:
        per_hour, by_day = known
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
    zones = (rules.zone(kind) for kind, rules in dict.fromkeys(used))
    return {zone.name: zone for zone in zones}


class AreaRule(NamedTuple):
    """Places by area: `places_of_square_metre` · (area · levels) ^ `power`.

    Attributes:
        places_of_square_metre: how many places an area of 1 m² had.
        power: below 1 where large car parks need more ways.
        levels: number of levels where the tags do not say it.
        typical: places of one whose area is unknown.
    """

    places_of_square_metre: float
    power: float
    levels: float
    typical: int


RULES = {
    "surface": AreaRule(0.1847, 0.7882, 1.0, 7),
    "boxes": AreaRule(0.0574, 1.0, 1.0, 4),
    "underground": AreaRule(0.0346, 1.0, 1.0, 30),
    "multi-storey": AreaRule(0.0377, 1.0, 4.7, 350),
    "rooftop": AreaRule(0.0342, 1.0, 1.0, 45),
}
"""Rule of each kind; fitted by `python tests/parking_rules.py`, which states the errors."""
KINDS = {
    **dict.fromkeys(("garage", "garages", "garage_boxes", "carport", "carports", "sheds"), "boxes"),
    **{"underground": "underground", "multi-storey": "multi-storey", "rooftop": "rooftop"},
}
"""Rule for each value of `parking`; `surface` for others."""
GARAGES = ("underground", "multi-storey", "rooftop")  # rules of what is a garage: it has a barrier and ramps


def rule_of(tags: Mapping[str, str]) -> str:
    """Return the name of the rule, a key of `RULES`, for a car park with these tags."""
    if "parking" not in tags and tags.get("building") == "parking":
        return "multi-storey"
    return KINDS.get(tags.get("parking", "surface"), "surface")


def levels_of(tags: Mapping[str, str]) -> float | None:
    for key in ("parking:levels", "building:levels", "levels"):
        match = re.fullmatch(r"\s*(\d{1,2})(?:\.\d+)?\s*", tags.get(key, ""))
        if match and int(match[1]):
            return float(match[1])
    return None


def expected_capacity(rule: str, area: float | None, levels: float | None) -> int:
    """Return the number of places by a rule of `RULES`, at least 1; the area (of a level, m²) may be unknown."""
    a = RULES[rule]
    if area is None:
        return a.typical
    expected = a.places_of_square_metre * float(area * (levels or a.levels)) ** a.power
    return max(int(expected + 0.5), 1)


GATE_S = 10.0  # s that the barrier of a garage takes for a car
INSIDE_S = {"garage": (30.0, 120.0), "lot": (10.0, 30.0)}
"""Seconds from the entry of a counted facility to a space, when it is empty and when it is full."""
TABLE = ("name", "kind", "capacity", "capacity_from", "rule", "zone", "slots", "tagged", "element")
"""Columns of the table of facilities: `capacity_from` is tag, drawn, list or rule, `rule` which one; `slots` of the
capacity are drawn, the others counted; `tagged` is what the tags say; `element` is the way or node, of a kerb with its
side."""


@dataclass(eq=False)
class FacilityRow:
    """A facility: its line in the table, its rules, and what makes it."""

    name: str
    kind: str
    rules: Rules
    capacity_from: str  # `tag`, `drawn`, `rule` or `list`
    rule: str  # which rule
    element: str  # of the map; of a kerb with its side
    tagged: int | None = None  # number of places that the tags say
    slots: Slots = NO_SLOTS  # drawn ones
    slot_rules: list[Rules] = field(default_factory=list)
    counted: list[tuple[str, int, Rules]] = field(
        default_factory=list
    )  # name, places, rules of counted parts
    xy: tuple[float, float] | None = None


def facilities_of(row: FacilityRow, filled: set[str]) -> Iterator[Facility]:
    if len(row.slots) and row.name in filled:
        yield Facility(row.name, row.kind, row.rules.zone(row.kind).name)
    for name, capacity, rules in row.counted if row.xy is not None else ():
        yield Facility(
            name,
            row.kind,
            rules.zone(row.kind).name,
            capacity,
            row.xy,
            GATE_S if row.kind == "garage" else 0.0,
            INSIDE_S.get(row.kind, INSIDE_S["lot"]),
            "sign" if row.kind == "garage" else "nothing",
        )


def table_of(rows: Sequence[FacilityRow], draft: LotDraft) -> list[dict[str, Any]]:
    names, count = np.unique(draft.slots.facility, return_counts=True)
    slots = dict(zip(names.tolist(), count.tolist(), strict=True))
    counted = {facility.name: facility.capacity for facility in draft.facilities}
    table = []
    for row in rows:
        places = slots.get(row.name, 0) + sum(counted.get(name, 0) for name, _, _ in row.counted)
        if places:
            more = {
                "capacity": places,
                "zone": row.rules.zone(row.kind).name,
                "slots": slots.get(row.name, 0),
            }
            table.append({name: more[name] if name in more else getattr(row, name) for name in TABLE})
    return table


NEAR = 100.0  # m, from a car park of the list to the entry of the facility that it is
SAME_NAME = 4.0  # so many times as far if they share a word that few of the list have
_SIMILAR = 3.0  # largest ratio of the capacities of facilities that share no word


class ListedCarPark(NamedTuple):
    """A car park of a list: its capacity (0: not stated) and position, degrees."""

    name: str
    capacity: int
    lat: float
    lon: float


def _name(text: str) -> str:
    if not (0 < len(text) <= 80 and is_plain(text)):
        raise ValueError(text)
    return text


def _capacity(text: str) -> int:
    if len(text) > 6:
        raise ValueError(text)
    return int(WHOLE.parse(text or "0"))


def _degrees(most: float) -> Kind:
    def parse(text: str) -> float:
        if not abs(float(text)) <= most:
            raise ValueError(text)
        return float(text)

    return Kind(f"degrees from {-most:g} to {most:g}", parse)


_COLUMNS = {
    "name": Kind("a printable name of 1 to 80 letters", _name),
    "capacity": Kind("a whole number of up to 6 digits, or nothing", _capacity),
    "lat": _degrees(90.0),
    "lon": _degrees(180.0),
}


def read_listed(path: Path) -> list[ListedCarPark]:
    """Read a list of car parks, a CSV file with the columns name, capacity, lat and lon; others are not read."""
    require_file(path)
    found: dict[str, ListedCarPark] = {}
    for line, row in typed_records(path, lambda name: _COLUMNS.get(name, TEXT)):
        if missing := [name for name in _COLUMNS if name not in row]:
            raise InputError(f"{path}: has no column {missing[0]}, want {','.join(_COLUMNS)}")
        if row["name"] in found:
            raise InputError(
                f"{path}: line {line}: name is {row['name']!r:.40}, want one that no other line has"
            )
        found[row["name"]] = ListedCarPark(*(row[name] for name in _COLUMNS))
    if not found:
        raise InputError(f"{path}: has no car park, want a line for each")
    return list(found.values())


def matched(
    listed: list[ListedCarPark], at: FloatArray, names: list[str], capacity: FloatArray, xy: FloatArray
) -> NDArray[np.int64]:
    """Return which facility each car park of a list is, (k,) index, -1: none; each is at most one.

    It is one within `NEAR` of about the same capacity, or one whose name shares a word with it within `SAME_NAME` times
    as far; words that many of the list have, such as *garage*, do not count. In all, distances are as small as can be.
    The car parks are at `at`, (k, 2) m; facilities are entered at `xy`, (n, 2) m.
    """
    words = [set(_words(one.name)) for one in listed]
    use = Counter(word for mine in words for word in mine)
    rare = [{word for word in mine if use[word] <= max(len(listed) // 4, 1)} for mine in words]
    shared = np.array([[bool(mine & set(_words(name))) for name in names] for mine in rare])
    ratio = np.array([[max(one.capacity, 1)] for one in listed]) / np.maximum(capacity, 1.0)
    away = np.hypot(*(at[:, None] - xy).transpose(2, 0, 1))
    away = np.where(shared, away / SAME_NAME, away)
    stated = np.array([[one.capacity > 0] for one in listed])
    unlike = ~shared & stated & (np.maximum(ratio, 1.0 / ratio) > _SIMILAR)
    cost = np.where((away > NEAR) | unlike, 2.0 * NEAR, away)
    found = np.full(len(listed), -1)
    for k, n in zip(*linear_sum_assignment(cost), strict=True):
        if cost[k, n] <= NEAR:
            found[k] = n
    return found


def _words(name: str) -> list[str]:
    return [word for word in name.casefold().replace("-", " ").replace("/", " ").split() if len(word) > 1]
