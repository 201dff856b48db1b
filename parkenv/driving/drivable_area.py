"""The paved area of a lot, its kerbs and walls."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.world.drive_graph import SLOT_REACH, linestrings
from parkenv.world.lot import ParkingLot, mouth_heading

ROAD_HALF_WIDTH = 3.0  # from the centre line of a lane without slots to its kerbs, m
HALF_WIDTHS = (2.0, 4.0)
"""Limits, m, of half the width of a lane with slots, which extends to the slots' mouths."""
JOINT = 0.6  # gaps between slots of up to twice this width, m, are paved
STRAIGHTENED = 0.03  # tolerance, m, for simplifying kerbs


JOINED_WHOLE = 2000
"""Slots up to which the whole paved area is computed at once; the union of a town takes ten seconds."""


class DrivableArea:
    """The paved area of a lot: lanes up to the mouths of their slots, slots, and the approaches to them.

    Args:
        lot: the lot.
    """

    def __init__(self, lot: ParkingLot) -> None:
        self._lot = lot
        lanes = linestrings([lane.points for lane in lot.lanes])
        mouth = np.asarray(shapely.points(lot.mouth_xy()))
        slot, served_by = shapely.STRtree(lanes).query_nearest(mouth, all_matches=False)
        reach = np.full(len(lanes), np.inf)
        np.minimum.at(reach, served_by, shapely.distance(lanes[served_by], mouth[slot]))
        self._lanes = lanes
        self._half_width = np.where(np.isinf(reach), ROAD_HALF_WIDTH, np.clip(reach, *HALF_WIDTHS))
        # The approach of a slot is as wide as its mouth and extends to the lane, along an oblique slot's own direction.
        heading = mouth_heading(lot.slot_yaw, lot.slot_mouth)
        outward = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        away = ((lot.vertex_xy[: lot.n_slots] - lot.mouth_xy()) * outward).sum(axis=1)
        onward = np.clip(away, 0.0, SLOT_REACH)[:, None] * outward
        corners = lot.slot_corners()
        way_in = np.concatenate([corners, corners + onward[:, None]], axis=1)
        self._bays = np.asarray(shapely.convex_hull(shapely.multipoints(np.asarray(shapely.points(way_in)))))
        self._tree = shapely.STRtree(self._bays)
        self._whole: shapely.Geometry | None = None
        self._walls = np.array([leg for wall in lot.walls for leg in pairwise(wall)]).reshape(-1, 2, 2)
        self._wall_tree = shapely.STRtree(np.asarray(shapely.linestrings(self._walls)))

    def around(self, center: FloatArray, reach: float) -> shapely.Geometry:
        """The paved area near a point, (2,) m; exact only within `reach` m along both axes."""
        if self._lot.n_slots > JOINED_WHOLE:
            return self._joined(shapely.box(*(center - reach - 10.0), *(center + reach + 10.0)))
        if self._whole is None:
            west, south, east, north = self._lot.bounds()
            self._whole = self._joined(shapely.box(west - 100.0, south - 100.0, east + 100.0, north + 100.0))
        return self._whole

    def parts(self) -> NDArray[np.object_]:
        """The paved area as roads, and bays with their approaches, (n,) polygons that overlap."""
        return np.concatenate([self._roads(self._lanes), self._bays])

    def _roads(self, lanes: NDArray[np.object_]) -> NDArray[np.object_]:
        return np.asarray(
            shapely.buffer(lanes, self._half_width, cap_style="square", join_style="mitre"), object
        )

    def _joined(self, window: shapely.Geometry) -> shapely.Geometry:
        roads = self._roads(shapely.intersection(self._lanes, window))
        near = np.sort(self._tree.query(window))
        area = shapely.union_all(np.concatenate([roads, self._bays[near]]))
        joined = shapely.buffer(shapely.buffer(area, JOINT, join_style="mitre"), -JOINT, join_style="mitre")
        # Shrinking with mitred corners removes too much at reflex corners.
        return shapely.union(joined, area).simplify(STRAIGHTENED)

    def walls(self, center: FloatArray, reach: float) -> FloatArray:
        """Straight pieces of the lot's walls, end points (m, 2, 2) m; arguments as for `kerbs`."""
        window = shapely.box(*(center - reach), *(center + reach))
        return self._walls[np.sort(self._wall_tree.query(window))]

    def kerbs(self, center: FloatArray, reach: float) -> FloatArray:
        """Straight kerb segments, end points (m, 2, 2) m, within `reach` m of a point, (2,) m, along both axes."""
        edge = shapely.boundary(self.around(center, reach))
        window = shapely.box(*(center - reach), *(center + reach))
        lines = shapely.get_parts(shapely.intersection(edge, window))
        pieces = [
            [start, end]
            for line in lines
            if line.geom_type == "LineString"
            for start, end in pairwise(shapely.get_coordinates(line))
        ]
        return np.array(pieces).reshape(-1, 2, 2)
