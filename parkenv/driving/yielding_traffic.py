"""Moving cars and pedestrians in a lot that wait for a car in their way."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.collision_world import ObstacleKind
from parkenv.driving.vehicle import placed
from parkenv.world.lot import ParkingLot
from parkenv.world.traffic import LotTraffic, Traffic
from sim_sensors.scenery import pedestrian_footprint
from sim_sensors.slot_scenes import SlotLot

if TYPE_CHECKING:
    from sim_sensors.movers import Movers


LOOK_AHEAD_S = (0.1, 0.6, 1.2)
"""Times ahead, s, at which road users check their own positions for conflicts with the car."""
GAP_M = 0.4  # clearance to the car, m

_FAR_M = 12.0
_LATER_S = 4.0
_MOST_TRIES = 50


class YieldingTraffic:
    """Road users on closed routes that are a pure function of (lot, key), each with its own clock.

    The clock of a road user stops while it waits, so positions depend only on the parking car.

    Args:
        lot: defines the lanes; pedestrians walk to its first goal.
        traffic: numbers of cars and pedestrians.
        key: key of the world.
        slots: scene data of the lot; provides the vehicle models.

    Attributes:
        outlines: kind and outline, (k, 2) m in its own frame, of each road user, cars first.
        corners: (n, k, 2) m, these outlines; shorter ones repeat their last corner.
    """

    def __init__(self, lot: ParkingLot, traffic: Traffic, key: np.uint64, slots: SlotLot) -> None:
        self._rounds = LotTraffic(lot, 0, traffic, key, slots)
        self.outlines: list[tuple[ObstacleKind, FloatArray]] = []
        movers = self._rounds.at(0.0)
        if movers is not None:
            models = [slots.fleet.models[i].footprint() for i in movers.vehicle_model.tolist()]
            people = [pedestrian_footprint(0.0)] * movers.n_walkers
            self.outlines = [
                *((ObstacleKind.MOVING_CAR, outline) for outline in models),
                *((ObstacleKind.PEDESTRIAN, outline) for outline in people),
            ]

        longest = max((len(outline) for _, outline in self.outlines), default=0)
        padded = [
            np.pad(outline, ((0, longest - len(outline)), (0, 0)), "edge") for _, outline in self.outlines
        ]
        self.corners = np.array(padded).reshape(-1, longest, 2)

    def poses(self, clocks: FloatArray) -> FloatArray:
        """Return poses, (n, 3) x, y in m and yaw in rad, at clocks, (n,) s."""
        return self._rounds.poses_at(clocks)

    def movers(self, clocks: FloatArray) -> Movers | None:
        """Return the road users at clocks, (n,) s, for the sensors; None without any.

        Road users whose clock is NaN are left out.
        """
        if not self.outlines:
            return None
        there = np.isfinite(clocks)
        every = self._rounds.movers_at(np.where(there, clocks, 0.0))
        return every.only(there[: every.n_vehicles], there[every.n_vehicles :])

    def initial_clocks(self, car: FloatArray) -> FloatArray:
        """Return clocks, (n,) s, at which no road user is close to a car with these corners, (4, 2) m."""
        clocks = np.zeros(len(self.outlines))
        for _ in range(_MOST_TRIES):
            near = ~self._clear(clocks, car, LOOK_AHEAD_S[-1:]) | ~self._clear(clocks, car, (0.0,))
            if not near.any():
                break
            clocks[near] += _LATER_S
        return clocks

    def advance_clocks(self, clocks: FloatArray, seconds: float, car: FloatArray) -> FloatArray:
        """Advance the clocks by `seconds`, except those of road users that would come too close to the car."""
        return np.where(self._clear(clocks, car, LOOK_AHEAD_S), clocks + seconds, clocks)

    def _clear(self, clocks: FloatArray, car: FloatArray, ahead: tuple[float, ...]) -> NDArray[np.bool_]:
        """Return the mask, (n,), of the road users whose way is clear."""
        clear = np.ones(len(clocks), dtype=bool)
        body = shapely.Polygon(car)
        middle = car.mean(axis=0)
        for later in ahead:
            poses = self.poses(clocks + later)
            close = np.hypot(*(poses[:, :2] - middle).T) < _FAR_M
            asked = np.flatnonzero(close & clear)
            if len(asked):
                outlines = shapely.polygons(placed(self.corners[asked], poses[asked]))
                clear[asked] = shapely.distance(body, outlines) > GAP_M
            if not close.any():
                break  # at these speeds no road user comes close within the prediction time
        return clear
