"""Cars that drive and people who walk through a lot, and wait for a car that is in their way."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.driving.lot_space import Thing
from parkenv.driving.vehicle import placed
from parkenv.world.lot import ParkingLot
from parkenv.world.traffic import LotTraffic, Traffic
from sim_sensors.scenery import pedestrian_footprint
from sim_sensors.slot_scenes import SlotLot

if TYPE_CHECKING:
    from sim_sensors.movers import Movers

FloatArray = NDArray[np.float64]

LOOK_AHEAD_S = (0.1, 0.6, 1.2)
"""s ahead of themselves at which they look for the car."""
GAP_M = 0.4
"""m that they keep from it."""

_FAR_M = 12.0
_LATER_S = 4.0
_MOST_TRIES = 50


class PoliteTraffic:
    """Everybody who moves, on rounds that are a pure function of (lot, key), each with a clock of their own.

    A clock stands while its owner waits, so where they are depends on the car that parks, and on nothing else.

    Args:
        lot: whose lanes are driven and walked; people walk to its first goal.
        traffic: how much there is.
        key: of the world.
        slots: whose vehicle models are driven.

    Attributes:
        outlines: what each is, the cars first, and its outline, (k, 2) m, in its own frame.
    """

    def __init__(self, lot: ParkingLot, traffic: Traffic, key: np.uint64, slots: SlotLot) -> None:
        self._rounds = LotTraffic(lot, 0, traffic, key, slots)
        self.outlines: list[tuple[Thing, FloatArray]] = []
        movers = self._rounds.at(0.0)
        if movers is not None:
            models = [slots.fleet.models[i].footprint() for i in movers.vehicle_model.tolist()]
            people = [pedestrian_footprint(0.0)] * movers.n_walkers
            self.outlines = [
                *((Thing.MOVING_CAR, outline) for outline in models),
                *((Thing.PEDESTRIAN, outline) for outline in people),
            ]

    def poses(self, clocks: FloatArray) -> FloatArray:
        """(n, 3) x, y in m and yaw in rad at clocks, (n,) s."""
        return self._rounds.poses_at(clocks)

    def movers(self, clocks: FloatArray) -> Movers | None:
        """Who is where at clocks, (n,) s, for those who look through sensors; None where nobody is about.

        Whose clock is no number is left out.
        """
        there = np.isfinite(clocks)
        known = np.where(there, clocks, 0.0)
        at = [self._rounds.at(clock) for clock in known.tolist()]
        seen = [movers for movers in at if movers is not None]
        if not seen:
            return None
        poses, n = self.poses(known), seen[0].n_vehicles
        stride = np.array([movers.walker_stride[k] for k, movers in enumerate(seen[n:])])
        drives, walks = there[:n], there[n:]
        return replace(
            seen[0],
            vehicle_pose=poses[:n][drives],
            vehicle_model=seen[0].vehicle_model[drives],
            walker_pose=poses[n:][walks],
            walker_stride=stride[walks],
            walker_look=seen[0].walker_look[walks],
        )

    def started(self, car: FloatArray) -> FloatArray:
        """Clocks, (n,) s, at which nobody is near a car with these corners, (4, 2) m."""
        clocks = np.zeros(len(self.outlines))
        for _ in range(_MOST_TRIES):
            near = ~self._clear(clocks, car, LOOK_AHEAD_S[-1:]) | ~self._clear(clocks, car, (0.0,))
            if not near.any():
                break
            clocks[near] += _LATER_S
        return clocks

    def onward(self, clocks: FloatArray, seconds: float, car: FloatArray) -> FloatArray:
        """The clocks after some seconds, in which those wait who would come too near to the car."""
        return np.where(self._clear(clocks, car, LOOK_AHEAD_S), clocks + seconds, clocks)

    def _clear(self, clocks: FloatArray, car: FloatArray, ahead: tuple[float, ...]) -> NDArray[np.bool_]:
        """(n,) bool: whose way is clear."""
        clear = np.ones(len(clocks), dtype=bool)
        body = shapely.Polygon(car)
        middle = car.mean(axis=0)
        for later in ahead:
            poses = self.poses(clocks + later)
            close = np.hypot(*(poses[:, :2] - middle).T) < _FAR_M
            for i in np.flatnonzero(close & clear).tolist():
                outline = shapely.Polygon(placed(self.outlines[i][1], poses[i]))
                clear[i] = shapely.distance(body, outline) > GAP_M
            if not close.any():
                break  # at these speeds nobody comes near within the time that is looked ahead
        return clear
