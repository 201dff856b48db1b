"""Pedestrians and cars that cross a scene on straight lines, wait for a car in their way, and give way in the end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.vehicle import VehicleParameters, placed
from parkenv.driving.yielding_traffic import GAP_M, LOOK_AHEAD_S
from parkenv.errors import InputError, require_number
from sim_sensors.scenery import pedestrian_footprint

PATIENCE_S = 3.0
"""Time that a road user and the car both stand until the road user goes back, s."""
BACK_S = 4.0
"""For how long it does, s."""
CAR = VehicleParameters()
# Moments between two states at which the car and the others are checked.
_STEPS = np.linspace(0.2, 1.0, 5)


@dataclass(frozen=True)
class Crossing:
    """A road user that crosses a scene.

    Args:
        kind: `pedestrian` or `car`.
        way: (2, 2) m, where it starts and ends; it stands there before and after.
        speed: m/s.
        begins_s: when it sets off, s.
    """

    kind: str
    way: tuple[tuple[float, float], tuple[float, float]]
    speed: float
    begins_s: float = 0.0

    def __post_init__(self) -> None:
        require_number("speed of a road user", self.speed, above=0.0)
        require_number("begins_s of a road user", self.begins_s, least=0.0)
        if not (np.isfinite(self.way).all() and self.length > 0.0):
            raise InputError(f"way of a road user is {self.way}, want two points apart")

    @property
    def length(self) -> float:
        """Length of its way, m."""
        return math.dist(*self.way)

    @property
    def outline(self) -> FloatArray:
        """Its outline in its own frame, (k, 2) m."""
        return pedestrian_footprint(0.0) if self.kind == "pedestrian" else CAR.corners(np.zeros(3))

    def poses(self, along: FloatArray) -> FloatArray:
        """Return poses, (..., 3), after `along`, (...), m."""
        (x, y), (to_x, to_y) = self.way
        share, yaw = along / self.length, math.atan2(to_y - y, to_x - x)
        return np.stack(
            [x + share * (to_x - x), y + share * (to_y - y), np.full(np.shape(along), yaw)], axis=-1
        )


class CrossingTraffic:
    """Road users of a scene while a car drives in it; their motion depends on the car alone.

    Args:
        crossings: the road users.

    Attributes:
        poses: (n, 3) x, y in m and yaw in rad.
        velocity: (n, 2) m/s, over the last step.
    """

    def __init__(self, crossings: Sequence[Crossing]) -> None:
        self._users = crossings
        self._time = 0.0
        # How far each is, m, how long it has waited with the car standing, and for how long it still goes back, s.
        self._along, self._waited, self._back = np.zeros((3, len(crossings)))
        longest = max((len(user.outline) for user in crossings), default=2)
        padded = [np.pad(u.outline, ((0, longest - len(u.outline)), (0, 0)), "edge") for u in crossings]
        self._own = np.array(padded).reshape(-1, longest, 2)
        self.poses, self.velocity = self._placed(self._along), np.zeros((len(crossings), 2))

    @property
    def outlines(self) -> FloatArray:
        """Outlines, (n, k, 2) m; shorter ones repeat their last corner."""
        return placed(self._own, self.poses)

    def advance(self, seconds: float, car: FloatArray, *, stands: bool) -> None:
        """Move on by `seconds`, beside a car with its corners at `car`, (4, 2) m, that stands or not."""
        self._time += seconds
        for i, user in enumerate(self._users):
            sign = -1.0 if self._back[i] > 0.0 else 1.0
            left = user.length - self._along[i] if sign > 0.0 else self._along[i]
            self._back[i] = max(self._back[i] - seconds, 0.0)
            if self._time < user.begins_s or left <= 0.0:
                continue
            ways = np.minimum(user.speed * np.array((0.0, *LOOK_AHEAD_S)), left)
            bodies = shapely.polygons(placed(self._own[i], user.poses(self._along[i] + sign * ways)))
            apart = np.asarray(shapely.distance(bodies, shapely.Polygon(car)))
            # It may always move away from the car.
            if apart[1:].min() > min(GAP_M, apart[0]):
                self._along[i] += sign * min(user.speed * seconds, left)
                self._waited[i] = 0.0
            else:
                self._waited[i] += seconds * stands
                if self._waited[i] >= PATIENCE_S:
                    self._back[i], self._waited[i] = (0.0 if self._back[i] > 0.0 else BACK_S), 0.0
        before, self.poses = self.poses, self._placed(self._along)
        self.velocity = (self.poses - before)[:, :2] / seconds

    def _placed(self, along: FloatArray) -> FloatArray:
        poses = [user.poses(way) for user, way in zip(self._users, along, strict=True)]
        return np.array(poses).reshape(-1, 3)


def caused_contact(
    vehicle: VehicleParameters, poses: FloatArray, crossings: Sequence[Crossing], others: FloatArray
) -> bool:
    """Return whether a moving car touches a road user; a standing one is never at fault.

    Args:
        vehicle: the car.
        poses: (n, 3) of its rear axle.
        crossings: the road users.
        others: (n, m, 3) their poses at the same times.
    """
    moved: NDArray[np.bool_] = (np.diff(poses, axis=0) != 0.0).any(axis=1)
    for i, user in enumerate(crossings):
        near = moved & (np.hypot(*(poses[1:, :2] - others[1:, i, :2]).T) < 12.0)
        at = np.flatnonzero(near)
        for share in _STEPS:
            both = [track[at] + share * (track[at + 1] - track[at]) for track in (poses, others[:, i])]
            cars = shapely.polygons(vehicle.corners(both[0]))
            if shapely.intersects(cars, shapely.polygons(placed(user.outline, both[1]))).any():
                return True
    return False
