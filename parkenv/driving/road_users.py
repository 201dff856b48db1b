"""Road users around a car that drives through a lot, and the rules of yielding."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.encounters import MOVES, encounter_times, to_car_frame
from parkenv.driving.vehicle import VehicleParameters, placed
from parkenv.driving.yielding_traffic import YieldingTraffic

if TYPE_CHECKING:
    from sim_sensors.movers import Movers


CLEAR_RADIUS_M = 12.0  # radius, m, around the car's centre within which hidden road users do not return

_FAR_AWAY = np.array([1e6, 1e6, 0.0])


class RoadUsers:
    """Cars and pedestrians on their routes around a driving car.

    They wait for the car, and it waits for them. `hide_standing` resolves a deadlock: it removes standing road users
    until the car is `CLEAR_RADIUS_M` away; then they continue from the same position. This replaces evasive manoeuvres:
    a deadlock costs time but always ends. Road users do not interact with each other.

    Args:
        traffic: traffic of the world.
        vehicle: the driving car.

    Attributes:
        outlines: see `YieldingTraffic`.
        clocks: (n,) s; NaN for hidden road users.
        poses: (n, 3) current x, y in m and yaw in rad; far away for hidden road users.
    """

    def __init__(self, traffic: YieldingTraffic, vehicle: VehicleParameters) -> None:
        self.outlines, self._traffic, self._vehicle = traffic.outlines, traffic, vehicle
        n = len(traffic.outlines)
        self._clocks, self._hidden = np.zeros(n), np.zeros(n, dtype=bool)
        self._before, self._velocity = self._clocks, np.zeros((n, 2))
        self.poses = self._placed(self._clocks)

    @property
    def clocks(self) -> FloatArray:
        """See the class."""
        return np.where(self._hidden, np.nan, self._clocks)

    def movers(self, clocks: FloatArray) -> Movers | None:
        """Road users at recorded clocks; see `YieldingTraffic.movers`."""
        return self._traffic.movers(clocks)

    def clear_area(self, car: FloatArray) -> None:
        """Hide the road users near a car that appears with these corners, (4, 2) m."""
        self._hide(self._near(car))

    def hide_standing(self, mask: NDArray[np.bool_]) -> None:
        """Hide the road users selected by `mask`, (n,) bool, while they stand still."""
        self._hide(mask & (np.hypot(*self._velocity.T) <= MOVES))

    def advance(self, seconds: float, car: FloatArray) -> None:
        """Advance by `seconds`, with the car's corners at `car`, (4, 2) m."""
        returned = self._hidden & ~self._near(car)
        self._hidden &= ~returned
        self._before = self._clocks
        onward = self._traffic.advance_clocks(self._clocks, seconds, car)
        self._clocks = np.where(self._hidden, self._clocks, onward)
        was, self.poses = self.poses, self._placed(self._clocks)
        self._velocity = (self.poses - was)[:, :2] / seconds
        self._velocity[returned] = 0.0

    def interpolate(self, share: float) -> FloatArray:
        """Poses, (n, 3), interpolated over the last step: `share` 0 before it, 1 after."""
        return self._placed(self._before + share * (self._clocks - self._before))

    def encounter_times(self, own: FloatArray) -> FloatArray:
        """Return the time, (n,) s, until each road user is in the car's way; infinity beyond the horizon.

        Velocities are assumed constant.

        Args:
            own: (6, 3) m and rad, poses of the car's centre after `PREDICTION_TIMES_S`.
        """
        outlines = placed(self._traffic.corners, self.poses)
        when = encounter_times(self._vehicle, own, outlines, self._velocity)
        ahead = float(to_car_frame(own[0], own[-1:, :2])[0, 0])
        for i in np.flatnonzero(np.isfinite(when)).tolist():
            forward = to_car_frame(own[0], outlines[i])[:, 0]
            if (ahead * forward < -abs(ahead) * 0.5 * self._vehicle.length).all():
                when[i] = np.inf  # road users behind the car yield to it
        return when

    def _near(self, car: FloatArray) -> NDArray[np.bool_]:
        away = self._traffic.poses(self._clocks)[:, :2] - car.mean(axis=0)
        return np.asarray(np.hypot(*away.T) < CLEAR_RADIUS_M)

    def _hide(self, mask: NDArray[np.bool_]) -> None:
        self._hidden |= mask
        self._before = self._clocks
        self._velocity[mask] = 0.0
        self.poses = self._placed(self._clocks)

    def _placed(self, clocks: FloatArray) -> FloatArray:
        return np.where(self._hidden[:, None], _FAR_AWAY, self._traffic.poses(clocks))
