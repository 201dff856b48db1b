"""The contents of a lot file: its valid slots, facilities and zones, and the errors of the others.

The member `zones` of the file has an object for each zone with rules; all of its members may be absent:

| member | value |
|---|---|
| `price` | a number (of an hour), or an object with `per_hour`, `steps` (pairs of a stay, s, and the price up to it), \
`free_s`, `daily_cap`, `charged` (hours) and `per_kwh` |
| `hours` | when cars may be parked there, such as `"Mo-Sa 08:00-20:00"` |
| `max_stay_s` | s, longest stay |
| `users` | list of classes of users, `["public"]` if absent |
"""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import numpy as np
import shapely
from pydantic import ConfigDict, Field, Strict

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, naming, nearest, require, require_number
from parkenv.files.file_names import is_plain
from parkenv.files.spec_file import Spec
from parkenv.lots.generators import NO_SLOTS, Slots, slots_from_polygons
from parkenv.lots.local_frame import LocalFrame
from parkenv.world.drive_graph import GraphError, build_drive_graph, linestrings
from parkenv.world.facility import Facility
from parkenv.world.lot import FARTHEST, SLOT_SIDE, Lane, Mouth, ParkingLot, Turn
from parkenv.world.tariff import NO_ZONE, Hours, Price, Zone, members_of

# The kinds of features, and the geometry types allowed for each.
KINDS = {
    "slot": ("Polygon",),
    "lane": ("LineString",),
    "entry": ("Point",),
    "goal": ("Point",),
    "wall": ("LineString", "Polygon"),
    "facility": ("Point",),
    "turn": ("LineString",),
}
Coordinate = Annotated[float, Field(ge=-FARTHEST, le=FARTHEST)]
Side = Annotated[float, Field(ge=SLOT_SIDE, le=FARTHEST)]


@dataclass(frozen=True)
class LotProblem:
    """An error or warning about a lot file; `feature` is the 0-based index in the FeatureCollection."""

    severity: Literal["error", "warning"]
    feature: int | None
    message: str

    def __str__(self) -> str:
        where = "" if self.feature is None else f"feature {self.feature}: "
        return f"{self.severity}: {where}{self.message}"


@dataclass(frozen=True)
class RawFeature:
    number: int
    kind: str
    properties: dict[str, Any]
    parts: list[slice]
    given_id: object


@dataclass
class LotContents:
    """The valid features of a file; `numbers[kind]` are their feature numbers, `errors` those of the other features."""

    name: str
    found: str = ""  # what was recognised of the positions
    frame: LocalFrame | None = None  # where the lot is, of a file in degrees
    slot_ids: list[str] = field(default_factory=list)
    slots: Slots = NO_SLOTS
    lanes: list[Lane] = field(default_factory=list)
    entries: list[FloatArray] = field(default_factory=list)
    goals: list[FloatArray] = field(default_factory=list)
    walls: list[FloatArray] = field(default_factory=list)
    turns: list[Turn] = field(default_factory=list)
    left_hand: bool = False
    facilities: list[Facility] = field(default_factory=list)
    zone_rules: dict[str, Zone] = field(default_factory=dict)
    # by kind, `goal` or `entry`: the weights by purpose of each
    weights: dict[str, list[dict[str, float]]] = field(default_factory=lambda: {"entry": [], "goal": []})
    numbers: dict[str, list[int]] = field(default_factory=lambda: {kind: [] for kind in KINDS})
    errors: list[LotProblem] = field(default_factory=list)

    def columns(self) -> dict[str, Any]:
        as_they_are = ("name", "slot_ids", "lanes", "walls", "facilities", "zone_rules", "turns", "left_hand")
        return {
            **{name: getattr(self, name) for name in as_they_are},
            **self.slots.columns(),
            "entries": np.array(self.entries),
            "goals": np.array(self.goals),
            "goal_weights": self._weights("goal"),
            "entry_weights": self._weights("entry"),
        }

    def _weights(self, kind: str) -> dict[str, FloatArray]:
        each = self.weights[kind]
        purposes = dict.fromkeys(purpose for weights in each for purpose in weights)
        return {name: np.array([weights.get(name, 0.0) for weights in each]) for name in purposes}

    def error(self, feature: int | None, message: str) -> None:
        self.errors.append(LotProblem("error", feature, message))


def graph_errors(contents: LotContents) -> list[LotProblem]:
    """Return errors of the drive graph: slots, entries, turns and facilities without a lane, crowded junctions."""
    lanes = [(lane.points, lane.oneway, lane.speed) for lane in contents.lanes]
    if not lanes:
        return []
    mouth_xy = contents.slots.mouths()
    entries = np.array(contents.entries).reshape(-1, 2)
    turns = [(turn.points, turn.only) for turn in contents.turns]
    left = {
        kind: np.arange(len(its)) for kind, its in (("slot", mouth_xy), ("entry", entries), ("turn", turns))
    }
    errors = []
    while True:
        # Remove faulty features and repeat, so that all faults are found.
        try:
            build_drive_graph(
                lanes, mouth_xy[left["slot"]], entries[left["entry"]], [turns[i] for i in left["turn"]]
            )
        except GraphError as error:
            kind = error.problems[0].kind
            for problem in error.problems:
                if kind == "junction":
                    distance = shapely.distance(
                        linestrings([points for points, _, _ in lanes]), shapely.Point(problem.xy)
                    )
                    feature = contents.numbers["lane"][int(np.argmin(distance))]
                    message = f"lane: the junction {problem.message}"
                else:
                    index = left[kind][problem.index]
                    feature = contents.numbers[kind][index]
                    name = f"slot {contents.slot_ids[index]!r:.40}" if kind == "slot" else kind
                    message = f"{name} {problem.message}"
                errors.append(LotProblem("error", feature, message))
            if kind == "junction":
                return errors
            left[kind] = np.delete(left[kind], [problem.index for problem in error.problems])
        else:
            break
    if not errors and not contents.errors and contents.facilities:
        try:
            ParkingLot(**contents.columns())
        except GraphError as error:
            numbers = contents.numbers["facility"]
            errors += [LotProblem("error", numbers[p.index], f"facility {p.message}") for p in error.problems]
    return errors


_COUNTED = ("gate_s", "inside_s", "known", "delay_s")  # properties of counted facilities alone


def read_zones(document: Any) -> dict[str, Zone]:
    if not isinstance(document, dict):
        raise InputError(f"zones is {document!r:.40}, want an object with the rules of each zone")
    rules = {}
    for name, given in document.items():
        with naming(f"zone {name!a:.40}"):
            require(name and is_plain(name), "its name is empty or has control characters")
            members = members_of(given, ("price", "hours", "max_stay_s", "users"), "rules")
            if "price" in members:
                members["price"] = Price.parse(members["price"])
            if "hours" in members:
                members["hours"] = Hours.parse(members["hours"])
            if not isinstance(members.get("users", []), list):
                raise InputError(f"users is {members['users']!r:.40}, want a list of names")
            rules[name] = Zone(name, **members)
    return rules


def zone_document(zone: Zone) -> dict[str, Any]:
    hours = None if zone.hours is None else str(zone.hours)
    rules = {"price": zone.price.members() or None, "hours": hours, "max_stay_s": zone.max_stay_s}
    return {name: rule for name, rule in rules.items() if rule is not None} | {"users": list(zone.users)}


def read_zone(properties: dict[str, Any], rules: Collection[str]) -> str:
    """Return the zone of a feature, empty text if not given; where the file has rules, one of those zones."""
    zone = properties.get("zone", "")
    if not isinstance(zone, str) or not is_plain(zone) or ("zone" in properties and not zone):
        raise InputError(f"zone is {zone!r:.40}, want a name")
    if zone and rules and zone != NO_ZONE and zone not in rules:
        raise InputError(f"zone is {zone!r:.40}, want one of the file's zones; {nearest(zone, rules)}")
    return zone


def read_facilities(contents: LotContents, raw: list[RawFeature], xy: FloatArray) -> None:
    seen: set[str] = set()
    for feature in raw:
        given = dict(feature.properties)
        name = given.get("name", feature.given_id)
        known = ("kind", "name", "type", "zone", "capacity", *_COUNTED)
        try:
            with naming(f"facility {name!r:.40}"):
                for member in given:
                    if member not in known:
                        raise InputError(
                            f"no property {member!r:.40} of facilities; {nearest(member, known)}"
                        )
                counted = [member for member in _COUNTED if member in given]
                if counted and not given.get("capacity"):
                    raise InputError(f"{counted[0]} is of counted facilities, want a capacity, too")
                require(str(name) not in seen, "its name appears already")
                contents.facilities.append(
                    Facility(
                        name=name,
                        kind=given.get("type", "lot"),
                        zone=given.get("zone", ""),
                        capacity=given.get("capacity", 0),
                        xy=tuple(xy[feature.parts[0]][0].tolist()) if given.get("capacity") else None,
                        **{member: given[member] for member in counted},
                    )
                )
                contents.numbers["facility"].append(feature.number)
                seen.add(str(name))
                read_zone(given, contents.zone_rules)
        except InputError as error:
            contents.error(feature.number, str(error))


def facility_properties(facility: Facility) -> dict[str, Any]:
    given: dict[str, Any] = {"name": facility.name, "type": facility.kind}
    if facility.zone:
        given["zone"] = facility.zone
    if facility.is_counted:
        given["capacity"] = facility.capacity
        given |= {name: getattr(facility, name) for name in _COUNTED}
    return given


def read_weights(feature: RawFeature) -> dict[str, float]:
    weights = feature.properties.get("weights", {})
    require(isinstance(weights, dict), f"{feature.kind}: weights is {weights!r:.40}, want numbers by purpose")
    for purpose, weight in weights.items():
        require_number(f"{feature.kind}: weights[{purpose!r:.40}]", weight, least=0.0)
    return {purpose: float(weight) for purpose, weight in weights.items()}


class SlotShape(Spec):
    """The properties that define a slot exactly."""

    model_config = ConfigDict(extra="ignore")

    center: Annotated[tuple[Coordinate, Coordinate], Strict(False)]
    yaw: Coordinate
    length: Side
    width: Side
    mouth: Literal["rear", "left", "right"]

    def row(self) -> tuple[float, ...]:
        return (*self.center, self.yaw, self.length, self.width, Mouth[self.mouth.upper()])


SLOT_SHAPE = tuple(SlotShape.model_fields)
SLOT_AGREEMENT = 0.01  # largest distance, m, between a slot's polygon and the rectangle of its properties


def read_slots(contents: LotContents, raw: list[RawFeature], xy: FloatArray, exact: bool) -> None:
    """Add the valid slots; exact properties count in a local frame: after a projection, stale ones go unnoticed."""
    if not raw:
        return
    rings = [xy[feature.parts[0]] for feature in raw]
    which = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    polygons = np.asarray(shapely.polygons(shapely.linearrings(np.concatenate(rings), indices=which)))
    area = shapely.area(shapely.convex_hull(polygons))
    valid = shapely.is_valid(polygons)
    drawn = dict.fromkeys(place.name for place in contents.facilities if not place.is_counted)
    first_with = {
        place.name: number
        for place, number in zip(contents.facilities, contents.numbers["facility"], strict=True)
        if place.is_counted
    }
    rows: list[tuple[int, str, SlotShape | None, float, str, str]] = []
    for i, feature in enumerate(raw):
        given = feature.properties
        try:
            slot_id = _slot_id(feature)
            if slot_id in first_with:
                raise InputError(f"slot: id {slot_id!r:.40} appears already in feature {first_with[slot_id]}")
            first_with[slot_id] = feature.number
            with naming(f"slot {slot_id!r:.40}"):
                require(area[i] >= SLOT_SIDE**2, "the polygon is flat, want an area to park on")
                if not valid[i]:
                    reason = shapely.is_valid_reason(polygons[i])
                    raise InputError(f"the polygon is not a simple one: {reason}")
                cost, facility = given.get("parking_cost_s", 0.0), given.get("facility", "")
                require_number("parking_cost_s", cost, least=0.0, most=FARTHEST)
                if "facility" in given and not (isinstance(facility, str) and facility in drawn):
                    hint = nearest(str(facility), drawn)
                    raise InputError(
                        f"facility is {facility!r:.40}, want that of a feature without a capacity; {hint}"
                    )
                has_shape = exact and any(name in given for name in SLOT_SHAPE)
                shape = SlotShape.parse(given, "") if has_shape else None
                rows.append((i, slot_id, shape, cost, read_zone(given, contents.zone_rules), facility))
        except InputError as error:
            contents.error(feature.number, str(error))
    valid_rows, ids, shapes, costs, zones, facilities = zip(*rows, strict=True) if rows else ((),) * 6

    polygons = polygons[list(valid_rows)]
    bare = np.array([shape is None for shape in shapes], dtype=bool)
    slots = slots_from_polygons(polygons[bare], contents.lanes)
    if not bare.all():
        # x, y, yaw, length, width, mouth
        table = np.empty((len(valid_rows), 6))
        table[bare] = np.column_stack([slots.xy, slots.yaw, slots.length, slots.width, slots.mouth])
        table[~bare] = [shape.row() for shape in shapes if shape is not None]
        slots = Slots(table[:, :2], table[:, 2], table[:, 3], table[:, 4], table[:, 5].astype(np.int8))

    apart = shapely.hausdorff_distance(polygons, slots.boxes())
    disagrees = ~bare & (apart > SLOT_AGREEMENT)
    thin = slots.width < SLOT_SIDE
    for k in np.flatnonzero(disagrees):
        contents.error(
            raw[valid_rows[k]].number,
            f"slot {ids[k]!r:.40}: the polygon lies {apart[k]:.2f} m from what center, yaw, length and width "
            f"say, want at most {SLOT_AGREEMENT:g} m",
        )
    for k in np.flatnonzero(thin):
        contents.error(
            raw[valid_rows[k]].number,
            f"slot {ids[k]!r:.40}: the polygon is {slots.width[k]:.3f} m wide, want at least {SLOT_SIDE:g} m",
        )
    kept = np.flatnonzero(~disagrees & ~thin)
    contents.slots = replace(
        slots,
        parking_cost_s=np.array(costs, np.float64),
        zone=np.array(zones, np.str_),
        facility=np.array(facilities, np.str_),
    )[kept]
    contents.slot_ids = [ids[k] for k in kept]
    contents.numbers["slot"] = [raw[valid_rows[k]].number for k in kept]


def _slot_id(feature: RawFeature) -> str:
    given = feature.number if feature.given_id is None else feature.given_id
    given = str(given) if type(given) is int else given
    if not isinstance(given, str) or not given or not is_plain(given):
        raise InputError(f"slot: id is {given!r:.40}, want a text")
    return given
