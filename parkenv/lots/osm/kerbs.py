"""Kerbside parking from OpenStreetMap's street tags.

Both tagging schemes are read: `parking:left|right|both` with `:orientation`, `:capacity`, `:restriction` and
`:access`, and the deprecated `parking:lane:left|right|both` with `parking:condition:...`. Restrictions at
certain hours (`:conditional`) are ignored. A capacity of `both` applies to each side.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.lots.generators import KERB_SIZE, NO_SLOTS, Slots
from parkenv.lots.osm.roads import Rank, Road, metres, whole_number
from parkenv.lots.osm.rows import (
    ARRANGEMENTS,
    DRAWN,
    Side,
    bend_factor,
    row_anchors,
    row_at,
)
from parkenv.world.drive_graph import node_labels

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
    """Create the slots along one side of a road.

    Cars face the direction of traffic, on the right. The number of slots is the tagged one, at most as many as fit at
    5 m, or otherwise as many as fit at 6 m (2.5 m if cars park across the street). Slots are spread over the free
    intervals. A tagged `width` includes cars parked on the carriageway.

    Args:
        road: the road.
        side: side of the road in the order of its points.
        kerb: arrangement of the parked cars.
        closed: intervals that stay free, start and end in m from the road's start.
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
    """Distribute `capacity` slots over the intervals, at most `fit` in each, more in longer ones."""
    count = np.zeros(len(fit), dtype=np.int64)
    length = np.array([end - start for start, end in free])
    for _ in range(min(capacity, int(fit.sum()))):
        # The next slot goes to the interval with the most room per slot.
        room = np.where(count < fit, length / (count + 1), -1.0)
        count[int(np.argmax(room))] += 1
    return count


class Junctions:
    """The junctions of roads, and the parts of kerbs that they keep free.

    Args:
        roads: all roads, whether cars may park there or not.
        crossings: (n, 2) m, pedestrian crossings.
    """

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
