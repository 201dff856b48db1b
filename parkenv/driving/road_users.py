"""Everybody else who moves while a car drives through a lot, and who lets whom go first."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from parkenv.driving.encounters import MOVES, encounters, in_frame
from parkenv.driving.polite_traffic import PoliteTraffic
from parkenv.driving.vehicle import VehicleParameters, placed

if TYPE_CHECKING:
    from sim_sensors.movers import Movers

FloatArray = NDArray[np.float64]

ROOM_M = 12.0
"""m, from the car's middle, within which nobody comes back who gave way."""

_OUT_OF_SIGHT = np.array([1e6, 1e6, 0.0])


class RoadUsers:
    """Cars and people on their rounds around a car.

    They wait for the car, and it for them. Where both wait, somebody has to give way, and `give_way` has them out of
    sight until the car is `ROOM_M` away; then they go on from where they stood. Where they turn aside to is left out,
    so a stand-off costs the time that it lasts, and always ends. Among each other they do not meet.

    Args:
        traffic: of the world.
        vehicle: the car that they wait for.

    Attributes:
        outlines: as of `PoliteTraffic`.
        clocks: (n,) s, of each; not a number of those who are out of sight.
        poses: (n, 3) x, y in m and yaw in rad, now; far away of those who are out of sight.
    """

    def __init__(self, traffic: PoliteTraffic, vehicle: VehicleParameters) -> None:
        self.outlines, self._traffic, self._vehicle = traffic.outlines, traffic, vehicle
        n = len(traffic.outlines)
        self._clocks, self._away = np.zeros(n), np.zeros(n, dtype=bool)
        self._before, self._velocity = self._clocks, np.zeros((n, 2))
        self.poses = self._placed(self._clocks)

    @property
    def clocks(self) -> FloatArray:
        """See the class."""
        return np.where(self._away, np.nan, self._clocks)

    def movers(self, clocks: FloatArray) -> Movers | None:
        """Who was where at clocks that were those of a moment; see `PoliteTraffic.movers`."""
        return self._traffic.movers(clocks)

    def make_room(self, car: FloatArray) -> None:
        """Have nobody near a car that appears with these corners, (4, 2) m."""
        self._leave(self._near(car))

    def give_way(self, who: NDArray[np.bool_]) -> None:
        """Have those, (n,) bool, out of sight who stand."""
        self._leave(who & (np.hypot(*self._velocity.T) <= MOVES))

    def onward(self, seconds: float, car: FloatArray) -> None:
        """Let some time pass, with the car's corners, (4, 2) m, where they are."""
        came = self._away & ~self._near(car)
        self._away &= ~came
        self._before = self._clocks
        onward = self._traffic.onward(self._clocks, seconds, car)
        self._clocks = np.where(self._away, self._clocks, onward)
        was, self.poses = self.poses, self._placed(self._clocks)
        self._velocity = (self.poses - was)[:, :2] / seconds
        self._velocity[came] = 0.0

    def between(self, share: float) -> FloatArray:
        """Poses, (n, 3), a share of the way from before the last step to now."""
        return self._placed(self._before + share * (self._clocks - self._before))

    def in_way(self, own: FloatArray) -> FloatArray:
        """When, (n,) s, each will be in the way of the car, going on as now; infinity where that is not soon.

        Args:
            own: (6, 3) m and rad, where the car's middle will be after `WATCHED_S`.
        """
        outlines = [
            placed(corners, pose) for (_, corners), pose in zip(self.outlines, self.poses, strict=True)
        ]
        when = encounters(self._vehicle, own, outlines, self._velocity)
        ahead = float(in_frame(own[0], own[-1:, :2])[0, 0])
        for i in np.flatnonzero(np.isfinite(when)).tolist():
            forward = in_frame(own[0], outlines[i])[:, 0]
            if (ahead * forward < -abs(ahead) * 0.5 * self._vehicle.length).all():
                when[i] = np.inf  # whoever comes from behind looks out alone
        return when

    def _near(self, car: FloatArray) -> NDArray[np.bool_]:
        away = self._traffic.poses(self._clocks)[:, :2] - car.mean(axis=0)
        return np.asarray(np.hypot(*away.T) < ROOM_M)

    def _leave(self, who: NDArray[np.bool_]) -> None:
        self._away |= who
        self._before = self._clocks
        self._velocity[who] = 0.0
        self.poses = self._placed(self._clocks)

    def _placed(self, clocks: FloatArray) -> FloatArray:
        return np.where(self._away[:, None], _OUT_OF_SIGHT, self._traffic.poses(clocks))
