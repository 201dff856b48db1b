"""Slots from mapped parking spaces in OpenStreetMap."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import shapely

from parkenv.lots.osm.roads import closed_to_cars, off_the_ground, whole_number
from parkenv.lots.slot_polygons import nearest_on_lanes
from parkenv.world.lot import Lane

CAR_SPACES = ("normal", "yes", "car", "parent", "parents", "women", "woman", "customers", "residents")
"""Values of `parking_space` that any car may use."""
LARGEST_SPACE = 30.0
"""Largest area of a slot, m²; a larger space without a capacity counts as several and is left out."""


def why_no_slot(
    tags: Mapping[str, str],
    polygon: shapely.Geometry,
    private: Sequence[shapely.Geometry],
    *,
    with_disabled: bool,
) -> str | None:
    """Return the reason why a mapped space is not a slot; None for a slot.

    Args:
        tags: tags of the space.
        polygon: its outline, m.
        private: outlines of parking areas closed to the public, m.
        with_disabled: whether spaces for disabled drivers are slots.
    """
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


def split_space(polygon: shapely.Geometry, count: int, lanes: Sequence[Lane]) -> list[shapely.Geometry]:
    """Split a space into `count` equal ones, side by side along its lane, or along its longer side without lanes."""
    if count == 1:
        return [polygon]
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(polygon))[:4]
    one, other = corners[1] - corners[0], corners[3] - corners[0]
    along = nearest_on_lanes(lanes, corners.mean(axis=0)[None])[1][0]
    share = (
        [abs(side @ along) / np.hypot(*side) for side in (one, other)] if lanes else np.hypot(*[one, other])
    )
    if share[1] > share[0]:
        one, other = other, one
    starts = corners[0] + np.arange(count)[:, None] / count * one
    return [shapely.Polygon([p, p + one / count, p + one / count + other, p + other]) for p in starts]
