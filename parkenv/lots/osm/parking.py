"""The parking of a map: drawn spaces, areas filled by rule and kerbs; and buildings as goals and walls.

Both tagging schemes of kerbs are read: `parking:left|right|both` with `:orientation`, `:capacity`, `:restriction` and
`:access`, and the deprecated `parking:lane:left|right|both` with `parking:condition:...`; a lot has kerbs where
everybody may park at some hours. A capacity of `both` applies to each side.
"""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.errors import InputError
from parkenv.lots.generators import (
    BAY_SIZE,
    KERB_SIZE,
    NO_SLOTS,
    Slots,
    nearest_on_lanes,
    slots_from_polygons,
)
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.osm.conditions import FORBIDDEN, kerb_tag, kerb_users, note_other_keys, users_of
from parkenv.lots.osm.elements import OsmElement
from parkenv.lots.osm.roads import (
    SIDES,
    Rank,
    Road,
    Side,
    closed_to_cars,
    count_in,
    metres,
    off_the_ground,
    whole_number,
)
from parkenv.lots.unread import note_unread
from parkenv.world.drive_graph import SLOT_REACH, linestrings, node_labels
from parkenv.world.lot import Lane, Mouth
from parkenv.world.tariff import PUBLIC


@dataclass(frozen=True)
class Arrangement:
    angle: float  # angle between the road and the cars, rad, from 0 (along it) to π/2 (across)
    length: float  # length of a slot, m
    width: float  # width of a slot, m

    @property
    def pitch(self) -> float:
        return self.length if self.angle == 0.0 else self.width / float(np.sin(self.angle))


# Arrangement for each value of OpenStreetMap's `orientation`; diagonal cars park at 60°.
ARRANGEMENTS = {
    "parallel": Arrangement(0.0, *KERB_SIZE),
    "diagonal": Arrangement(np.pi / 3, *BAY_SIZE),
    "perpendicular": Arrangement(np.pi / 2, *BAY_SIZE),
}
DRAWN = 0.05  # tolerance, m, of the length of a row: OpenStreetMap's seven digits round to a centimetre


def orientation_of(tags: Mapping[str, str]) -> str | None:
    """Return the key of `ARRANGEMENTS` that an area is tagged with, or None."""
    name = tags.get("orientation", tags.get("parking:orientation"))
    return name if name in ARRANGEMENTS else None


class RowAnchors(NamedTuple):
    """Anchors of a row's slots: n points on the road's centre line."""

    xy: FloatArray  # (n, 2) m
    along: FloatArray  # (n, 2) unit vectors in the order of the road's points
    outward: FloatArray  # (n, 2) unit vectors toward the slots


def row_anchors(points: FloatArray, stations: FloatArray, pitch: float, side: Side) -> RowAnchors:
    """Return anchors on a road, (k, 2) m, at stations, (n,) m from its start; a slot takes `pitch` m of the road."""
    run = np.r_[0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T))]
    ends = [
        np.stack([np.interp(stations + half, run, points[:, i]) for i in (0, 1)], axis=1)
        for half in (-pitch / 2, pitch / 2)
    ]
    chord = ends[1] - ends[0]
    along = chord / np.hypot(chord[:, 0], chord[:, 1])[:, None]
    left = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return RowAnchors((ends[0] + ends[1]) / 2, along, left if side == "left" else -left)


def row_at(anchors: RowAnchors, offset: FloatArray | float, how: Arrangement, *, with_points: bool) -> Slots:
    """Create a row, its near edge `offset` m from the centre line; cars pass it `with_points` or against them."""
    heading = anchors.along if with_points else -anchors.along
    outward = anchors.outward
    reach = np.broadcast_to(np.asarray(offset, dtype=np.float64), len(outward))[:, None]
    nose = np.cos(how.angle) * heading + np.sin(how.angle) * outward
    if how.angle == 0.0:
        center = anchors.xy + (reach + how.width / 2) * outward
        on_right = heading[:, 1] * outward[:, 0] - heading[:, 0] * outward[:, 1] > 0.0
        mouth = np.where(on_right, Mouth.LEFT, Mouth.RIGHT)
    else:
        # The near corner of an angled slot touches the edge, so the middle of its mouth is behind it.
        center = anchors.xy + (reach + how.width / 2 * np.cos(how.angle)) * outward + how.length / 2 * nose
        mouth = np.full(len(outward), int(Mouth.REAR))
    return Slots(
        xy=center,
        yaw=np.arctan2(nose[:, 1], nose[:, 0]),
        length=np.full(len(outward), how.length),
        width=np.full(len(outward), how.width),
        mouth=mouth.astype(np.int8),
    )


def bend_factor(points: FloatArray, start: float, end: float, side: Side, reach: float) -> float:
    """Return how much more of the road, at least 1, slots need on the inside of a bend, `reach` m beside it."""
    n = max(int((end - start) / 2.0), 2)
    step = (end - start) / n
    stations = np.asarray(start + (np.arange(n) + 0.5) * step, dtype=np.float64)
    xy, _, outward = row_anchors(points, stations, step, side)
    beside = np.diff(xy + reach * outward, axis=0)
    return max(1.0, (end - start) * (n - 1) / n / max(float(np.hypot(beside[:, 0], beside[:, 1]).sum()), 0.1))


def without_overlaps(boxes: NDArray[np.object_]) -> BoolArray:
    """Return the mask, (n,), of rectangles to keep so that none overlap; earlier ones take precedence."""
    kept = np.ones(len(boxes), dtype=bool)
    if len(boxes) < 2:
        return kept
    later, earlier = shapely.STRtree(boxes).query(boxes, predicate="intersects")
    order = np.lexsort((earlier, later))
    for i, j in zip(later[order].tolist(), earlier[order].tolist(), strict=True):
        if j < i and kept[j]:
            kept[i] = False
    return kept


PARKED = ("lane", "street_side", "on_kerb", "half_on_kerb", "shoulder", "yes")
OLD_ORIENTATIONS = {
    **{name: name for name in ARRANGEMENTS},
    **{"inline": "parallel", "orthogonal": "perpendicular", "marked": "parallel", "yes": "parallel"},
}
# Distance from the kerbs' corner at a junction, and from a pedestrian crossing, to the first car, m.
CORNER_CLEARANCE = 5.0
DRIVEWAY_CLEARANCE = 1.0  # distance from the edge of a joining service road to the first car, m
# Smallest slot length, m, if a tagged capacity needs more slots than fit at the usual length.
SHORTEST_KERB_SLOT = 5.0
ROUNDING = 1e-6  # m, shorter intervals are none
# Largest angle between an arm and the street at which the arm continues the street.
STRAIGHT_ON = np.radians(30.0)


@dataclass(frozen=True)
class Kerb:
    orientation: str  # a key of `ARRANGEMENTS`
    capacity: int | None  # number of slots; None if not tagged
    on_carriageway: bool  # whether parked cars are within `width`


def kerb_of(
    road: Road, side: Side, left_out: Mapping[str, list[str]], *, reserved: bool = False
) -> Kerb | None:
    """Return the tagged parking on one side of a road; None without tags, or if they are unusable, which is listed.

    With `reserved`, kerbs for a class of users are usable, too.
    """
    tags, side = road.tags, road.side_of_way(side)
    key, lane = kerb_tag(tags, "parking:{}", side), kerb_tag(tags, "parking:lane:{}", side)
    kind, old = tags.get(key), tags.get(lane)
    if kind in ("no", "separate") or (
        kind is None and (old is None or old in ("no", "none", "separate", "drawn_separately"))
    ):
        return None
    orientation = tags.get(kerb_tag(tags, "parking:{}:orientation", side)) or "parallel"
    if kind is None:
        orientation = OLD_ORIENTATIONS.get(old or "", "parallel" if users_of(old or "") == FORBIDDEN else "")
    if orientation not in ARRANGEMENTS or (kind is not None and kind not in PARKED):
        note_unread(tags, lane if kind is None else key, "no parking")
        named = f"parking:lane={old}" if kind is None else f"parking={kind}, orientation={orientation}"
        left_out[f"kerbs with {named}, which is not known"].append(f"{road.id}-{side}")
        return None
    users, minutes = kerb_users(tags, side)
    if users == FORBIDDEN or not minutes.any() or (users != PUBLIC and not reserved):
        by_name = {"restriction=": "parking:{}:restriction", "access=": "parking:{}:access"}
        if kind is None:
            by_name = {"": "parking:condition:{}", " ": "parking:lane:{}"}
        reasons = ((name, tags.get(kerb_tag(tags, text, side), "")) for name, text in by_name.items())
        closed = (
            f"{name.strip()}{value}" for name, value in reasons if users_of(value) not in (PUBLIC, None)
        )
        left_out[f"kerbs with {next(closed, 'rules that forbid parking')}"].append(f"{road.id}-{side}")
        return None
    note_other_keys(tags)
    counted = ("parking:{}:capacity",) if kind else ("parking:lane:{}:capacity", "parking:{}:capacity")
    counts = (count_in(tags, kerb_tag(tags, text, side), "by the length of the kerb") for text in counted)
    capacity = next((count for count in counts if count is not None), None)
    where = kind or tags.get(kerb_tag(tags, f"parking:lane:{{}}:{old}", side)) or "on_street"
    return Kerb(orientation, capacity, where in ("lane", "on_street"))


def kerb_slots(road: Road, side: Side, kerb: Kerb, free: Sequence[tuple[float, float]]) -> Slots:
    """Create the slots along one side of a road, in the order of its points, on the free intervals.

    As many as tagged, at most as fit at 5 m, or else as fit at 6 m (2.5 m across the street). A tagged `width` includes
    cars parked on the carriageway.
    """
    how = ARRANGEMENTS[kerb.orientation]
    parallel = how.angle == 0.0
    least = SHORTEST_KERB_SLOT if parallel and kerb.capacity is not None else how.pitch
    depth = how.width if parallel else how.length * float(np.sin(how.angle))
    offset = road.half_width
    width = metres(road.tags.get("width"))
    if width is not None:
        offset = max(width / 2 - depth, 1.5) if kerb.on_carriageway else width / 2
    bend = [bend_factor(road.points, start, end, side, offset + depth) for start, end in free]
    fit = np.array(
        [int((end - start + DRAWN) / (least * more)) for (start, end), more in zip(free, bend, strict=True)],
        dtype=np.int64,
    )
    count = fit if kerb.capacity is None else _distribute(kerb.capacity, free, fit)

    rows = [NO_SLOTS]
    for (start, end), n, more in zip(free, count.tolist(), bend, strict=True):
        step = (end - start) / max(n, 1) if parallel else how.pitch * more
        middle, ranks = (start + end) / 2, np.arange(n) - (n - 1) / 2
        fitted = replace(how, length=min(how.length, step / more)) if parallel else how
        anchors = row_anchors(road.points, middle + ranks * step, fitted.pitch, side)
        rows.append(row_at(anchors, offset, fitted, with_points=road.oneway or side == road.near_side))
    return Slots.joined(rows)


def _distribute(capacity: int, free: Sequence[tuple[float, float]], fit: IntArray) -> IntArray:
    count = np.zeros(len(fit), dtype=np.int64)
    length = np.array([end - start for start, end in free])
    for _ in range(min(capacity, int(fit.sum()))):
        # The next slot goes to the interval with the most room per slot.
        count[int(np.argmax(np.where(count < fit, length / (count + 1), -1.0)))] += 1
    return count


class Junctions:
    """The junctions of roads and pedestrian crossings, (n, 2) m, and the parts of kerbs that they keep free."""

    def __init__(self, roads: Sequence[Road], crossings: FloatArray) -> None:
        self._roads = roads
        label = node_labels(np.concatenate([road.points for road in roads] + [crossings]))
        self._first = np.cumsum([0] + [len(road.points) for road in roads])
        self._label = label
        self._crossings = set(label[self._first[-1] :].tolist())
        # For every node, its arms: road, unit vector.
        self._arms: dict[int, list[tuple[int, FloatArray]]] = defaultdict(list)
        for k, road in enumerate(roads):
            for i, at in enumerate(label[self._first[k] : self._first[k + 1]].tolist()):
                for j in (i - 1, i + 1):
                    if 0 <= j < len(road.points):
                        away = road.points[j] - road.points[i]
                        self._arms[at].append((k, away / np.hypot(*away)))

    def free_intervals(
        self, k: int, side: Side, closed: Iterable[tuple[float, float]] = ()
    ) -> list[tuple[float, float]]:
        """Return the intervals for parking on a side of road k, start and end in m from its start, but for closed ones.

        At streets, both sides are kept clear for 5 m beyond the corner and its parked cars; at service roads, their
        side.
        """
        points, closed = self._roads[k].points, list(closed)
        steps = np.hypot(*np.diff(points, axis=0).T)
        stations = np.r_[0.0, np.cumsum(steps)].tolist()
        for i, station in enumerate(stations):
            at = int(self._label[self._first[k] + i])
            clearances = [CORNER_CLEARANCE] if at in self._crossings else []
            if len(self._arms[at]) > 2:
                tangent = points[min(i + 1, len(points) - 1)] - points[max(i - 1, 0)]
                clearances += self._clearances(k, at, tangent / np.hypot(*tangent), side)
            closed += [(station - clearance, station + clearance) for clearance in clearances]
        free, start, total = [], 0.0, float(steps.sum())
        for begin, end in (*sorted(closed), (total, total)):
            if min(begin, total) - start > ROUNDING:
                free.append((start, min(begin, total)))
            start = max(start, end)
        return free

    def _clearances(self, k: int, at: int, tangent: FloatArray, side: Side) -> Iterator[float]:
        for other, away in self._arms[at]:
            across = float(tangent[0] * away[1] - tangent[1] * away[0])  # positive to the left
            if other == k or abs(np.arcsin(np.clip(across, -1.0, 1.0))) < STRAIGHT_ON:
                continue
            road = self._roads[other]
            if road.rank is Rank.STREET:
                yield road.half_width + KERB_SIZE[1] + CORNER_CLEARANCE
            elif (across > 0.0) == (side == "left"):
                yield road.half_width + DRIVEWAY_CLEARANCE


OUTLINE_TOLERANCE = 0.4  # largest overhang, m, of a slot beyond the outline: the accuracy of mapped outlines
# Trial offsets of a row along its aisle, as fractions of a slot's width; the one with the most slots is used.
PHASES = (0.0, 0.25, 0.5, 0.75)
CORRIDOR = 0.8  # fraction of a road's half width that must be clear of slots of other roads


def corridors_of(roads: Sequence[Road], blocked: Sequence[shapely.Geometry] = ()) -> shapely.STRtree:
    """Return what of roads must be clear of slots, and what is blocked besides."""
    widths = [CORRIDOR * road.half_width for road in roads]
    corridors = shapely.buffer(linestrings([road.points for road in roads]), widths, cap_style="flat")
    return shapely.STRtree([*corridors, *blocked])


def is_clear(slots: Slots, taken: shapely.STRtree, shrink: float) -> BoolArray:
    """Return which slots, made smaller by `shrink` m, meet nothing that is taken, (n,)."""
    met = taken.query(slots.boxes(shrink), predicate="intersects")[0]
    return ~np.isin(np.arange(len(slots)), met)


def fill_outline(
    outline: shapely.Geometry,
    roads: Sequence[Road],
    blocked: Sequence[shapely.Geometry],
    orientation: str | None,
    capacity: int | None,
) -> Slots:
    """Fill an area with rows of slots along both sides of the roads, clear of these and of blocked areas.

    Cars park across the road unless an orientation is given or only slots along it fit. A slot's mouth is nearest
    to its own road. Rows with more slots come first; those beyond the capacity are dropped.
    """
    if not roads:
        return NO_SLOTS
    lines = np.array([shapely.LineString(road.points) for road in roads])
    taken = corridors_of(roads, blocked)
    roomy = shapely.buffer(outline, OUTLINE_TOLERANCE)
    shapely.prepare(roomy)

    rows: list[Slots] = []
    for k, road in enumerate(roads):
        for start, end in _intervals(lines[k], outline):
            for side in SIDES:
                tries = [
                    _row(road, side, start + phase * how.pitch, end, how, outline)
                    for name, how in ARRANGEMENTS.items()
                    if name == orientation or (orientation is None and name != "diagonal")
                    for phase in PHASES
                ]
                rows.append(max((_fitting(row, roomy, taken, lines, k) for row in tries), key=len))
    rows.sort(key=len, reverse=True)
    slots = Slots.joined(rows)
    slots = slots[without_overlaps(slots.boxes(shrink=0.02))]
    return slots if capacity is None else slots[:capacity]


def _intervals(line: shapely.LineString, outline: shapely.Geometry) -> list[tuple[float, float]]:
    parts = shapely.get_parts(shapely.intersection(line, shapely.buffer(outline, SLOT_REACH)))
    ends = [
        sorted(line.project(shapely.Point(xy)) for xy in shapely.get_coordinates(part)[[0, -1]])
        for part in parts
        if part.length > 0.0
    ]
    # A ring road through the area starts and ends at the same point.
    return [(0.0, line.length) if end - start < 1e-6 else (float(start), float(end)) for start, end in ends]


def _row(
    road: Road, side: Side, start: float, end: float, how: Arrangement, outline: shapely.Geometry
) -> Slots:
    n = max(int((end - start + DRAWN) / how.pitch), 0)
    stations = np.asarray(start + (np.arange(n) + 0.5) * how.pitch, dtype=np.float64)
    anchors = row_anchors(road.points, stations, how.pitch, side)
    rays = shapely.linestrings(np.stack([anchors.xy, anchors.xy + SLOT_REACH * anchors.outward], axis=1))
    hit = shapely.distance(shapely.points(anchors.xy), shapely.intersection(rays, outline))
    reached = np.isfinite(np.atleast_1d(hit))
    offset = np.maximum(np.where(reached, hit, 0.0), road.half_width)
    return row_at(anchors, offset, how, with_points=road.oneway or side == road.near_side)[reached]


def _fitting(
    slots: Slots, roomy: shapely.Geometry, taken: shapely.STRtree, lines: NDArray[np.object_], own: int
) -> Slots:
    if not len(slots):
        return slots
    fits = shapely.covers(roomy, slots.boxes(shrink=0.02)) & is_clear(slots, taken, 0.02)
    mouth = slots.mouths()
    distance = shapely.distance(np.asarray(shapely.points(mouth))[:, None], lines[None])
    fits &= distance[:, own] <= np.minimum(distance.min(axis=1) + 1e-6, SLOT_REACH)
    # The nearest point of a road that ends or bends may be behind the mouth.
    on_line = shapely.get_coordinates(
        shapely.line_interpolate_point(
            lines[own], shapely.line_locate_point(lines[own], shapely.points(mouth))
        )
    )
    ahead = ((on_line - mouth) * slots.outward()).sum(axis=1) > 0.0
    return slots[fits & ahead]


ENTRANCE_REACH = 100.0  # largest distance, m, from the nearest slot of a building entrance that is a goal
BUILDING_REACH = 200.0  # the same for the nearest building if there is no entrance
NOT_GOALS = ("no", "garage", "emergency", "exit", "service")  # values of `entrance` that are not goals
# Values of `building` that are not goals.
NOT_WALKED_TO = ("garage", "garages", "carport", "roof", "shed", "parking", "hut", "no", "transformer_tower")


class CrossedOutlineError(InputError):
    """An outline crosses itself."""


@dataclass(frozen=True, eq=False)
class Area:
    """A closed element and its outline, m in the lot's frame."""

    element: OsmElement
    polygon: shapely.Geometry

    @classmethod
    def of(cls, element: OsmElement, frame: LocalFrame, *, simple: bool) -> Self:
        """Return the area of a closed element; outlines that cross themselves are refused if `simple`, else mended."""
        if not element.is_closed:
            raise InputError(f"{element.id}: its outline is open, want its first position again at the end")
        outer, holes = (
            [shapely.Polygon(frame.to_xy(line)) for line in lines] for lines in (element.lines, element.holes)
        )
        for polygon in (*outer, *holes):
            if simple and not element.cut and not polygon.is_valid:
                reason = shapely.is_valid_reason(polygon).split("[")[0]
                fault = CrossedOutlineError if polygon.area > 0.0 else InputError
                raise fault(f"{element.id}: its outline is not a simple one: {reason}")
        if element.tags.get("amenity") == "parking_space" and simple and len(outer) == 1 and not holes:
            # The rectangle of a space depends on the corner that its outline begins at; a union would move it.
            return cls(element, outer[0])
        whole, gaps = (shapely.union_all(shapely.make_valid(part)) for part in (outer, holes))
        shape = shapely.difference(whole, gaps)
        parts = shapely.get_parts(shape)
        areas = [part for part in parts if part.geom_type == "Polygon" and part.area > 0.0]
        return cls(element, shape if len(areas) == len(parts) else shapely.union_all(areas))


def areas_of(
    elements: Sequence[OsmElement],
    frame: LocalFrame,
    wanted: Callable[[OsmElement], bool],
    *,
    mended: bool = False,
) -> list[Area]:
    closed = (e for e in elements if wanted(e) and e.lines and e.is_closed and not e.is_node)
    return [Area.of(e, frame, simple=not mended and e.tags.get("amenity") == "parking_space") for e in closed]


def is_building(element: OsmElement) -> bool:
    return element.tags.get("building", "no") != "no"


def within(areas: Sequence[Area], box: tuple[float, float, float, float] | None) -> list[Area]:
    if box is None:
        return list(areas)
    bounds = shapely.box(*box)
    return [a for a in areas if shapely.contains(bounds, shapely.point_on_surface(a.polygon))]


def exterior_rings(polygons: Iterable[shapely.Geometry]) -> list[FloatArray]:
    rings = [shapely.get_exterior_ring(part) for whole in polygons for part in shapely.get_parts(whole)]
    return [shapely.get_coordinates(ring) for ring in rings if ring is not None]


def find_goals(
    slots: Slots, nodes: Sequence[OsmElement], buildings: Sequence[Area], frame: LocalFrame
) -> tuple[FloatArray, str]:
    """Return entrances near the slots, main ones first, else the middle of the nearest building, (n, 2) m; a note."""
    none = np.empty((0, 2))
    if not len(slots):
        return none, ""
    doors = [e for e in nodes if e.tags.get("entrance", "no") not in NOT_GOALS]
    if doors:
        xy = frame.to_xy(np.concatenate([e.lines[0] for e in doors]))
        near = _distance_to_slots(slots, np.asarray(shapely.points(xy))) <= ENTRANCE_REACH
        away = np.hypot(*(xy - slots.xy.mean(axis=0)).T)
        is_side = np.array([e.tags["entrance"] != "main" for e in doors])
        order = [int(i) for i in np.lexsort((away, is_side)) if near[i]]
        if order:
            return xy[order], "entrance " + ", ".join(doors[i].id for i in order[:5])
    buildings = [a for a in buildings if a.element.tags["building"] not in NOT_WALKED_TO]
    if buildings:
        distance = _distance_to_slots(slots, np.array([a.polygon for a in buildings]))
        k = int(np.argmin(distance))
        if distance[k] <= BUILDING_REACH:
            middle = shapely.get_coordinates(shapely.centroid(buildings[k].polygon))
            return middle, f"the middle of the nearest building, {buildings[k].element.id}"
    return none, ""


def split_walls(
    slots: Slots, roads: Sequence[Road], buildings: Sequence[Area]
) -> tuple[list[FloatArray], list[str]]:
    """Return outlines, (k, 2) m each, of buildings near the slots, and ids of those that cars pass below."""
    if not len(slots) or not buildings:
        return [], []
    polygons = np.array([a.polygon for a in buildings])
    used = shapely.union_all(
        [*slots.boxes(shrink=0.1), *(shapely.LineString(road.points).buffer(1.0) for road in roads)]
    )
    over = shapely.intersects(polygons, used)
    near = (_distance_to_slots(slots, polygons) <= ENTRANCE_REACH) & ~over
    return exterior_rings(polygons[near]), [buildings[k].element.id for k in np.flatnonzero(over).tolist()]


def _distance_to_slots(slots: Slots, geometries: NDArray[np.object_]) -> FloatArray:
    tree = shapely.STRtree(np.asarray(shapely.points(slots.xy)))
    (index, _), distance = tree.query_nearest(geometries, all_matches=False, return_distance=True)
    result = np.full(len(geometries), np.inf)
    result[index] = distance
    return result


# Values of `parking_space` that any car may use.
CAR_SPACES = ("normal", "yes", "car", "parent", "parents", "women", "woman", "customers", "residents")
# Largest area of a slot, m²; a larger space without a capacity counts as several and is left out.
LARGEST_SPACE = 30.0


def is_space(element: OsmElement) -> bool:
    return element.tags.get("amenity") == "parking_space" and not element.is_node


def is_parking_area(element: OsmElement) -> bool:
    return element.tags.get("amenity") == "parking"


def why_no_slot(space: Area, private: Sequence[shapely.Geometry]) -> str | None:
    tags, kind = space.element.tags, space.element.tags.get("parking_space", "normal")
    disabled = tags.get("capacity:disabled", "no") not in ("no", "0")
    closed = closed_to_cars(tags) or off_the_ground(tags)
    inside = shapely.point_on_surface(space.polygon)
    is_large = float(shapely.area(space.polygon)) > LARGEST_SPACE
    reasons = {
        "spaces cut at the edge of the map": space.element.cut,
        "spaces for disabled drivers": disabled or "disabled" in (kind, tags.get("access")),
        f"spaces with parking_space={kind}": kind not in CAR_SPACES,
        f"spaces with {closed}": closed is not None,
        "spaces in private parking": any(shapely.contains(other, inside) for other in private),
        f"spaces larger than {LARGEST_SPACE:g} m² without a capacity": is_large
        and not whole_number(tags.get("capacity")),
    }
    return next((reason for reason, holds in reasons.items() if holds), None)


def slots_by_rank(polygons: NDArray[np.object_], roads: Sequence[Road]) -> tuple[IntArray, list[Rank], Slots]:
    """Return slots by the rank of the road that they open to, with their indices; lower ranks win, even if farther."""
    index, ranks, parts = [np.empty(0, np.int64)], list[Rank](), [NO_SLOTS]
    left = np.arange(len(polygons))
    for rank in Rank:
        near = [Lane(road.points, road.oneway) for road in roads if road.rank <= rank]
        if not len(left) or not near:
            continue
        slots = slots_from_polygons(polygons[left], near)
        to_lane = nearest_on_lanes(near, slots.mouths())[0] - slots.mouths()
        reached = np.hypot(to_lane[:, 0], to_lane[:, 1]) <= SLOT_REACH
        index.append(left[reached])
        ranks += [rank] * len(index[-1])
        parts.append(slots[reached])
        left = left[~reached]
    return np.concatenate(index), ranks, Slots.joined(parts)


def split_space(
    element: OsmElement, polygon: shapely.Geometry, lanes: Sequence[Lane]
) -> list[tuple[str, shapely.Geometry]]:
    """Split a space into as many as its capacity, along its nearest lane or else its longer side, and name them."""
    count = whole_number(element.tags.get("capacity")) or 1
    if count == 1:
        return [(element.id, polygon)]
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(polygon))[:4]
    one, other = corners[1] - corners[0], corners[3] - corners[0]
    along = nearest_on_lanes(lanes, corners.mean(axis=0)[None])[1][0]
    share = (
        [abs(side @ along) / np.hypot(*side) for side in (one, other)] if lanes else np.hypot(*[one, other])
    )
    if share[1] > share[0]:
        one, other = other, one
    starts = corners[0] + np.arange(count)[:, None] / count * one
    return [
        (f"{element.id}-{k}", shapely.Polygon([p, p + one / count, p + one / count + other, p + other]))
        for k, p in enumerate(starts, start=1)
    ]
