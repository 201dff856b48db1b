"""Where the blocks of a lot are, for the map of a page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from parkenv.compiled.arrays import IntArray
from parkenv.show.scene import Lines, building_layers, layer_data, rounded
from parkenv.world.lot import ParkingLot, is_building

LANE_WIDTH = 5.5
GAP = 1.2
"""m between slots of a block up to which they are drawn as one area."""
COUNTED_AREA, LEAST_SIDE = 6.0, 12.0
"""m2 of the square of a counted facility for each car that fits, and its least side, m."""


def town_data(lot: ParkingLot, blocks: Sequence[Mapping[str, Any]], of_slot: IntArray) -> dict[str, Any]:
    """Return a `town` of a page: lengths in m, rounded to decimetres.

    Args:
        lot: the lot.
        blocks: name, type, zone, slots and rules of each block.
        of_slot: (n_slots,) block of each slot.
    """
    lanes = [lane.points for lane in lot.lanes]
    buildings = [wall for wall in lot.walls if is_building(wall)]
    ground = [
        *building_layers(buildings, [wall for wall in lot.walls if not is_building(wall)]),
        Lines(lanes, "asphalt", LANE_WIDTH, (1.5, LANE_WIDTH)),
    ]
    return {
        "name": lot.name,
        "bounds": rounded(np.array(lot.bounds()), 1),
        "ground": [layer_data(layer, 1) for layer in ground],
        "lanes": [rounded(points, 1) for points in lanes],
        "goals": [rounded(xy, 1) for xy in lot.goals],
        "blocks": [
            {**block, **_place(lot, np.flatnonzero(of_slot == number))} for number, block in enumerate(blocks)
        ],
    }


def _place(lot: ParkingLot, slots: IntArray) -> dict[str, Any]:
    """Return the areas of slots that are drawn as one block, and a place in it.

    A counted facility is a square as large as its slots would be on a few storeys.
    """
    facility = lot.facilities[lot.facility_of_slot[slots[0]]] if lot.facility_of_slot[slots[0]] >= 0 else None
    if facility is not None and facility.xy is not None and facility.is_counted:
        half = 0.5 * max(math.sqrt(COUNTED_AREA * facility.capacity), LEAST_SIDE)
        square = np.array(facility.xy) + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        return {"at": rounded(np.array(facility.xy), 1), "areas": [[rounded(square, 1)]]}
    corners = shapely.polygons(lot.slot_corners()[slots])
    joined = shapely.union_all(shapely.buffer(corners, GAP / 2, join_style="mitre"))
    area = shapely.simplify(shapely.buffer(joined, 0.2 - GAP / 2, join_style="mitre"), 0.2)
    xy = lot.slot_xy[slots]
    middle = xy[np.argmin(np.hypot(*(xy - xy.mean(axis=0)).T))]
    return {
        "at": rounded(middle, 1),
        "areas": [
            [rounded(shapely.get_coordinates(ring)[:-1], 1) for ring in (part.exterior, *part.interiors)]
            for part in shapely.get_parts(area)
        ],
    }
