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
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import BeforeValidator, ConfigDict, Field
from scipy.optimize import linear_sum_assignment

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, naming
from parkenv.files.field_types import Name
from parkenv.files.limited_reading import csv_records
from parkenv.files.spec_file import Spec
from parkenv.lots.draft import LotDraft
from parkenv.lots.generators import NO_SLOTS, Slots
from parkenv.lots.osm.parking import (
    ARRANGEMENTS,
    SHORTEST_KERB_SLOT,
    Area,
    Junctions,
    Kerb,
    free_intervals,
    kerb_of,
    kerb_slots,
)
from parkenv.lots.osm.roads import SIDES, Rank, Road, Side, whole_number
from parkenv.world.drive_graph import linestrings
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
        price = Price(self.per_hour, ((DAY_S, 24 * self.per_hour),) if self.by_day else (), charged=charged)
        hours = Hours.parse(self.hours) if self.hours else None
        return Zone(" ".join(words), price, hours, self.max_stay_s, (self.users,))


def rules_of(tags: Mapping[str, str]) -> Rules:
    users = RESERVED.get(tags.get("parking_space", ""), RESERVED.get(tags.get("access", ""), PUBLIC))
    rules = _rules(
        users, tags.get("fee"), tags.get("charge"), tags.get("fee:conditional"), tags.get("maxstay")
    )
    # But for holidays.
    hours = _shortest(re.sub(r"[;,]?\s*(PH|SH)\b[^;]*", "", tags.get("opening_hours", "")).strip("; "))
    return rules if hours in (_shortest("24/7"), _shortest("off")) else replace(rules, hours=hours)


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
    per_hour, assumed, by_day = 0.0, False, False
    if charge is not None and (known := charge_in(charge)) is not None:
        per_hour, by_day = known
    elif (fee or "no").lower() not in ("no", "free", "unknown") or (conditional or "").startswith("yes"):
        per_hour, assumed = PRICE, True
    texts = (fee, conditional, charge) if per_hour else ()
    readable = (_shortest("; ".join(_HOURS.findall(text or ""))) for text in texts)
    charged = next(filter(None, readable), "").removesuffix("; Sa,Su off").removesuffix("; Su off")
    stay = None
    if maxstay is not None and (match := _STAY.search(maxstay)):
        seconds = float(match[1].replace(",", ".")) * (HOUR_S if match[2].lower().startswith("h") else 60.0)
        stay = seconds if 0.0 < seconds < LONGEST_LIMIT else None
    return Rules(
        users, round(per_hour, 4 if by_day else 2), charged, stay, assumed, by_day and per_hour > 0.0
    )


def _shortest(text: str) -> str:
    """Return hours in their shortest form; empty if there are none that can be read."""
    try:
        return str(Hours.parse(text)) if text else ""
    except InputError:
        return ""


class AreaRule(NamedTuple):
    """Places by area: `places_of_square_metre` · (area · levels) ^ `power`."""

    places_of_square_metre: float  # how many places an area of 1 m² had
    power: float  # below 1 where large car parks need more ways
    levels: float  # number of levels where the tags do not say it
    typical: int  # places of one whose area is unknown


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
    if not listed:
        raise InputError(f"{path}: has no car park, want a line for each")
    return list(listed.values())


def matched(
    listed: list[ListedCarPark], at: FloatArray, names: list[str], capacity: FloatArray, xy: FloatArray
) -> NDArray[np.int64]:
    """Return which facility each car park of a list, at (k, 2) m, is: index or -1, each at most once; nearest in all.

    It is within `NEAR` and of like capacity, or shares a rare word with the name within `SAME_NAME` times as far.
    """
    words = [_words(car_park.name) for car_park in listed]
    use = Counter(word for each in words for word in each)
    rare = [{word for word in each if use[word] <= max(len(listed) // 4, 1)} for each in words]
    shared = np.array([[bool(each & _words(name)) for name in names] for each in rare])
    ratio = np.array([[max(car_park.capacity, 1)] for car_park in listed]) / np.maximum(capacity, 1.0)
    away = np.hypot(*(at[:, None] - xy).transpose(2, 0, 1))
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
METRES_PER_PLACE = {"parallel": 5.4, "diagonal": 3.1, "perpendicular": 2.6}
"""Kerb taken by a place, m, by orientation; from the same kerbs."""
STRIPS = ("street_side", "lane", "on_kerb", "half_on_kerb", "shoulder")
"""Values of `parking` of areas that are kerbs."""
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
        total = float(np.hypot(*np.diff(road.points, axis=0).T).sum())
        for side in sorted(SIDES, key=road.near_side.__eq__):
            tagged = road.side_of_way(side)
            by_tag = any(
                f"{key}:{at}" in road.tags for key in ("parking", "parking:lane") for at in (tagged, "both")
            )
            closed = everything.closed_intervals(k, side)
            source, rule, capacity = "rule", CLASS_RULE, None
            if by_tag:
                usable = {key: value for key, value in road.tags.items() if value not in RESERVED}
                kerb = kerb_of(usable, tagged)
                if isinstance(kerb, str):
                    left_out[kerb].append(f"{road.id}-{tagged}")
                if kerb is None or isinstance(kerb, str):
                    continue
                capacity, source, rule = kerb.capacity, "tag", ""
                if capacity is None:
                    free = sum(end - start for start, end in free_intervals(total, closed))
                    kerb = replace(kerb, capacity=int(free / METRES_PER_PLACE[kerb.orientation]))
                    source, rule = "rule", "length of kerb"
            else:
                if (
                    k not in street
                    or any(road.tags.get(key, "no") != "no" for key in ("bridge", "tunnel", "junction"))
                    or (side != road.near_side and _is_half(road))
                ):
                    continue
                closed = closed + lonely[k]
                off_corners = corners.closed_intervals(street[k], side) + lonely[k]
                free = sum(end - start for start, end in free_intervals(total, off_corners))
                free *= untagged * (2 if _is_half(road) else 1)
                expected = PLACES_PER_METRE.get(kind, 0.0) * free + rest[kind]
                rest[kind] = expected % 1.0
                kerb = Kerb("parallel", int(expected), False)
            slots = kerb_slots(road, side, kerb, closed)
            if len(slots):
                rules, name = kerb_rules(road.tags, tagged), road.tags.get("name", "")
                yield FacilityRow(name, "kerb", rules, source, rule, f"{road.id} {tagged}", capacity, slots)


def strip_side(area: Area, roads: Sequence[Road], tree: shapely.STRtree) -> FacilityRow | None:
    """Return the kerb that is drawn as an area, under its name; None if it is not along a road of the tree."""
    tags = area.element.tags
    (index, distance) = tree.query_nearest(area.polygon, return_distance=True, all_matches=False)
    if not len(index) or distance[0] > STRIP_REACH:
        return None
    road = roads[int(index[0])]
    line = linestrings([road.points])[0]
    stations = shapely.line_locate_point(line, shapely.points(shapely.get_coordinates(area.polygon)))
    start, end, total = float(stations.min()), float(stations.max()), float(shapely.length(line))
    if end - start < SHORTEST_KERB_SLOT:
        return None
    orientation = tags.get("orientation", tags.get("parking:orientation", "parallel"))
    orientation = orientation if orientation in ARRANGEMENTS else "parallel"
    tagged = whole_number(tags.get("capacity"))
    capacity = tagged if tagged is not None else max(round((end - start) / METRES_PER_PLACE[orientation]), 1)
    middle = shapely.get_coordinates(shapely.centroid(area.polygon))[0]
    here, ahead = shapely.get_coordinates(
        shapely.line_interpolate_point(line, [(start + end) / 2 - 1.0, (start + end) / 2 + 1.0])
    )
    along, away = ahead - here, middle - here
    side: Side = "left" if along[0] * away[1] - along[1] * away[0] > 0.0 else "right"
    slots = kerb_slots(road, side, Kerb(orientation, capacity, False), [(-1.0, start), (end, total + 1.0)])
    if not len(slots):
        return None
    source, rule = ("tag", "") if tagged is not None else ("rule", "length of kerb")
    name = tags.get("name", road.tags.get("name", ""))
    return FacilityRow(name, "kerb", rules_of(tags), source, rule, area.element.id, tagged, slots)


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
