"""The paved area of a lot, its kerbs and walls, and the parked cars around one that drives through it."""

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.collision_world import ObstacleKind, Obstacles
from parkenv.world.drive_graph import SLOT_REACH, linestrings
from parkenv.world.lot import Mouth, ParkingLot, mouth_heading
from parkenv.world.lot_scene import LotScenes, slot_lot
from parkenv.world.occupancy.process import World
from parkenv.world.scenario import Scenario

ROAD_HALF_WIDTH = 3.0  # from the centre line of a lane without slots to its kerbs, m
# Limits, m, of half the width of a lane with slots, which extends to the slots' mouths.
HALF_WIDTHS = (2.0, 4.0)
JOINT = 0.6  # gaps between slots of up to twice this width, m, are paved
STRAIGHTENED = 0.03  # tolerance, m, for simplifying kerbs
REACH_M = 25.0  # distance, m along both axes, from the car beyond which obstacles are left out
OVERHANG_M = 0.25  # distance, m, by which parked cars may protrude from their slots at the mouth
# Slots up to which the whole paved area is computed at once; the union of a town takes ten seconds.
JOINED_WHOLE = 2000


class DrivableArea:
    """The paved area of a lot: lanes up to the mouths of their slots, slots, and the approaches to them."""

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


class LotObstacles:
    """Static obstacles in one world of a scenario.

    The parked cars are the same as in the sensors' scene (`parkenv.world.lot_scene`).
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        lot = scenario.lot
        self.slots = slot_lot(lot)
        self._area = DrivableArea(lot)
        self._still: dict[tuple[int, int], list[tuple[ObstacleKind, FloatArray]]] = {}
        heading = np.stack([np.cos(lot.slot_yaw), np.sin(lot.slot_yaw)], axis=1)
        out = np.where(lot.slot_mouth == Mouth.REAR, OVERHANG_M, 0.0)[:, None] * heading
        self._boxes = lot.slot_corners()
        self._boxes[:, [0, 3]] -= out[:, None]

    def begin(self, key: np.uint64, world: World) -> None:
        self._scenes = LotScenes(self.slots, self._scenario.replace(cues=None), key, world)

    def taken(self, center: FloatArray, time: float) -> list[int]:
        """Return the occupied slots within `REACH_M` of a point, (2,) m, at a time, s; ascending."""
        model = self._scenes.at(time).vehicle_model
        return [i for i in self._near(center) if model[i] >= 0]

    def at_time(self, center: FloatArray, time: float, slots: Iterable[int]) -> Obstacles:
        """Return the cars in the occupied `slots` at `time`, s, and kerbs and walls around a point, (2,) m."""
        cars = [(ObstacleKind.PARKED_CAR, self.footprint(i, time)) for i in slots]
        return Obstacles.of([*cars, *self.kerbs_and_walls(center)])

    def footprint(self, slot: int, time: float) -> FloatArray:
        return self._scenes.at(time).footprint(slot)

    def worst_case(self, center: FloatArray) -> Obstacles:
        """As `at_time`, with all slots occupied: a path clear of these obstacles is clear at any time."""
        boxes = [(ObstacleKind.PARKED_CAR, self._boxes[i]) for i in self._near(center)]
        return Obstacles.of([*boxes, *self.kerbs_and_walls(center)])

    def kerbs_and_walls(self, center: FloatArray) -> list[tuple[ObstacleKind, FloatArray]]:
        """Return the kerbs and walls near a point, computed per grid cell of 10 m."""
        column, row = np.round(center / 10.0).astype(int).tolist()
        if (column, row) not in self._still:
            middle = 10.0 * np.array([column, row])
            reach = REACH_M + 5.0
            self._still[column, row] = [
                *((ObstacleKind.KERB, line) for line in self._area.kerbs(middle, reach)),
                *((ObstacleKind.WALL, line) for line in self._area.walls(middle, reach)),
            ]
        return self._still[column, row]

    def _near(self, center: FloatArray) -> list[int]:
        near = np.abs(self._scenario.lot.slot_xy - center).max(axis=1) <= REACH_M
        return [int(i) for i in np.flatnonzero(near)]
