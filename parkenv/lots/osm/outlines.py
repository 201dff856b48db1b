"""Fill parking areas that are mapped only by their outline with rows of slots."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.lots.generators import NO_SLOTS, Slots
from parkenv.lots.osm.roads import Road
from parkenv.lots.osm.rows import (
    ARRANGEMENTS,
    DRAWN,
    Arrangement,
    Side,
    row_anchors,
    row_at,
    without_overlaps,
)
from parkenv.world.drive_graph import SLOT_REACH

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
    """Fill an area with slots by rule: rows of 2.5 × 5 m along both sides of every aisle.

    Cars park across the aisle unless an orientation is given; if only slots of 6 × 2.1 m along the aisle fit, cars park
    along it. Rows begin at the edge of the carriageway, or at the outline if the road passes outside. A slot is inside
    the outline, clear of roads and blocked areas, and its mouth is nearest to its own road. Rows with more slots are
    placed first; slots beyond the capacity are dropped from the end.

    Args:
        outline: the area, m.
        roads: roads that pass it within 8 m.
        blocked: areas without slots: buildings, mapped slots.
        orientation: a key of `ARRANGEMENTS`, or None.
        capacity: number of slots in the area, or None.

    Returns:
        The slots; empty without a road nearby.
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
    """Return the parts of a road that pass the outline, start and end in m from its start."""
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
    """Return all slots between two stations of a road, as close to it as road and outline allow."""
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
    """Return the slots that are inside the outline, clear of everything else, and open to their own road."""
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
