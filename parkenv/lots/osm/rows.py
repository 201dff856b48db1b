"""Rows of slots along roads: kerbside parking from street tags, and parking areas filled by rule.

Both tagging schemes are read: `parking:left|right|both` with `:orientation`, `:capacity`, `:restriction` and
`:access`, and the deprecated `parking:lane:left|right|both` with `parking:condition:...`. Restrictions at
certain hours (`:conditional`) are ignored. A capacity of `both` applies to each side.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.lots.generators import BAY_SIZE, KERB_SIZE, NO_SLOTS, Slots
from parkenv.lots.osm.roads import Rank, Road, metres, whole_number
from parkenv.world.drive_graph import SLOT_REACH, node_labels
from parkenv.world.lot import Mouth

Side = Literal["left", "right"]


@dataclass(frozen=True)
class Arrangement:
    """Arrangement of parked cars along a road."""

    angle: float  # angle between the road and the cars, rad, from 0 (along it) to π/2 (across)
    length: float  # length of a slot, m
    width: float  # width of a slot, m

    @property
    def pitch(self) -> float:
        return self.length if self.angle == 0.0 else self.width / float(np.sin(self.angle))


ARRANGEMENTS = {
    "parallel": Arrangement(0.0, *KERB_SIZE),
    "diagonal": Arrangement(np.pi / 3, *BAY_SIZE),
    "perpendicular": Arrangement(np.pi / 2, *BAY_SIZE),
}
"""Arrangement for each value of OpenStreetMap's `orientation`; diagonal cars park at 60°."""
DRAWN = 0.05  # tolerance, m, of the length of a row: OpenStreetMap's seven digits round to a centimetre


@dataclass(frozen=True, eq=False)
class RowAnchors:
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
    anchors = row_anchors(points, stations, step, side)
    beside = np.diff(anchors.xy + reach * anchors.outward, axis=0)
    length = float(np.hypot(beside[:, 0], beside[:, 1]).sum())
    return max(1.0, (end - start) * (n - 1) / n / max(length, 0.1))


def without_overlaps(boxes: NDArray[np.object_]) -> NDArray[np.bool_]:
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
FORBIDDEN = (
    *("no_parking", "no_stopping", "no_standing", "no_waiting", "fire_lane"),
    *("loading", "loading_only", "charging_only", "disabled", "private"),
)
OLD_ORIENTATIONS = {
    **{name: name for name in ARRANGEMENTS},
    **{"inline": "parallel", "orthogonal": "perpendicular", "marked": "parallel", "yes": "parallel"},
}
CORNER_CLEARANCE = 5.0
"""Distance from the kerbs' corner at a junction, and from a pedestrian crossing, to the first car, m."""
DRIVEWAY_CLEARANCE = 1.0  # distance from the edge of a joining service road to the first car, m
SHORTEST_KERB_SLOT = 5.0
"""Smallest slot length, m, if a tagged capacity needs more slots than fit at the usual length."""
ROUNDING = 1e-6  # m, shorter intervals are none
STRAIGHT_ON = np.radians(30.0)
"""Largest angle between an arm and the street at which the arm continues the street."""


@dataclass(frozen=True)
class Kerb:
    """Parking along one side of a street."""

    orientation: str  # a key of `ARRANGEMENTS`
    capacity: int | None  # number of slots; None if not tagged
    on_carriageway: bool  # whether parked cars are within `width`


def kerb_of(tags: Mapping[str, str], side: Side) -> Kerb | str | None:
    """Return the parking on one side of a way; a reason if tagged but unusable; None without tags."""

    def tag(start: str, end: str = "") -> str | None:
        return tags.get(f"{start}:{side}{end}", tags.get(f"{start}:both{end}"))

    kind = tag("parking")
    if kind is not None:
        if kind in ("no", "separate"):
            return None
        orientation = tag("parking", ":orientation") or "parallel"
        if kind not in PARKED or orientation not in ARRANGEMENTS:
            return f"kerbs with parking={kind}, orientation={orientation}, which is not known"
        for key, closed in (("restriction", FORBIDDEN), ("access", ("no", "private"))):
            value = tag("parking", f":{key}")
            if value in closed:
                return f"kerbs with {key}={value}"
        return Kerb(orientation, whole_number(tag("parking", ":capacity")), kind == "lane")

    old = tag("parking:lane")
    if old is None or old in ("no", "none", "separate", "drawn_separately"):
        return None
    condition = tag("parking:condition")
    if old in FORBIDDEN or condition in FORBIDDEN:
        return f"kerbs with {old if old in FORBIDDEN else condition}"
    if old not in OLD_ORIENTATIONS:
        return f"kerbs with parking:lane={old}, which is not known"
    where = tag("parking:lane", f":{old}") or "on_street"
    capacity = whole_number(tag("parking:lane", ":capacity") or tag("parking", ":capacity"))
    return Kerb(OLD_ORIENTATIONS[old], capacity, where == "on_street")


def kerb_slots(road: Road, side: Side, kerb: Kerb, closed: Sequence[tuple[float, float]]) -> Slots:
    """Create the slots along one side of a road, in the order of its points.

    Cars face the direction of traffic, on the right. The number of slots is the tagged one, at most as many as fit at 5
    m, or otherwise as many as fit at 6 m (2.5 m if cars park across the street). Slots are spread over the free
    intervals; the closed ones are start and end in m from the road's start. A tagged `width` includes cars parked on
    the carriageway.
    """
    how = ARRANGEMENTS[kerb.orientation]
    total = float(np.hypot(*np.diff(road.points, axis=0).T).sum())
    free = free_intervals(total, closed)
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

    rows = []
    for (start, end), n, more in zip(free, count.tolist(), bend, strict=True):
        step = (end - start) / max(n, 1) if parallel else how.pitch * more
        middle, ranks = (start + end) / 2, np.arange(n) - (n - 1) / 2
        fitted = replace(how, length=min(how.length, step / more)) if parallel else how
        anchors = row_anchors(road.points, middle + ranks * step, fitted.pitch, side)
        with_points = road.oneway or side == "right"
        rows.append(row_at(anchors, offset, fitted, with_points=with_points))
    return Slots.joined(rows) if rows else NO_SLOTS


def free_intervals(total: float, closed: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return what is left of the length of a road between closed intervals, start and end in m from its start."""
    free, start = [], 0.0
    for begin, end in sorted(closed):
        if min(begin, total) - start > ROUNDING:
            free.append((start, min(begin, total)))
        start = max(start, end)
    if total - start > ROUNDING:
        free.append((start, total))
    return free


def _distribute(
    capacity: int, free: Sequence[tuple[float, float]], fit: NDArray[np.int64]
) -> NDArray[np.int64]:
    count = np.zeros(len(fit), dtype=np.int64)
    length = np.array([end - start for start, end in free])
    for _ in range(min(capacity, int(fit.sum()))):
        # The next slot goes to the interval with the most room per slot.
        room = np.where(count < fit, length / (count + 1), -1.0)
        count[int(np.argmax(room))] += 1
    return count


class Junctions:
    """The junctions of roads and pedestrian crossings, (n, 2) m, and the parts of kerbs that they keep free."""

    def __init__(self, roads: Sequence[Road], crossings: FloatArray) -> None:
        self._roads = roads
        xy = np.concatenate([road.points for road in roads] + [crossings])
        label = node_labels(xy)
        self._first = np.cumsum([0] + [len(road.points) for road in roads])
        self._label = label
        self._crossings = set(label[self._first[-1] :].tolist())
        # For every node, its arms: road, unit vector.
        self._arms: dict[int, list[tuple[int, FloatArray]]] = {}
        for k, road in enumerate(roads):
            for i, at in enumerate(label[self._first[k] : self._first[k + 1]].tolist()):
                for j in (i - 1, i + 1):
                    if 0 <= j < len(road.points):
                        away = road.points[j] - road.points[i]
                        self._arms.setdefault(at, []).append((k, away / np.hypot(*away)))

    def closed_intervals(self, k: int, side: Side) -> list[tuple[float, float]]:
        """Return the intervals without parking on a side of road k, start and end in m from its start.

        At junctions with streets, both sides stay free for 5 m beyond the corner and the cars parked around it; at
        service roads, the side that they join; at pedestrian crossings, 5 m before and after.
        """
        points = self._roads[k].points
        stations = np.r_[0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T))].tolist()
        closed = []
        for i, station in enumerate(stations):
            at = int(self._label[self._first[k] + i])
            if at in self._crossings:
                closed.append((station - CORNER_CLEARANCE, station + CORNER_CLEARANCE))
            if len(self._arms[at]) < 3:
                continue
            tangent = points[min(i + 1, len(points) - 1)] - points[max(i - 1, 0)]
            clearances = self._clearances(k, at, tangent / np.hypot(*tangent), side)
            closed += [(station - clearance, station + clearance) for clearance in clearances]
        return closed

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
PHASES = (0.0, 0.25, 0.5, 0.75)
"""Trial offsets of a row along its aisle, as fractions of a slot's width; the one with the most slots is used."""
CORRIDOR = 0.8  # fraction of a road's half width that must be clear of slots of other roads


def fill_outline(
    outline: shapely.Geometry,
    roads: Sequence[Road],
    blocked: Sequence[shapely.Geometry],
    orientation: str | None,
    capacity: int | None,
) -> Slots:
    """Fill an area with slots by rule: rows of 2.5 × 5 m along both sides of every aisle; none without a road nearby.

    Cars park across the aisle unless an orientation, a key of `ARRANGEMENTS`, is given; if only slots of 6 × 2.1 m
    along the aisle fit, cars park along it. Rows begin at the edge of the carriageway, or at the outline if the road
    passes outside. A slot is inside the outline, clear of roads and blocked areas, and its mouth is nearest to its own
    road. Rows with more slots are placed first; slots beyond the capacity are dropped from the end.
    """
    if not roads:
        return NO_SLOTS
    lines = np.array([shapely.LineString(road.points) for road in roads])
    corridors = [
        line.buffer(CORRIDOR * road.half_width, cap_style="flat")
        for line, road in zip(lines, roads, strict=True)
    ]
    taken = shapely.union_all([*corridors, *blocked])
    shapely.prepare(taken)
    roomy = shapely.buffer(outline, OUTLINE_TOLERANCE)
    shapely.prepare(roomy)

    rows: list[Slots] = []
    for k, road in enumerate(roads):
        for start, end in _intervals(lines[k], outline):
            for side in ("left", "right"):
                tries = [
                    _fitting(
                        _row(road, side, start + phase * how.pitch, end, how, outline), roomy, taken, lines, k
                    )
                    for name, how in ARRANGEMENTS.items()
                    if name == orientation or (orientation is None and name != "diagonal")
                    for phase in PHASES
                ]
                rows.append(max(tries, key=len))
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
    with_points = road.oneway or side == "right"
    return row_at(anchors, offset, how, with_points=with_points)[np.flatnonzero(reached)]


def _fitting(
    slots: Slots, roomy: shapely.Geometry, taken: shapely.Geometry, lines: NDArray[np.object_], own: int
) -> Slots:
    if not len(slots):
        return slots
    boxes = slots.boxes(shrink=0.02)
    fits = shapely.covers(roomy, boxes) & ~shapely.intersects(taken, boxes)
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
    return slots[np.flatnonzero(fits & ahead)]
