"""Areas of OpenStreetMap elements: buildings (goals and walls) and mapped parking spaces."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.lots.generators import Slots
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.osm.elements import OsmElement
from parkenv.lots.osm.roads import Rank, Road, closed_to_cars, off_the_ground, whole_number
from parkenv.lots.slot_polygons import nearest_on_lanes, slots_from_polygons
from parkenv.world.drive_graph import SLOT_REACH
from parkenv.world.lot import Lane

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

    @classmethod
    def of(cls, element: OsmElement, frame: LocalFrame, *, simple: bool) -> Area:
        """Return the area of a closed element; outlines that cross themselves are refused if `simple`, else mended."""
        if not element.is_closed:
            raise InputError(f"{element.id}: its outline is open, want its first position again at the end")
        outer, holes = (
            [shapely.Polygon(frame.to_xy(line)) for line in lines] for lines in (element.lines, element.holes)
        )
        for polygon in (*outer, *holes):
            if simple and not element.cut and not polygon.is_valid:
                reason = shapely.is_valid_reason(polygon).split("[")[0]
                raise InputError(f"{element.id}: its outline is not a simple one: {reason}")
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
    """Return the areas of the closed ones among the wanted elements, `mended` also where spaces cross themselves."""
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
) -> tuple[FloatArray, str | None]:
    """Return entrances near the slots, main ones first, else the middle of the nearest building, (n, 2) m; a note."""
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


CAR_SPACES = ("normal", "yes", "car", "parent", "parents", "women", "woman", "customers", "residents")
"""Values of `parking_space` that any car may use."""
LARGEST_SPACE = 30.0
"""Largest area of a slot, m²; a larger space without a capacity counts as several and is left out."""


def is_space(element: OsmElement) -> bool:
    return element.tags.get("amenity") == "parking_space" and not element.is_node


def is_parking_area(element: OsmElement) -> bool:
    return element.tags.get("amenity") == "parking"


def usable_spaces(
    spaces: Sequence[Area], parking: Sequence[Area], *, with_disabled: bool
) -> tuple[list[Area], list[tuple[Area, str]]]:
    """Return the spaces that are slots, and the others with the reasons."""
    private = [a.polygon for a in parking if closed_to_cars(a.element.tags)]
    reasons = [
        "spaces cut at the edge of the map"
        if a.element.cut
        else _why_no_slot(a.element.tags, a.polygon, private, with_disabled=with_disabled)
        for a in spaces
    ]
    judged = list(zip(spaces, reasons, strict=True))
    return [a for a, why in judged if why is None], [(a, why) for a, why in judged if why is not None]


def _why_no_slot(
    tags: Mapping[str, str],
    polygon: shapely.Geometry,
    private: Sequence[shapely.Geometry],
    *,
    with_disabled: bool,
) -> str | None:
    kind = tags.get("parking_space", "normal")
    is_disabled = (
        kind == "disabled"
        or tags.get("access") == "disabled"
        or tags.get("capacity:disabled", "no") not in ("no", "0")
    )
    if is_disabled and not with_disabled:
        return "spaces for disabled drivers"
    if not is_disabled and kind not in CAR_SPACES:
        return f"spaces with parking_space={kind}"
    reason = closed_to_cars(tags) or off_the_ground(tags)
    if reason is not None:
        return f"spaces with {reason}"
    inside = shapely.point_on_surface(polygon)
    if any(shapely.contains(other, inside) for other in private):
        return "spaces in private parking"
    if whole_number(tags.get("capacity")) in (None, 0) and float(shapely.area(polygon)) > LARGEST_SPACE:
        return f"spaces larger than {LARGEST_SPACE:g} m² without a capacity"
    return None


def slots_by_rank(
    polygons: NDArray[np.object_], roads: Sequence[Road]
) -> Iterator[tuple[Rank, NDArray[np.intp], Slots]]:
    """Yield slots by the rank of the road that they open to, with their indices; lower ranks win, even if farther."""
    left = np.arange(len(polygons))
    for rank in Rank:
        near = [Lane(road.points, road.oneway) for road in roads if road.rank <= rank]
        if not len(left) or not near:
            continue
        slots = slots_from_polygons(polygons[left], near)
        mouth = slots.mouths()
        to_lane = nearest_on_lanes(near, mouth)[0] - mouth
        reached = np.hypot(to_lane[:, 0], to_lane[:, 1]) <= SLOT_REACH
        found = np.flatnonzero(reached)
        yield rank, left[found], slots[found]
        left = left[~reached]


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
