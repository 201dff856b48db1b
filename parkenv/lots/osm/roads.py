"""Roads open to cars, from OpenStreetMap tags: their network, entries and turn restrictions."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
import shapely
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.lots.draft import LeftOut
from parkenv.lots.generators import ONE_WAY_HALF_WIDTH, Slots
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.osm.elements import OsmElement, OsmMap
from parkenv.lots.unread import note_unread
from parkenv.world.drive_graph import (
    NODE_TOLERANCE,
    Chains,
    Rule,
    centrelines,
    component_labels,
    connected,
    node_labels,
    rules_of,
)
from parkenv.world.lot import Lane, Turn

# Carriageway width, m, without parked cars, of two-way roads without the tags `width` and `lanes`.
STREET_WIDTH = {
    "motorway": 7.5,
    "trunk": 7.5,
    "primary": 7.0,
    "secondary": 7.0,
    "tertiary": 6.5,
    "unclassified": 6.0,
    "residential": 6.0,
    "road": 6.0,
    "living_street": 5.0,
    "service": 5.0,
}
# Speed limit, km/h, of roads without the tag `maxspeed`, by class.
LIMITS = {
    **dict.fromkeys(("primary", "secondary", "tertiary", "unclassified", "road"), 50.0),
    "motorway": 100.0,
    "trunk": 70.0,
    "residential": 30.0,
    "living_street": 10.0,
    "service": 15.0,
}
_AISLE_LIMIT = 10.0  # km/h, of a `service=parking_aisle`
_NAMED_LIMITS = {"walk": 7.0, "none": 100.0, "urban": 50.0, "rural": 70.0, "living_street": 7.0}
AISLE_WIDTH = 6.0  # the same for a `service=parking_aisle`
LANE_WIDTH = 3.0  # width of each of the tagged `lanes`, m
# Values of `barrier` that let cars pass unless access tags say otherwise.
PASSABLE = (
    *("no", "entrance", "cattle_grid", "toll_booth", "border_control", "checkpoint", "sally_port", "coupure"),
    *("height_restrictor", "width_restrictor", "arch", "bump_gate"),
)
# Barriers that let cars pass on service roads if no tag says otherwise: ticket gates, or open by day.
ASSUMED_OPEN = ("lift_gate", "gate", "swing_gate")
BARRIER_GAP = 1.5  # m, between a barrier and the roads that end before it
# Kinds of `highway=service` that are not lanes.
NOT_FOR_PARKING = ("drive-through", "emergency_access", "bus")


class Rank(IntEnum):
    """Kind of road; a slot that faces several roads opens to the one of lowest rank."""

    AISLE = 0
    SERVICE = 1
    STREET = 2


Side = Literal["left", "right"]
SIDES: tuple[Side, Side] = ("left", "right")


@dataclass(frozen=True, eq=False)
class Road:
    id: str  # such as `way/123`
    tags: Mapping[str, str]  # tags of the way
    points: FloatArray  # (k, 2) m, in the direction of traffic if one-way
    rank: Rank  # kind of road
    oneway: bool  # whether cars may drive only in the order of the points
    # whether the points are in reverse order of the way, which swaps its tags for left and right
    turned: bool
    left_hand: bool = False  # whether cars keep to the left

    @property
    def near_side(self) -> Side:
        """The side on which cars drive in the order of the points, if the road is two-way."""
        return "left" if self.left_hand else "right"

    def side_of_way(self, side: Side) -> Side:
        return ("right" if side == "left" else "left") if self.turned else side

    @property
    def half_width(self) -> float:
        """Distance from the centre line to the edge of the carriageway without parked cars, m."""
        width = metres(self.tags.get("width"))
        if width is not None and not self.has_kerb_parking:
            return width / 2
        lanes = metres(self.tags.get("lanes"))
        if lanes is not None:
            return lanes * LANE_WIDTH / 2
        if self.rank is Rank.AISLE:
            return AISLE_WIDTH / 2
        if self.oneway:
            return ONE_WAY_HALF_WIDTH
        return STREET_WIDTH[self.tags["highway"].removesuffix("_link")] / 2

    @property
    def limit(self) -> float:
        """The speed limit, km/h: as tagged, else that of the class."""
        text = self.tags.get("maxspeed", "").strip()
        match = re.fullmatch(r"(\d{1,3})(?: ?(mph|km/h|kmh))?", text)
        if match:
            tagged = float(match[1]) * (1.609 if match[2] == "mph" else 1.0)
        else:
            tagged = _NAMED_LIMITS.get(text.rpartition(":")[2], 0.0)
        is_aisle = self.rank is Rank.AISLE
        return tagged or (_AISLE_LIMIT if is_aisle else LIMITS[self.tags["highway"].removesuffix("_link")])

    @property
    def has_kerb_parking(self) -> bool:
        """Whether parking along the road is tagged; `width` then includes parked cars."""
        return any(key.startswith("parking:") for key in self.tags)


def road_of(
    element_id: str, tags: Mapping[str, str], points: FloatArray, *, town: bool = False
) -> Road | str | None:
    """Create a road from a way, (k, 2) m; return a reason if it is left out, None if it is no road for cars.

    In a town, motorways, tunnels and private ways to private parking count, too.
    """
    kind = tags.get("highway", "").removesuffix("_link")
    if kind not in STREET_WIDTH or tags.get("area") == "yes" or (kind == "motorway" and not town):
        return None
    service = tags.get("service")
    if kind == "service" and service in NOT_FOR_PARKING:
        return f"roads with service={service}"
    reason = closed_to_cars(tags)
    if town and kind == "service" and (reason or "").endswith("=private"):
        reason = None
    if reason := reason or (off_the_ground(tags) if not town or kind == "service" else None):
        return f"roads with {reason}"
    as_built = kind == "motorway" or tags.get("junction") in ("roundabout", "circular")
    oneway = tags.get("oneway", "yes" if as_built else "no")
    turned = oneway in ("-1", "reverse")
    step = np.diff(points, axis=0)
    points = points[np.r_[True, np.hypot(step[:, 0], step[:, 1]) > 0.01]]
    if len(points) < 2:
        return "roads without a length"
    rank = Rank.STREET
    if kind == "service":
        rank = Rank.AISLE if service == "parking_aisle" else Rank.SERVICE
    return Road(
        id=element_id,
        tags=tags,
        points=points[::-1] if turned else points,
        rank=rank,
        oneway=turned or oneway in ("yes", "true", "1"),
        turned=turned,
    )


def read_roads(
    elements: Sequence[OsmElement],
    frame: LocalFrame,
    left_out: dict[str, list[str]],
    *,
    town: bool = False,
    left_hand: bool = False,
) -> list[Road]:
    """Return the roads for cars, which end before nodes that stop these."""
    roads: list[Road] = []
    barriers = barriers_of(elements)
    met: dict[str, dict[str, None]] = {}  # ids of the barriers on roads
    at = cKDTree(frame.to_xy([e.lines[0][0] for e in barriers]))
    for element in elements:
        if element.is_node or "highway" not in element.tags:
            continue
        for line in element.lines:
            road = road_of(element.id, element.tags, frame.to_xy(line), town=town)
            if isinstance(road, Road):
                road = replace(road, left_hand=left_hand)
                for key in (*ACCESS, "oneway"):
                    note_unread(element.tags, f"{key}:conditional", "as without it")
                roads += _parts_between(road, barriers, at, met)
            elif road is not None and element.id not in left_out.setdefault(road, [])[-1:]:
                left_out[road].append(element.id)
    left_out.update({reason: list(ids) for reason, ids in met.items()})
    return roads


def barriers_of(elements: Iterable[OsmElement]) -> list[OsmElement]:
    return [e for e in elements if e.is_node and stops_cars(e.tags)]


def stops_cars(tags: Mapping[str, str]) -> bool:
    """Whether cars cannot pass a node: a barrier, or one that is closed to motor vehicles.

    Access tags decide; what is locked opens only to vehicles that are named.
    """
    kind = tags.get("barrier")
    named = any(key in tags for key in ("motorcar", "motor_vehicle", "vehicle"))
    if kind is None or closed_to_cars(tags):
        on_street = kind is not None or not {"amenity", "entrance", "building", "shop"}.intersection(tags)
        return closed_to_cars(tags) is not None and on_street and (kind is not None or named)
    if named or (tags.get("locked") != "yes" and "access" in tags):
        return False
    is_open = tags.get("locked") == "no" or (kind == "kerb" and tags.get("kerb") not in ("raised", "regular"))
    return tags.get("locked") == "yes" or not (kind in PASSABLE or is_open)


def _parts_between(
    road: Road, barriers: Sequence[OsmElement], at: cKDTree, met: dict[str, dict[str, None]]
) -> list[Road]:
    """Return the parts of a road that end before the barriers on it."""
    stops = np.zeros(len(road.points), bool)
    near: Any = at.query_ball_point(road.points, NODE_TOLERANCE)
    for i, each in enumerate(near):
        for tags, name in ((barriers[k].tags, barriers[k].id) for k in each):
            is_usual = tags.get("barrier") in ASSUMED_OPEN and tags.get("locked") != "yes"
            if road.rank is not Rank.STREET and is_usual and not closed_to_cars(tags):
                note_unread(tags, "barrier", "open to cars on a service road")
                continue
            stops[i] = True
            what = f"barrier={tags['barrier']}" if "barrier" in tags else str(closed_to_cars(tags))
            met.setdefault(f"roads through {what}", {})[name] = None
    last = len(stops) - 1
    cuts = [i for i, stop in enumerate(stops) if stop or i in (0, last)]
    parts = []
    for i, j in pairwise(cuts):
        points = road.points[i : j + 1].copy()
        for is_cut, end, inner in ((stops[i], 0, 1), (stops[j], -1, -2)):
            step = points[inner] - points[end]
            points[end] += is_cut * min(BARRIER_GAP / np.hypot(*step), 0.4) * step
        parts.append(replace(road, points=points))
    return parts


ACCESS = ("motorcar", "motor_vehicle", "vehicle", "access")  # keys of access, the most specific first
# Values of access, and keys whose value `only` says the same, that let no ordinary car in.
NOT_CARS = (
    *("no", "agricultural", "forestry", "military", "emergency", "hgv", "goods", "bus", "psv", "taxi", "coach"),
    *("tourist_bus", "motorcycle", "moped", "bicycle", "foot", "caravan", "motorhome", "horse", "trailer"),
)  # fmt: skip


def decisive_access(tags: Mapping[str, str], prefix: str = "") -> str | None:
    """Return the most specific key of access that the tags have after a prefix, or None."""
    return next((key for key in ACCESS if prefix + key in tags), None)


def closed_to_cars(tags: Mapping[str, str], *, private: bool = True) -> str | None:
    """Return the tag that excludes cars (the most specific access tag decides), or None."""
    for other in NOT_CARS:
        if tags.get(other) == "only":
            return f"{other}=only"
    key = decisive_access(tags)
    if key is not None:
        closed = {*NOT_CARS, "delivery", "official", "private"} if private else {*NOT_CARS}
        values = re.split(r"\s*[;,]\s*", tags[key].strip().lower())
        return f"{key}={tags[key]}" if closed.issuperset(values) else None
    if tags.get("highway") == "service":
        return next(
            (f"{key}=designated" for key in ("emergency", "bus", "psv") if tags.get(key) == "designated"),
            None,
        )
    return None


def off_the_ground(tags: Mapping[str, str]) -> str | None:
    is_off = {
        "tunnel": tags.get("tunnel", "no") not in ("no", "building_passage"),
        "location": tags.get("location") in ("underground", "indoor", "roof"),
        "indoor": tags.get("indoor", "no") != "no",
        "level": tags.get("level", "0") != "0",
        "layer": tags.get("layer", "0").startswith("-"),
    }
    return next((f"{key}={tags[key]}" for key, off in is_off.items() if off), None)


def metres(text: str | None) -> float | None:
    """Parse a length, m, such as `6` or `6.5 m`; None for anything else."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*m?\s*", text or "")
    value = float(match[1]) if match else 0.0
    return value if 0.0 < value < 100.0 else None


_COUNT = re.compile(
    r"(?:[^\W\d]{1,15}\.?|[~>≥<≤±=+]|\s){0,4}([0-9]{1,5})(?:\.0+)?(?:\s*(?:-|–|to|bis)\s*([0-9]{1,5}))?"
    r"(?:[^\W\d]|[\s+.~]){0,20}(?:\(.*\))?"
)


def whole_number(text: str | None) -> int | None:
    """Parse a count, also of texts such as `approx 110`, `50+`, `60 (5 women)`, `1,500`; the middle of `20-30`."""
    plain = re.sub(r"(?<=\d)[,. '](?=\d{3}(?!\d))", "", (text or "").strip())
    match = _COUNT.fullmatch(plain)
    return (int(match[1]) + int(match[2] or match[1])) // 2 if match else None


def count_in(tags: Mapping[str, str], key: str, assumed: str) -> int | None:
    """Return the count that a tag says; a text that is none is listed with what is assumed instead."""
    count = whole_number(tags.get(key))
    if count is None or re.search(r"\d\s*[-–]\s*\d", tags[key]):
        note_unread(tags, key, assumed if count is None else f"{count}, the middle")
    return count


def lanes_of(roads: Sequence[Road]) -> list[Lane]:
    return [Lane(road.points, road.oneway) for road in roads]


def clipped_roads(roads: Sequence[Road], box: shapely.Geometry) -> list[Road]:
    return [part for road in roads for part in _clipped(road, box)]


def _clipped(road: Road, box: shapely.Geometry) -> list[Road]:
    line = shapely.LineString(road.points)
    if shapely.covers(box, line):
        return [road]
    parts = []
    for part in shapely.get_parts(shapely.intersection(line, box)):
        if part.geom_type != "LineString" or part.length < 1.0:
            continue
        points = shapely.get_coordinates(part)
        ends = [line.project(shapely.Point(point)) for point in points[:2]]
        parts.append(replace(road, points=points[::-1] if ends[0] > ends[1] else points))
    return parts


def used_roads(roads: Sequence[Road], around: Sequence[Road], slots: Slots) -> list[Road]:
    """Return the roads connected to slots, without service roads that lead neither to a slot nor to one `around`."""
    kept = [road for part in components_with_slots(roads, slots) for road in part]
    nodes = [set(labels.tolist()) for labels in _road_nodes([*kept, *around])]
    users = Counter(node for own in nodes for node in own)
    needed = _serving_roads(kept, slots) | {k for k, road in enumerate(kept) if road.rank is Rank.STREET}
    left = list(range(len(kept)))
    while loose := {k for k in left if k not in needed and sum(users[n] > 1 for n in nodes[k]) < 2}:
        users.subtract(node for k in loose for node in nodes[k])
        left = [k for k in left if k not in loose]
    return [kept[k] for k in left]


def open_ends(roads: Sequence[Road], edge: shapely.Geometry, blind: FloatArray) -> FloatArray:
    """Return ends of streets at the edge of the map, (n, 2) m, else all but `blind` ones: there cars may enter."""
    ends = [
        xy
        for road, xy, is_first in road_ends(roads)
        if road.rank is Rank.STREET and (is_first or not road.oneway)
    ]
    xy = np.array(ends).reshape(-1, 2)
    at_edge = shapely.dwithin(shapely.get_exterior_ring(edge), np.asarray(shapely.points(xy)), 0.1)
    if at_edge.any():
        return xy[np.flatnonzero(at_edge)]
    if len(blind):
        xy = xy[np.flatnonzero(cKDTree(blind).query(xy)[0] > BARRIER_GAP + 0.1)]
    return xy


def _road_nodes(roads: Sequence[Road]) -> list[IntArray]:
    """Return the node labels of the points of each road; roads meet where they share a label."""
    if not roads:
        return []
    label = node_labels(np.concatenate([road.points for road in roads]))
    return np.split(label, np.cumsum([len(road.points) for road in roads])[:-1])


def _serving_roads(roads: Sequence[Road], slots: Slots) -> set[int]:
    if not roads or not len(slots):
        return set()
    lines = np.array([shapely.LineString(road.points) for road in roads])
    return set(np.asarray(shapely.STRtree(lines).nearest(shapely.points(slots.mouths()))).tolist())


def components_with_slots(roads: Sequence[Road], slots: Slots) -> list[list[Road]]:
    if not roads:
        return []
    along = _road_nodes(roads)
    road = np.repeat(np.arange(len(roads)), [len(p) for p in along])
    label = np.concatenate(along)
    n = len(roads) + int(label.max()) + 1
    part = component_labels(np.column_stack([road, len(roads) + label]), n)[: len(roads)]
    serving = {int(part[k]) for k in _serving_roads(roads, slots)}
    return [[r for r, p in zip(roads, part, strict=True) if p == k] for k in sorted(serving)]


def street_junctions(roads: Sequence[Road], streets: Sequence[Road]) -> FloatArray:
    along = _road_nodes([*roads, *streets])
    public = {label for labels in along[len(roads) :] for label in labels.tolist()}
    shared: dict[int, FloatArray] = {}
    for road, on_road in zip(roads, along, strict=False):
        # Cars cannot enter at the end of a one-way road.
        last = len(on_road) - 1 if road.oneway else len(on_road)
        for i in range(last):
            if int(on_road[i]) in public:
                shared.setdefault(int(on_road[i]), road.points[i])
    return np.array(list(shared.values())).reshape(-1, 2)


def road_ends(roads: Sequence[Road]) -> list[tuple[Road, FloatArray, bool]]:
    """Return unshared road ends: the road, the point, (2,) m, and whether it is the road's first point."""
    along = _road_nodes(roads)
    users = np.bincount(np.concatenate([np.empty(0, np.int64), *along]))
    return [
        (road, road.points[i], i == 0)
        for road, on_road in zip(roads, along, strict=True)
        for i in (0, -1)
        if users[on_road[i]] == 1
    ]


# Why turns are left out.
NO_LANE, SPLIT, CUTS = (
    "on streets that are no lanes",
    "at a junction that is split",
    "that would cut streets off",
)


class Turns(NamedTuple):
    """The turns of a lot, a line that counts the restrictions of the map, if there are any, and those left out."""

    kept: tuple[Turn, ...]
    found: tuple[str, ...]
    left_out: tuple[LeftOut, ...]


def turns_of(
    place: OsmMap, frame: LocalFrame, whole: Sequence[Lane], lanes: Sequence[Lane], *, away: bool = True
) -> Turns:
    """Return the turns of a lot; restrictions away from its lanes are listed if `away`.

    Left out are those on no lane, at split junctions (`whole` are the lanes before), and that would cut streets off.
    """
    named = [(turn.id, Turn(frame.to_xy(turn.line), turn.only)) for turn in place.turns]
    why = [NO_LANE] * len(named)
    if named and lanes:
        at = np.array([turn.points[1] for _, turn in named])
        before, after = _arms_at(whole, at), _arms_at(lanes, at)
        if not away:
            named = [named[i] for i in np.flatnonzero(before).tolist()]
            before, after = before[before > 0], after[before > 0]
        why = _reasons(lanes, [turn for _, turn in named], (before != after).tolist())
    kept = {relation for (relation, _), reason in zip(named, why, strict=True) if not reason}
    listed: dict[str, dict[str, None]] = {}
    for (relation, _), reason in zip(named, why, strict=True):
        if relation not in kept:
            listed.setdefault(reason, {})[relation] = None
    left_out = (*LeftOut.by_reason(listed), *(place.turns_left_out if away else ()))
    n_out = sum(len(left.ids) for left in left_out)
    reasons = ", ".join(f"{left.reason}: {len(left.ids)}" for left in left_out)
    line = f"turn restrictions: {len(kept)} kept" + (f", {n_out} left out ({reasons})" if n_out else "")
    return Turns(
        tuple(turn for (_, turn), reason in zip(named, why, strict=True) if not reason),
        (line,) if kept or n_out else (),
        tuple(LeftOut(f"turn restrictions {left.reason}", left.ids) for left in left_out),
    )


def _arms_at(lanes: Sequence[Lane], at: FloatArray) -> IntArray:
    arms = np.concatenate([np.r_[1, np.full(len(lane.points) - 2, 2), 1] for lane in lanes])
    near = cKDTree(np.concatenate([lane.points for lane in lanes])).query_ball_point(at, NODE_TOLERANCE)
    return np.array([arms[those].sum() for those in near], np.int64)


def _reasons(lanes: Sequence[Lane], turns: Sequence[Turn], split: Sequence[bool]) -> list[str]:
    chains = centrelines([(lane.points, lane.oneway, lane.speed) for lane in lanes]).chains
    rules = rules_of(chains, [(turn.points, turn.only) for turn in turns])
    why = [
        SPLIT if is_split else "" if isinstance(rule, Rule) else NO_LANE
        for is_split, rule in zip(split, rules, strict=True)
    ]
    left = [(i, rule) for i, rule in enumerate(rules) if isinstance(rule, Rule) and not why[i]]
    kept = _without_cuts(chains, [rule for _, rule in left])
    for (i, _), fits in zip(left, kept.tolist(), strict=True):
        why[i] = "" if fits else CUTS
    return why


def _without_cuts(chains: Chains, rules: Sequence[Rule]) -> BoolArray:
    """Return which rules leave each chain connected with the others, (n,) bool: those that do not are tried last."""
    whole, of = connected(chains, []), np.array([rule.chain for rule in rules], np.int64)
    node, inside = chains.last[of], whole[of]
    kept = inside.copy()

    def lost() -> BoolArray:
        return whole & ~connected(chains, [rules[i] for i in np.flatnonzero(kept).tolist()])

    while (cut := np.flatnonzero(lost())).size:
        touching = kept & np.isin(node, [chains.first[cut], chains.last[cut]])
        kept &= ~(touching if touching.any() else kept)
    for i in np.flatnonzero(inside & ~kept).tolist():
        kept[i] = True
        kept[i] = not lost().any()
    return kept
