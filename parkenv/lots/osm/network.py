"""The road network from OpenStreetMap: junctions, roads that serve slots, and entries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.lots.generators import Slots
from parkenv.lots.osm.roads import Rank, Road
from parkenv.world.drive_graph import component_labels, node_labels
from parkenv.world.lot import Lane


def lanes_of(roads: Sequence[Road]) -> list[Lane]:
    """Return one lane per road."""
    return [Lane(road.points, road.oneway) for road in roads]


def clipped_road(road: Road, box: shapely.Geometry) -> list[Road]:
    """Return the parts of a road within a box, each in the direction of the road."""
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
    """Return the roads connected to slots, without service roads that do not lead to a slot.

    Args:
        roads: candidates for lanes.
        around: other roads; a road that meets one of them is not a dead end.
        slots: the slots to reach.
    """
    parts = components_with_slots(roads, slots)
    kept = [road for part in parts for road in part]
    serving = _serving_roads(kept, slots)
    while True:
        shared = _shared_node_counts(kept, around)
        loose = [
            road.rank < Rank.STREET and k not in serving and shared[k] < 2 for k, road in enumerate(kept)
        ]
        if not any(loose):
            return kept
        new_number = np.cumsum(~np.array(loose)) - 1
        serving = {int(new_number[k]) for k in serving}
        kept = [road for road, dead in zip(kept, loose, strict=True) if not dead]


def open_ends(roads: Sequence[Road], edge: shapely.Geometry, blind: FloatArray) -> FloatArray:
    """Return the points where streets leave the map and cars may enter, (n, 2) m.

    These are the road ends at the edge of the map or, if no road ends there, all ends that are not dead ends.

    Args:
        roads: all lanes.
        edge: the polygon within which roads are lanes.
        blind: (k, 2) m, road ends that are tagged as dead ends.
    """
    ends = [
        xy
        for road, xy, is_first in road_ends(roads)
        if road.rank is Rank.STREET and (is_first or not road.oneway)
    ]
    if not ends:
        return np.empty((0, 2))
    xy = np.array(ends)
    at_edge = shapely.dwithin(shapely.get_exterior_ring(edge), np.asarray(shapely.points(xy)), 0.1)
    if at_edge.any():
        return xy[np.flatnonzero(at_edge)]
    if len(blind):
        away = blind[None] - xy[:, None]
        xy = xy[np.flatnonzero(np.hypot(away[..., 0], away[..., 1]).min(axis=1) > 0.1)]
    return xy


def _road_nodes(roads: Sequence[Road]) -> list[NDArray[np.int64]]:
    """Return the node labels of the points of each road; roads meet where they share a label."""
    if not roads:
        return []
    label = node_labels(np.concatenate([road.points for road in roads]))
    return np.split(label, np.cumsum([len(road.points) for road in roads])[:-1])


def _serving_roads(roads: Sequence[Road], slots: Slots) -> set[int]:
    """Return the indices of the roads that are nearest to the mouth of some slot."""
    if not roads or not len(slots):
        return set()
    lines = np.array([shapely.LineString(road.points) for road in roads])
    nearest = shapely.STRtree(lines).nearest(shapely.points(slots.mouths()))
    return set(np.asarray(nearest).tolist())


def components_with_slots(roads: Sequence[Road], slots: Slots) -> list[list[Road]]:
    """Return the connected components of the roads, without those that serve no slot."""
    if not roads:
        return []
    along = _road_nodes(roads)
    road = np.repeat(np.arange(len(roads)), [len(p) for p in along])
    label = np.concatenate(along)
    n = len(roads) + int(label.max()) + 1
    part = component_labels(np.column_stack([road, len(roads) + label]), n)[: len(roads)]
    serving = {int(part[k]) for k in _serving_roads(roads, slots)}
    return [[r for r, p in zip(roads, part, strict=True) if p == k] for k in sorted(serving)]


def _shared_node_counts(roads: Sequence[Road], around: Sequence[Road]) -> list[int]:
    """Count the nodes that each road shares with other roads of either list."""
    along = [set(p.tolist()) for p in _road_nodes([*roads, *around])]
    users: dict[int, int] = {}
    for labels in along:
        for label in labels:
            users[label] = users.get(label, 0) + 1
    return [sum(users[label] > 1 for label in labels) for labels in along[: len(roads)]]


def street_junctions(roads: Sequence[Road], streets: Sequence[Road]) -> FloatArray:
    """Return the nodes that a road shares with a street, where cars turn in, (n, 2) m."""
    if not streets:
        return np.empty((0, 2))
    along = _road_nodes([*roads, *streets])
    public = set(np.concatenate(along[len(roads) :]).tolist())
    shared: dict[int, FloatArray] = {}
    for road, on_road in zip(roads, along, strict=False):
        # Cars cannot enter at the end of a one-way road.
        last = len(on_road) - 1 if road.oneway else len(on_road)
        for i in range(last):
            if int(on_road[i]) in public:
                shared.setdefault(int(on_road[i]), road.points[i])
    return np.array(list(shared.values())).reshape(-1, 2)


def dead_ends(roads: Sequence[Road]) -> FloatArray:
    """Return the road ends, (n, 2) m, at which no other road begins."""
    return np.array([xy for _, xy, _ in road_ends(roads)]).reshape(-1, 2)


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
