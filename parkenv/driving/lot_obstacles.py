"""Obstacles around a car that drives through a whole lot: currently parked cars, kerbs and walls."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.collision_world import ObstacleKind, Obstacles
from parkenv.driving.drivable_area import DrivableArea
from parkenv.world.lot import Mouth
from parkenv.world.lot_scene import LotScenes, slot_lot
from parkenv.world.occupancy.process import World
from parkenv.world.scenario import Scenario

REACH_M = 25.0  # distance, m along both axes, from the car beyond which obstacles are left out
OVERHANG_M = 0.25  # distance, m, by which parked cars may protrude from their slots at the mouth


class LotObstacles:
    """Static obstacles in one world of a scenario.

    The parked cars are the same as in the sensors' scene (`parkenv.world.lot_scene`).

    Args:
        scenario: defines lot and traffic.

    Attributes:
        slots: scene data of the lot, for the sensors.
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
        """Switch to the world of a key."""
        self._scenes = LotScenes(self.slots, self._scenario, key, world)

    def taken(self, center: FloatArray, time: float) -> list[int]:
        """Return the occupied slots within `REACH_M` of a point, (2,) m, at a time, s; ascending."""
        model = self._scenes.at(time).vehicle_model
        return [i for i in self._near(center) if model[i] >= 0]

    def at_time(self, center: FloatArray, time: float, slots: Iterable[int]) -> Obstacles:
        """Return the cars in the occupied `slots` at `time`, s, and kerbs and walls around a point, (2,) m."""
        cars = [(ObstacleKind.PARKED_CAR, self.footprint(i, time)) for i in slots]
        return Obstacles.of([*cars, *self.kerbs_and_walls(center)])

    def footprint(self, slot: int, time: float) -> FloatArray:
        """Return the outline, (k, 2) m, of the car in an occupied slot."""
        return self._scenes.at(time).footprint(slot)

    def worst_case(self, center: FloatArray) -> Obstacles:
        """As `at_time`, with all slots occupied: a path clear of these obstacles is clear at any time."""
        boxes = [(ObstacleKind.PARKED_CAR, self._boxes[i]) for i in self._near(center)]
        return Obstacles.of([*boxes, *self.kerbs_and_walls(center)])

    def kerbs_and_walls(self, center: FloatArray) -> list[tuple[ObstacleKind, FloatArray]]:
        """Return the kerbs and walls near a point."""
        # Computed per grid cell of 10 m, so that nearby points share the result.
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
