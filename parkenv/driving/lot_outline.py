"""The shapes of a lot from above, shared by all drawings of lots."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.drivable_area import DrivableArea
from parkenv.world.drive_graph import linestrings
from parkenv.world.lot import ParkingLot, is_building

Rings = tuple[FloatArray, ...]  # A polygon, m: its outer ring, (k, 2) closed, and its holes

APRON = 0.25  # width of the asphalt beyond the kerbs, m
ARROW_EVERY = 24.0  # approximate distance between two direction arrows on a one-way lane, m


@dataclass(frozen=True, eq=False)
class LotOutline:
    """The shapes of a lot, m, in the lot's frame."""

    buildings: tuple[FloatArray, ...]  # outlines of buildings, (k, 2) each, closed
    walls: tuple[FloatArray, ...]  # other walls, (k, 2) each
    slots: FloatArray  # (n_slots, 4, 2), corners of the slots
    slot_lines: FloatArray  # (n_slots, 4, 2), painted lines: three sides of each slot, without its mouth
    centre_lines: tuple[FloatArray, ...]  # centre lines of the two-way lanes, (k, 2) each
    arrows: FloatArray  # (a, 3), x, y and yaw of direction arrows on the one-way lanes
    entries: FloatArray  # (e, 3), x, y and yaw of a car entering
    goals: FloatArray  # (g, 2), goals
    bounds: tuple[float, float, float, float]  # bounds of the lot, (x0, y0, x1, y1)
    area: DrivableArea  # the asphalt

    @classmethod
    def of(cls, lot: ParkingLot) -> LotOutline:
        """Describe a lot."""
        corners = lot.slot_corners()
        first = np.array([0, 3, 1])[lot.slot_mouth]
        slot_lines = corners[np.arange(lot.n_slots)[:, None], (first[:, None] + np.arange(4)) % 4]
        return cls(
            buildings=tuple(wall for wall in lot.walls if is_building(wall)),
            walls=tuple(wall for wall in lot.walls if not is_building(wall)),
            slots=corners,
            slot_lines=slot_lines,
            centre_lines=tuple(lane.points for lane in lot.lanes if not lane.oneway),
            arrows=_arrows(lot),
            entries=_entries(lot),
            goals=lot.goals,
            bounds=lot.bounds(),
            area=DrivableArea(lot),
        )

    def paved(
        self, center: FloatArray | None = None, reach: float = math.inf, *, apron: float = APRON
    ) -> list[Rings]:
        """Return the polygons of the asphalt, which ends at the kerbs of `DrivableArea`.

        Args:
            center: (2,); None: the whole lot.
            reach: m, around the centre along both axes, within which the polygons are exact.
            apron: m, width of the asphalt beyond the kerbs, on which the outer painted lines are visible.
        """
        if center is None:
            low, high = np.array(self.bounds).reshape(2, 2)
            center, reach = (low + high) / 2, float((high - low).max()) / 2
        area = self.area.around(center, reach)
        polygons = shapely.get_parts(shapely.buffer(area, apron, quad_segs=2) if apron else area)
        return [
            tuple(shapely.get_coordinates(ring) for ring in (polygon.exterior, *polygon.interiors))
            for polygon in polygons
        ]


def _arrows(lot: ParkingLot) -> FloatArray:
    """Return arrows evenly spaced over each straight piece of the one-way lanes."""
    arrows = []
    for lane in lot.lanes:
        for start, step in zip(lane.points, np.diff(lane.points, axis=0), strict=False):
            if lane.oneway:
                n = max(1, round(math.hypot(*step) / ARROW_EVERY))
                yaw = math.atan2(step[1], step[0])
                arrows += [(*(start + (i + 0.5) / n * step), yaw) for i in range(n)]
    return np.array(arrows, dtype=np.float64).reshape(-1, 3)


def _entries(lot: ParkingLot) -> FloatArray:
    """Return the entries with a yaw along their lane; on two-way lanes toward the slots."""
    lines = linestrings([lane.points for lane in lot.lanes])
    middle = lot.slot_xy.mean(axis=0)
    entries = []
    for xy in lot.entries:
        k = int(np.argmin(np.asarray(shapely.distance(lines, shapely.Point(xy)))))
        at = shapely.line_locate_point(lines[k], shapely.Point(xy))
        ends = shapely.line_interpolate_point(lines[k], [max(at - 1.0, 0.0), at, at + 1.0])
        before, here, after = shapely.get_coordinates(ends)
        directions = [after - here] if lot.lanes[k].oneway else [after - here, before - here]
        onward = max(directions, key=lambda direction: float(direction @ (middle - here)))
        entries.append((*xy, math.atan2(onward[1], onward[0])))
    return np.array(entries).reshape(-1, 3)
