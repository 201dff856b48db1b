"""What stands around a car that drives through a whole lot: who is parked there now, kerbs and walls."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.driving.drivable_area import DrivableArea
from parkenv.driving.lot_space import Obstacles, Thing
from parkenv.world.lot import Mouth
from parkenv.world.lot_scene import LotScenes, slot_lot
from parkenv.world.occupancy import World
from parkenv.world.scenario import Scenario

FloatArray = NDArray[np.float64]

REACH_M = 25.0
"""m, from the car along both axes: what is farther away is left out."""
OVERHANG_M = 0.25
"""m, by which cars may stand out of their slots at the mouth."""


class LotSurroundings:
    """Everything that a car may run into in one world of a scenario.

    The cars are those that the sensors would see there (`parkenv.world.lot_scene`).

    Args:
        scenario: whose lot it is.

    Attributes:
        slots: of the lot, as the sensors see it.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        lot = scenario.lot
        self.slots = slot_lot(lot)
        self._area = DrivableArea(lot)
        legs = np.array([leg for wall in lot.walls for leg in pairwise(wall)]).reshape(-1, 2, 2)
        self._walls = shapely.STRtree(np.asarray(shapely.linestrings(legs))), legs
        self._still: dict[tuple[int, int], list[tuple[Thing, FloatArray]]] = {}
        heading = np.stack([np.cos(lot.slot_yaw), np.sin(lot.slot_yaw)], axis=1)
        out = np.where(lot.slot_mouth == Mouth.REAR, OVERHANG_M, 0.0)[:, None] * heading
        self._boxes = lot.slot_corners()
        self._boxes[:, [0, 3]] -= out[:, None]

    def begin(self, key: np.uint64, world: World) -> None:
        """Turn to the world of a key."""
        self._scenes = LotScenes(self.slots, self._scenario, key, world)

    def taken(self, center: FloatArray, time: float) -> list[int]:
        """The slots within `REACH_M` of a point, (2,) m, that are taken at a time, s; ascending."""
        model = self._scenes.at(time).vehicle_model
        return [i for i in self._near(center) if model[i] >= 0]

    def now(self, center: FloatArray, time: float, slots: Iterable[int]) -> Obstacles:
        """The cars in some slots, which are taken at a time, s, and kerbs and walls around a point, (2,) m."""
        cars = [(Thing.PARKED_CAR, self.footprint(i, time)) for i in slots]
        return Obstacles.of([*cars, *self.lines(center)])

    def footprint(self, slot: int, time: float) -> FloatArray:
        """Outline, (k, 2) m, of the car in a slot that is taken."""
        return self._scenes.at(time).footprint(slot)

    def at_worst(self, center: FloatArray) -> Obstacles:
        """As `now`, with all slots filled: whoever keeps clear of that may drive there at any time."""
        boxes = [(Thing.PARKED_CAR, self._boxes[i]) for i in self._near(center)]
        return Obstacles.of([*boxes, *self.lines(center)])

    def lines(self, center: FloatArray) -> list[tuple[Thing, FloatArray]]:
        """Kerbs and walls near a point."""
        # Of a whole square, so that places near each other share them.
        column, row = np.round(center / 10.0).astype(int).tolist()
        if (column, row) not in self._still:
            middle = 10.0 * np.array([column, row])
            reach = REACH_M + 5.0
            tree, legs = self._walls
            walls = legs[np.sort(tree.query(shapely.box(*(middle - reach), *(middle + reach))))]
            self._still[column, row] = [
                *((Thing.KERB, line) for line in self._area.kerbs(middle, reach)),
                *((Thing.WALL, line) for line in walls),
            ]
        return self._still[column, row]

    def _near(self, center: FloatArray) -> list[int]:
        near = np.abs(self._scenario.lot.slot_xy - center).max(axis=1) <= REACH_M
        return [int(i) for i in np.flatnonzero(near)]
