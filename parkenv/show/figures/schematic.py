"""Layers of a lot that show how it is put together: slots tied to their lanes, directions, entries and goals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.lots.slot_polygons import nearest_on_lanes
from parkenv.show.scene import ARROWHEAD, STAR, Areas, Layer, Lines, Marks, Paint, arrows_along, posed
from parkenv.world.lot import Lane

TWO_WAY, ONE_WAY, TIE = "#333a42", "#aa3377", "#9aa0a6"
ARROW_EVERY = 15.0
"""Distance between arrows on a one-way lane, m."""
_TRIANGLE = np.array([[0.5, 0.0], [-0.5, 0.5], [-0.5, -0.5]])


def schematic(
    corners: FloatArray,
    colors: Paint,
    mouths: FloatArray,
    lanes: Sequence[Lane],
    entries: FloatArray,
    goals: FloatArray,
    *,
    small: bool = False,
) -> list[Layer]:
    """Return the layers.

    Args:
        corners: (n, 4, 2) m, of the slots.
        colors: one for all slots, or one for each.
        mouths: (n, 2) m, middles of the open sides, which are tied to the nearest lane.
        lanes: the lanes; one-way lanes have arrows.
        entries: (k, 2) m.
        goals: (k, 2) m.
        small: whether the picture is small, with finer lines and marks.
    """
    thin = 0.75 if small else 1.0
    layers: list[Layer] = [Areas([[slot] for slot in corners], colors, "white", 0.4 * thin)]
    if lanes and len(corners):
        ties = np.stack([mouths, nearest_on_lanes(lanes, mouths)[0]], axis=1)
        layers.append(Lines(list(ties), TIE, px=(0.5 * thin, 0.5 * thin)))
    one_way = [lane.points for lane in lanes if lane.oneway]
    for lines, color in ((one_way, ONE_WAY), ([lane.points for lane in lanes if not lane.oneway], TWO_WAY)):
        layers.append(Lines(lines, color, px=(1.2 * thin, 1.2 * thin)))
    return [
        *layers,
        Marks(arrows_along(one_way, ARROW_EVERY), ARROWHEAD, ONE_WAY, px=7.0 * thin),
        Marks(posed(entries, np.pi / 2), _TRIANGLE, "entry", px=9.0 * thin, edge="ink", edge_px=0.6),
        Marks(posed(goals), STAR, "goal", px=15.0 * thin, edge="paint", edge_px=0.6),
    ]
