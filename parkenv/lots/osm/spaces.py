"""Slots from mapped parking spaces in OpenStreetMap."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.lots.generators import Slots
from parkenv.lots.osm.buildings import Area
from parkenv.lots.osm.elements import OsmElement
from parkenv.lots.osm.roads import Rank, Road, closed_to_cars, off_the_ground, whole_number
from parkenv.lots.slot_polygons import nearest_on_lanes, slots_from_polygons
from parkenv.world.drive_graph import SLOT_REACH
from parkenv.world.lot import Lane

CAR_SPACES = ("normal", "yes", "car", "parent", "parents", "women", "woman", "customers", "residents")
"""Values of `parking_space` that any car may use."""
LARGEST_SPACE = 30.0
"""Largest area of a slot, m²; a larger space without a capacity counts as several and is left out."""


def is_space(element: OsmElement) -> bool:
    """Whether an element is a mapped parking space."""
    return element.tags.get("amenity") == "parking_space" and not element.is_node


def is_parking_area(element: OsmElement) -> bool:
    """Whether an element is a parking area as a whole."""
    return element.tags.get("amenity") == "parking"


def usable_spaces(
    spaces: Sequence[Area], parking: Sequence[Area], *, with_disabled: bool
) -> tuple[list[Area], list[tuple[Area, str]]]:
    """Return the spaces that are slots, and the others with the reasons.

    Args:
        spaces: the mapped spaces.
        parking: the parking areas; spaces in private ones are not slots.
        with_disabled: whether spaces for disabled drivers are slots.
    """
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
    """Return the reason why a mapped space is not a slot; None for a slot."""
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
    """Yield the slots of outlines, (n,) polygons, that open to roads of each rank, and their indices.

    A slot prefers an aisle to another service road, and that to a street, even if these are nearer.
    """
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
    """Split a space into as many equal ones as its capacity, and name them.

    They are side by side along the lane nearest to the space, or along its longer side without lanes.
    """
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
