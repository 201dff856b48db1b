"""Kerbs, car parks and garages of a town: places, rules and facilities, from tags and from a city's list of car parks.

Tags that say less than a zone needs are completed: parking with a fee but no `charge` costs `PRICE` an hour.

Kerbs are read in both tagging schemes, see `parkenv.lots.osm.parking`. A tagged kerb without a capacity has a place for
every `METRES_PER_PLACE`; one whose tags say nothing of parking has `PLACES_PER_METRE` of its class, where houses stand
beside it, and none on bridges, in tunnels and at roundabouts. Of main roads, one-way ones are one half of a dual
carriageway: all places are on the right. Kerbs that are drawn as areas (`parking=street_side` and the like) are places
along the nearest street.
"""

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import shapely
from pydantic import BeforeValidator, ConfigDict, Field
from scipy.optimize import linear_sum_assignment

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.errors import InputError, naming, require
from parkenv.files.field_types import Name
from parkenv.files.limited_reading import csv_records
from parkenv.files.spec_file import Spec
from parkenv.lots.draft import LotDraft
from parkenv.lots.generators import NO_SLOTS, Slots
from parkenv.lots.osm.conditions import (
    FREE,
    RESERVED,
    RESERVED_PLACES,
    Charge,
    Conditional,
    access_layer,
    always,
    at_hours,
    charge_in,
    conditional,
    duration,
    hours_text,
    kerb_conditions,
    kerb_tag,
    kerb_users,
    opening,
    parking_users,
    week_of,
)
from parkenv.lots.osm.parking import (
    SHORTEST_KERB_SLOT,
    Area,
    Junctions,
    Kerb,
    kerb_of,
    kerb_slots,
    orientation_of,
)
from parkenv.lots.osm.roads import SIDES, Rank, Road, Side, count_in
from parkenv.lots.unread import note_unread
from parkenv.world.drive_graph import linestrings
from parkenv.world.facility import FACILITY_KINDS, Facility
from parkenv.world.tariff import PUBLIC, Hours, Price, Zone
from parkenv.world.week import DAY_S

PRICE = 2.0  # assumed price of an hour where a fee is charged, in the currency of the town
LONGEST_LIMIT = 7 * DAY_S  # s; from this `maxstay` on, there is no limit


@dataclass(frozen=True)
class Rules:
    """What tags say of parking somewhere; equal rules are one zone of a kind of facility."""

    users: str = PUBLIC
    per_hour: float = 0.0
    charged: str = (
        ""  # hours, as OpenStreetMap writes them; empty: always. Of a free place, those of `max_stay_s`
    )
    max_stay_s: float | None = None
    assumed: bool = False  # whether the price is
    by_day: bool = False  # whether a day costs 24 `per_hour`, however short the stay
    hours: str = ""  # when it is open, as OpenStreetMap writes it; empty: always
    daily_cap: float | None = None  # most that a day costs
    free_s: float = 0.0  # first s that cost nothing
    hourly: str = ""  # prices by hours instead of `per_hour` and `charged`, as `Price.parse` reads them

    def zone(self, kind: str) -> Zone:
        each = f"{24 * self.per_hour:g}/day" if self.by_day else f"{self.per_hour:g}/h"
        paid = (
            self.hourly or ("paid" if self.assumed else each),
            f"at most {self.daily_cap:g}/day" if self.daily_cap else "",
            f"after {self.free_s / 60:g} min" if self.free_s else "",
            self.charged,
        )
        limited = (f"{(self.max_stay_s or 0.0) / 60:g} min", "" if self.per_hour else self.charged)
        words = (
            *(kind, "" if self.users == PUBLIC else self.users),
            *(paid if self.per_hour or self.hourly else ("free" if self.users == PUBLIC else "",)),
            *(() if self.max_stay_s is None else limited),
            f"open {self.hours}" if self.hours else "",
        )
        charged = Hours.parse(self.charged) if self.charged else None
        steps = ((DAY_S, 24 * self.per_hour),) if self.by_day else ()
        price = Price(self.per_hour, steps, self.free_s, self.daily_cap, charged)
        if self.hourly:
            price = replace(Price.parse(self.hourly), daily_cap=self.daily_cap)
        hours = Hours.parse(self.hours) if self.hours else None
        return Zone(" ".join(filter(None, words)), price, hours, self.max_stay_s, (self.users,))


def rules_of(tags: Mapping[str, str]) -> Rules:
    users, hours = parking_users([access_layer(tags)], opening(tags))
    users = RESERVED.get(tags.get("parking_space", ""), users) or "private"
    fee, _ = conditional(tags, "fee")
    return _rules(users, hours, tags, "fee", fee, "charge", "maxstay", always())


def kerb_rules(tags: Mapping[str, str], side: Side) -> Rules:
    users, hours = kerb_users(tags, side)
    users = users or "private"
    keys = [kerb_tag(tags, f"parking:{{}}:{what}", side) for what in ("fee", "charge", "maxstay")]
    conditions, limited = kerb_conditions(tags, side), always()
    stay = kerb_tag(tags, "parking:condition:{}:maxstay", side)
    if keys[2] not in tags:
        keys[2], limited = stay, conditions[1][0][1] if conditions[1] else always()
    conditional_fee = kerb_tag(tags, "parking:{}:fee:conditional", side)
    if keys[0] not in tags and conditional_fee in tags:
        keys[0] = conditional_fee.removesuffix(":conditional")
    fee, _ = conditional(tags, keys[0])
    if keys[0] not in tags and not fee[1]:
        has_ticket = any(
            "ticket" in value for value in (conditions[0], *(value for value, _ in conditions[1]))
        )
        own = kerb_tag(tags, "parking:condition:{}", side)
        in_zone = "parking:ticket:zone" in tags and own not in tags
        ticket = (
            limited if in_zone and not has_ticket else at_hours(conditions, lambda value: "ticket" in value)
        )
        fee = ("no", [("yes", ticket)])
    return _rules(users, hours, tags, keys[0], fee, keys[1], keys[2], limited)


def _rules(
    users: str, open_at: BoolArray, tags: Mapping[str, str], fee_key: str, fee: Conditional,
    charge_key: str, stay_key: str, limited: BoolArray,
) -> Rules:  # fmt: skip
    charge, paid = Charge(PRICE), _paid_at(tags, fee_key, fee)
    (text, at_times), _ = conditional(tags, charge_key)
    read = [(charge_in(text) if text else None, always())]
    read += [(charge_in(value), when) for value, when in at_times]
    if any(known is None for known, _ in read[not text :]):
        key = charge_key if text and read[0][0] is None else f"{charge_key}:conditional"
        note_unread(tags, key, f"{PRICE:g} an hour")
    clauses = [(known, when) for known, when in read if known is not None]
    for doubt in (known.doubt for known, _ in clauses if known.doubt):
        note_unread(tags, charge_key, doubt)
    if clauses:
        named = fee_key in tags or fee[1]
        covered = np.any([when for _, when in clauses], axis=0)
        paid = paid if named and (paid.any() or fee[0] == "no") else covered
        charge = clauses[-1][0]
    (_, _), short = conditional(tags, fee_key)
    free_s = max((below for value, below in short if value in NO_FEE and below > 0.0), default=0.0)
    if any(value not in NO_FEE or below < 0.0 for value, below in short):
        note_unread(tags, f"{fee_key}:conditional", "without the condition on stays")
    by_hour: dict[float, BoolArray] = {}
    for known, when in clauses:
        by_hour = {price: minutes & ~when for price, minutes in by_hour.items()}
        by_hour[known.per_hour] = by_hour.get(known.per_hour, ~always()) | (when & paid)
    by_hour = {price: minutes for price, minutes in by_hour.items() if price and minutes.any()}
    hourly = ""
    if len(by_hour) > 1:
        hourly = "; ".join(
            f"{price:g} @ {rule}" for price, when in by_hour.items() for rule in _open_rules(when)
        )
    elif clauses:
        paid = next(iter(by_hour.values()), ~always())
        charge = next((known for known, _ in clauses if known.per_hour in by_hour), charge)
    is_paid = bool(paid.any() and charge.per_hour)
    stay, limited = _longest_stay(tags, stay_key, limited)
    counted = paid if is_paid else limited
    if stay is not None and is_paid and (limited != paid).any() and not limited.all():
        note_unread(tags, stay_key, "a limit of stays in the charged hours")
    charged = "; ".join(_open_rules(counted)) if is_paid or stay is not None else ""
    return Rules(
        users,
        round(charge.per_hour, 4 if charge.by_day else 2) if is_paid and not hourly else 0.0,
        "" if hourly else charged,
        stay,
        is_paid and not clauses,
        is_paid and charge.by_day and not hourly,
        hours_text(open_at),
        charge.daily_cap if is_paid else None,
        free_s if is_paid and not hourly else 0.0,
        hourly,
    )


NO_FEE = (*FREE, "")  # values of `fee`, or none, where nothing is charged


def _paid_at(tags: Mapping[str, str], key: str, fee: Conditional) -> BoolArray:
    """Return when a fee is charged; without a tag, always where the conditions only say when not."""
    base, clauses = fee[0].lower(), fee[1]
    if not base and clauses and all(value in NO_FEE for value, _ in clauses):
        base = "yes"
    if base == "unknown":
        note_unread(tags, key, "free")
        base = "no"
    week = None if base in (*NO_FEE, "yes", "ticket", "paid", "interval") else week_of(base)
    if week is not None:
        if week.doubt:
            note_unread(tags, key, week.doubt)
        return at_hours(("no", [("yes", week.minutes), *clauses]), lambda value: value not in NO_FEE)
    if base not in (*NO_FEE, "yes", "ticket", "paid") and charge_in(base) is None:
        note_unread(tags, key, "charged at all times")
    return at_hours((base, clauses), lambda value: value not in NO_FEE)


def _longest_stay(tags: Mapping[str, str], key: str, limited: BoolArray) -> tuple[float | None, BoolArray]:
    """Return the limit of a stay, s, and when it counts; of several limits the shortest one."""
    (text, clauses), _ = conditional(tags, key)
    limits = []
    for value, when in (*([(text, limited)] if text else []), *clauses):
        seconds = duration(value)
        if seconds is None or seconds == 0.0:
            note_unread(tags, key if value == text else f"{key}:conditional", "no limit of stays")
        elif seconds < LONGEST_LIMIT:
            limits.append((seconds, when))
        else:
            limits = [(limit, minutes & ~when) for limit, minutes in limits]
    if not limits:
        return None, limited
    if len(limits) > 1:
        note_unread(tags, f"{key}:conditional", "the shortest limit of stays")
    return min(limits, key=lambda limit: limit[0])


def _open_rules(minutes: BoolArray) -> list[str]:
    """Return the rules of hours, without those of days that have none; of no hours at all that of these."""
    rules = hours_text(minutes).split("; ")
    return [rule for rule in rules if not rule.endswith(" off")] or rules


class AreaRule(NamedTuple):
    """Places by area: `places_of_square_metre` · (area · levels) ^ `power`."""

    places_of_square_metre: float  # how many places an area of 1 m² had
    power: float  # below 1 where large car parks need more ways
    levels: float  # number of levels where the tags do not say it
    typical: int  # places of one whose area is unknown
    kind: str = "lot"  # kind of such facilities


# Rule of each kind; fitted by `python benchmarks/parking_rules.py`, which states the errors.
RULES = {
    "surface": AreaRule(0.1847, 0.7882, 1.0, 7),
    "boxes": AreaRule(0.0574, 1.0, 1.0, 4),
    "underground": AreaRule(0.0346, 1.0, 1.0, 30, "garage"),
    "multi-storey": AreaRule(0.0377, 1.0, 4.7, 350, "garage"),
    "rooftop": AreaRule(0.0342, 1.0, 1.0, 45, "garage"),
}
# Rule for each value of `parking`; `surface` for others.
KINDS = {
    **dict.fromkeys(("garage", "garages", "garage_boxes", "carport", "carports", "sheds"), "boxes"),
    **{"underground": "underground", "multi-storey": "multi-storey", "rooftop": "rooftop"},
}


def rule_of(tags: Mapping[str, str]) -> str:
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
    a = RULES[rule]
    if area is None:
        return a.typical
    return max(int((a.places_of_square_metre * float(area * (levels or a.levels)) ** a.power) + 0.5), 1)


# Columns of the table of facilities: `capacity_from` is tag, drawn, list, register or rule, `rule` which one; `slots`
# of the capacity are drawn, the others counted; `tagged` is what the tags say; `element` is the way or node, of a
# kerb with its side.
TABLE = ("name", "kind", "capacity", "capacity_from", "rule", "zone", "slots", "tagged", "element")


@dataclass(eq=False)
class FacilityRow:
    """A facility: its line in the table, its rules, and what makes it."""

    name: str
    kind: str
    rules: Rules
    capacity_from: str  # `tag`, `drawn`, `rule`, `list` or `register`
    rule: str  # which rule
    element: str  # of the map; of a kerb with its side
    tagged: int | None = None  # number of places that the tags say
    slots: Slots = NO_SLOTS  # drawn ones
    slot_rules: list[Rules] = field(default_factory=list)
    slot_ids: list[str] = field(default_factory=list)  # of a register; empty: the element's with numbers
    counted: list[tuple[str, int, Rules]] = field(
        default_factory=list
    )  # name, places, rules of counted parts
    xy: tuple[float, float] | None = None

    @property
    def places(self) -> int:
        return len(self.slots) + sum(n for _, n, _ in self.counted)


def counted_parts(
    name: str, places: int, rules: Rules, tags: Mapping[str, str]
) -> list[tuple[str, int, Rules]]:
    """Divide the places of a counted facility: those for everybody, and those that tags reserve for some users."""
    parts = []
    for users in RESERVED_PLACES:
        key = f"capacity:{users}"
        n = 0 if tags.get(key) == "no" else count_in(tags, key, "no reserved place") or 0
        if n > places:
            note_unread(tags, key, "all places that are left")
        if min(n, places) > 0:
            parts.append((f"{name}, {users}", min(n, places), replace(rules, users=users)))
            places -= min(n, places)
    return [(name, places, rules), *parts] if places else parts


def zoned_slots(rows: Sequence[FacilityRow]) -> tuple[Slots, list[str], dict[str, Zone]]:
    """Return the slots of facilities with zone and facility, their ids, and the zones of all places by name."""
    used = dict.fromkeys(
        (row.kind, rules)
        for row in rows
        for rules in (*row.slot_rules, *(r for _, _, r in row.counted), row.rules)
    )
    zones = {(kind, rules): rules.zone(kind) for kind, rules in used}
    slots = replace(
        Slots.joined([row.slots for row in rows]),
        zone=np.array([zones[row.kind, own].name for row in rows for own in row.slot_rules], np.str_),
        facility=np.repeat(np.array([row.name for row in rows], np.str_), [len(row.slots) for row in rows]),
    )
    numbered = [[f"{row.element}-{i + 1}" for i in range(len(row.slots))] for row in rows]
    ids = [name for row, names in zip(rows, numbered, strict=True) for name in row.slot_ids or names]
    return slots, ids, {zone.name: zone for zone in zones.values()}


def facilities_of(row: FacilityRow, filled: set[str]) -> Iterator[Facility]:
    usual = FACILITY_KINDS[row.kind]
    if len(row.slots) and row.name in filled:
        yield Facility(row.name, row.kind, row.rules.zone(row.kind).name)
    for name, capacity, rules in row.counted if row.xy is not None else ():
        zone = rules.zone(row.kind).name
        yield Facility(name, row.kind, zone, capacity, row.xy, usual.gate_s, usual.inside_s, usual.known)


def table_of(rows: Sequence[FacilityRow], draft: LotDraft) -> list[dict[str, Any]]:
    slots = Counter(draft.slots.facility.tolist())
    counted = {facility.name: facility.capacity for facility in draft.facilities}
    table = []
    for row in rows:
        places = slots[row.name] + sum(counted.get(name, 0) for name, _, _ in row.counted)
        if places:
            zone = row.rules.zone(row.kind).name
            cells = {**vars(row), "capacity": places, "zone": zone, "slots": slots[row.name]}
            table.append({name: cells[name] for name in TABLE})
    return table


NEAR = 100.0  # m, from a car park of the list to the entry of the facility that it is
SAME_NAME = 4.0  # so many times as far if they share a word that few of the list have
_SIMILAR = 3.0  # largest ratio of the capacities of facilities that share no word


class ListedCarPark(Spec):
    """A car park of a list: its capacity (0: not stated) and position, degrees."""

    model_config = ConfigDict(extra="ignore", strict=False)

    name: Annotated[Name, Field(min_length=1, max_length=80)]
    capacity: Annotated[int, BeforeValidator(lambda text: text or 0), Field(ge=0, lt=1_000_000)]
    lat: float = Field(ge=-90.0, le=90.0)
    lon: float = Field(ge=-180.0, le=180.0)


def read_listed(path: Path) -> list[ListedCarPark]:
    """Read a list of car parks, a CSV file with the columns name, capacity, lat and lon; others are not read."""
    listed: dict[str, ListedCarPark] = {}
    for line, record in csv_records(path):
        with naming(f"{path}: line {line}"):
            car_park = ListedCarPark.parse(record, "")
            if car_park.name in listed:
                raise InputError(f"name is {car_park.name!r:.40}, want one that no other line has")
            listed[car_park.name] = car_park
    require(listed, f"{path}: has no car park, want a line for each")
    return list(listed.values())


def matched(listed: Sequence[ListedCarPark], at: FloatArray, rows: Sequence[FacilityRow]) -> IntArray:
    """Return which facility each car park of a list, at (k, 2) m, is: index or -1, each at most once; nearest in all.

    It is within `NEAR` and of like capacity, or shares a rare word with the name within `SAME_NAME` times as far.
    """
    words = [_words(car_park.name) for car_park in listed]
    use = Counter(word for each in words for word in each)
    rare = [{word for word in each if use[word] <= max(len(listed) // 4, 1)} for each in words]
    shared = np.array([[bool(each & _words(row.name)) for row in rows] for each in rare])
    ratio = np.array([[max(car_park.capacity, 1)] for car_park in listed]) / [max(r.places, 1) for r in rows]
    away = np.hypot(*(at[:, None] - np.array([row.xy for row in rows]).reshape(-1, 2)).transpose(2, 0, 1))
    away = np.where(shared, away / SAME_NAME, away)
    stated = np.array([[car_park.capacity > 0] for car_park in listed])
    unlike = ~shared & stated & (np.maximum(ratio, 1.0 / ratio) > _SIMILAR)
    cost = np.where((away > NEAR) | unlike, 2.0 * NEAR, away)
    facility = np.full(len(listed), -1)
    pairs = np.array(linear_sum_assignment(cost))
    k, n = pairs[:, cost[*pairs] <= NEAR]
    facility[k] = n
    return facility


def _words(name: str) -> set[str]:
    return {word for word in name.casefold().replace("-", " ").replace("/", " ").split() if len(word) > 1}


PLACES_PER_METRE = {
    "residential": 0.1659,
    "unclassified": 0.1539,
    "living_street": 0.1499,
    "tertiary": 0.0956,
    "secondary": 0.0649,
    "primary": 0.0153,
}
"""Places per metre of kerb, both sides, 5 m off the corners at junctions, by class of street.

Fitted to the 43,863 places of Berlin-Neukölln by `python tests/parking_rules.py`, which says how well.
"""
# Kerb taken by a place, m, by orientation; from the same kerbs.
METRES_PER_PLACE = {"parallel": 5.4, "diagonal": 3.1, "perpendicular": 2.6}
# Values of `parking` of areas that are kerbs.
STRIPS = ("street_side", "lane", "on_kerb", "half_on_kerb", "shoulder")
CLASS_RULE = "class of street"  # name of the rule of kerbs that the map says nothing of
HOUSES_WITHIN = 40.0  # m; where no building is this near, an untagged street has no places
STATION = 20.0  # m, between the points of a street at which buildings are looked for
STRIP_REACH = 20.0  # largest distance, m, of a drawn kerb from its street


def kerb_sides(
    roads: Sequence[Road],
    crossings: FloatArray,
    buildings: Sequence[Area],
    left_out: Mapping[str, list[str]],
    untagged: float = 1.0,
) -> Iterator[FacilityRow]:
    """Yield the kerbs of roads that have places, under the names of their streets; of a way there may be several."""
    street = {k: i for i, k in enumerate(k for k, road in enumerate(roads) if road.rank is Rank.STREET)}
    corners = Junctions([roads[k] for k in street], np.empty((0, 2)))
    everything = Junctions(roads, crossings)
    lonely = _without_houses(roads, buildings)
    rest: dict[str, float] = defaultdict(float)  # fractions of places, by class, so that totals are kept
    for k, road in enumerate(roads):
        kind = road.tags["highway"]
        for side in sorted(SIDES, key=road.near_side.__eq__):
            tagged = road.side_of_way(side)
            by_tag = any(
                f"{key}:{at}" in road.tags for key in ("parking", "parking:lane") for at in (tagged, "both")
            )
            free = everything.free_intervals(k, side)
            source, rule, capacity = "rule", CLASS_RULE, None
            if by_tag:
                kerb = kerb_of(road, side, left_out, reserved=True)
                if kerb is None:
                    continue
                capacity, source, rule = kerb.capacity, "tag", ""
                if capacity is None:
                    kerb = replace(kerb, capacity=int(_metres(free) / METRES_PER_PLACE[kerb.orientation]))
                    source, rule = "rule", "length of kerb"
            else:
                if (
                    k not in street
                    or any(road.tags.get(key, "no") != "no" for key in ("bridge", "tunnel", "junction"))
                    or (side != road.near_side and _is_half(road))
                ):
                    continue
                free = everything.free_intervals(k, side, lonely[k])
                metres = _metres(corners.free_intervals(street[k], side, lonely[k]))
                metres *= untagged * (2 if _is_half(road) else 1)
                expected = PLACES_PER_METRE.get(kind, 0.0) * metres + rest[kind]
                rest[kind] = expected % 1.0
                kerb = Kerb("parallel", int(expected), False)
            slots = kerb_slots(road, side, kerb, free)
            if len(slots):
                rules, name = kerb_rules(road.tags, tagged), road.tags.get("name", "")
                yield FacilityRow(name, "kerb", rules, source, rule, f"{road.id} {tagged}", capacity, slots)


def strip_side(area: Area, roads: Sequence[Road], tree: shapely.STRtree) -> FacilityRow | None:
    """Return the kerb that is drawn as an area, under its name; None if it is none along a road of the tree."""
    tags = area.element.tags
    index, distance = tree.query_nearest(area.polygon, return_distance=True, all_matches=False)
    if tags.get("parking") not in STRIPS or not len(index) or distance[0] > STRIP_REACH:
        return None
    road = roads[int(index[0])]
    line = linestrings([road.points])[0]
    stations = shapely.line_locate_point(line, shapely.points(shapely.get_coordinates(area.polygon)))
    start, end = float(stations.min()), float(stations.max())
    if end - start < SHORTEST_KERB_SLOT:
        return None
    orientation = orientation_of(tags) or "parallel"
    tagged = count_in(tags, "capacity", "by the length of the kerb")
    capacity = tagged if tagged is not None else max(round((end - start) / METRES_PER_PLACE[orientation]), 1)
    middle = shapely.get_coordinates(shapely.centroid(area.polygon))[0]
    here, ahead = shapely.get_coordinates(
        shapely.line_interpolate_point(line, [(start + end) / 2 - 1.0, (start + end) / 2 + 1.0])
    )
    along, away = ahead - here, middle - here
    side: Side = "left" if along[0] * away[1] - along[1] * away[0] > 0.0 else "right"
    slots = kerb_slots(road, side, Kerb(orientation, capacity, False), [(start, end)])
    if not len(slots):
        return None
    source, rule = ("tag", "") if tagged is not None else ("rule", "length of kerb")
    name = tags.get("name", road.tags.get("name", ""))
    return FacilityRow(name, "kerb", rules_of(tags), source, rule, area.element.id, tagged, slots)


def _metres(intervals: Iterable[tuple[float, float]]) -> float:
    return sum(end - start for start, end in intervals)


def _is_half(road: Road) -> bool:
    return road.oneway and road.tags["highway"] in ("primary", "secondary", "tertiary")


def _without_houses(roads: Sequence[Road], buildings: Sequence[Area]) -> list[list[tuple[float, float]]]:
    if not buildings:
        return [[] for _ in roads]
    tree = shapely.STRtree([a.polygon for a in buildings])
    lines = linestrings([road.points for road in roads])
    total = shapely.length(lines)
    count = np.maximum(np.ceil(total / STATION).astype(np.int64), 1)
    of = np.repeat(np.arange(len(roads)), count)
    rank = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    step = (total / count)[of]
    at = shapely.line_interpolate_point(lines[of], (rank + 0.5) * step)
    beside = np.zeros(len(of), bool)
    beside[tree.query(at, predicate="dwithin", distance=HOUSES_WITHIN)[0]] = True
    result: list[list[tuple[float, float]]] = [[] for _ in roads]
    for i in np.flatnonzero(~beside).tolist():
        result[of[i]].append((float(rank[i] * step[i]), float((rank[i] + 1) * step[i])))
    return result
