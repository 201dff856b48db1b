"""Goals and walls from buildings in OpenStreetMap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.lots.generators import Slots
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.osm.elements import OsmElement
from parkenv.lots.osm.roads import Road
from parkenv.lots.osm.rows import boxes_of

ENTRANCE_REACH = 100.0  # largest distance, m, from the nearest slot of a building entrance that is a goal
BUILDING_REACH = 200.0  # the same for the nearest building if there is no entrance
NOT_GOALS = ("no", "garage", "emergency", "exit", "service")  # values of `entrance` that are not goals
NOT_WALKED_TO = ("garage", "garages", "carport", "roof", "shed", "parking", "hut", "no", "transformer_tower")
"""Values of `building` that are not goals."""


@dataclass(frozen=True, eq=False)
class Area:
    """A closed element and its outline, m in the lot's frame."""

    element: OsmElement
    polygon: shapely.Geometry


def find_goals(
    slots: Slots, nodes: Sequence[OsmElement], buildings: Sequence[Area], frame: LocalFrame
) -> tuple[FloatArray, str | None]:
    """Return the goals, (n, 2) m, and a note that describes them.

    Goals are the building entrances near the slots, main entrances first, or else the centre of the nearest building;
    without either there are none.
    """
    none = np.empty((0, 2))
    if not len(slots):
        return none, None
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
    return none, None


def split_walls(
    slots: Slots, roads: Sequence[Road], buildings: Sequence[Area]
) -> tuple[list[FloatArray], list[str]]:
    """Return outlines, (k, 2) m each, of the buildings near the slots, and the ids of those over slots or lanes.

    A building over a slot or a lane is not a wall: cars pass below it.
    """
    if not len(slots) or not buildings:
        return [], []
    polygons = np.array([a.polygon for a in buildings])
    used = shapely.union_all(
        [*boxes_of(slots, shrink=0.1), *(shapely.LineString(road.points).buffer(1.0) for road in roads)]
    )
    over = shapely.intersects(polygons, used)
    near = (_distance_to_slots(slots, polygons) <= ENTRANCE_REACH) & ~over
    rings = [
        shapely.get_exterior_ring(part)
        for k in np.flatnonzero(near)
        for part in shapely.get_parts(polygons[k])
    ]
    walls = [shapely.get_coordinates(ring) for ring in rings if ring is not None]
    return walls, [buildings[k].element.id for k in np.flatnonzero(over).tolist()]


def _distance_to_slots(slots: Slots, geometries: NDArray[np.object_]) -> FloatArray:
    """Return the distance, (n,) m, from each of n geometries to the nearest slot centre."""
    tree = shapely.STRtree(np.asarray(shapely.points(slots.xy)))
    (index, _), distance = tree.query_nearest(geometries, all_matches=False, return_distance=True)
    result = np.full(len(geometries), np.inf)
    result[index] = distance
    return result
