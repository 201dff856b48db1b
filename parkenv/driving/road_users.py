"""Moving cars and pedestrians in a lot: when they meet a car, how they wait for it, and it for them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.collision_world import ObstacleKind, padded
from parkenv.driving.vehicle import VehicleParameters, placed
from parkenv.errors import InputError
from parkenv.files.field_types import NotNegative, Positive, Validated
from parkenv.world.lot import ParkingLot
from parkenv.world.traffic import LotTraffic, Traffic
from sim_sensors.scenery import pedestrian_footprint
from sim_sensors.slot_scenes import SlotLot

if TYPE_CHECKING:
    from sim_sensors.movers import Movers


# Times, s from now, at which positions are predicted.
PREDICTION_TIMES_S = np.array([0.0, 0.4, 0.8, 1.2, 1.6, 2.0])
# Clearance, m, to road users that move, and to those that stand and wait.
MOVING_CLEARANCE_M, STANDING_CLEARANCE_M = 0.5, 0.05
MOVES = 0.1  # speed, m/s, above which a road user counts as moving
START_SPEED = 0.7  # speed, m/s, at which a standing car is assumed to start

_NEAR_M = 20.0


def to_car_frame(poses: FloatArray, points: FloatArray) -> FloatArray:
    """Transform points, (..., k, 2) m, into the frame of a car at poses, (..., 3) m and rad: forward and left."""
    c, s = np.cos(poses[..., 2, None]), np.sin(poses[..., 2, None])
    offset = points - poses[..., None, :2]
    return np.stack([c * offset[..., 0] + s * offset[..., 1], c * offset[..., 1] - s * offset[..., 0]], -1)


def encounter_times(
    vehicle: VehicleParameters, own: FloatArray, outlines: FloatArray, velocity: FloatArray
) -> FloatArray:
    """Return the time, (n,) s, until each road user comes too close to the car, at constant velocity.

    It is one of `PREDICTION_TIMES_S`, after which the car's middle is at `own`, (6, 3); infinity for road users that
    stay far enough away. Their `outlines`, (n, k, 2) m, repeat last corners; their `velocity` is (n, 2) m/s.
    """
    when = np.full(len(outlines), np.inf)
    near = np.hypot(*(outlines.mean(axis=1) - own[0, :2]).T) < _NEAR_M
    # Overlap with the car's box, enlarged by the clearance; (n, 6, k, 2).
    moved = PREDICTION_TIMES_S[:, None, None] * velocity[near, None, None]
    local = to_car_frame(own, outlines[near, None] + moved)
    moves = np.hypot(*velocity[near].T) > MOVES
    clearance = np.where(moves, MOVING_CLEARANCE_M, STANDING_CLEARANCE_M)
    margin = 0.5 * np.array([vehicle.length, vehicle.width]) + clearance[:, None, None]
    meets = ((local.min(axis=2) < margin) & (local.max(axis=2) > -margin)).all(axis=2)
    when[near] = np.where(meets.any(axis=1), PREDICTION_TIMES_S[meets.argmax(axis=1)], np.inf)
    return when


# Times ahead, s, at which road users check their own positions for conflicts with the car.
LOOK_AHEAD_S = (0.1, 0.6, 1.2)
GAP_M = 0.4  # clearance to the car, m

_FAR_M = 12.0
_LATER_S = 4.0
_MOST_TRIES = 50


def is_blocked(
    vehicle: VehicleParameters, own: FloatArray, outlines: FloatArray, velocity: FloatArray
) -> bool:
    """Return whether a road user comes too close to the car, see `encounter_times`."""
    return bool(np.isfinite(encounter_times(vehicle, own, outlines, velocity)).any())


class YieldingTraffic:
    """Road users on closed routes that are a pure function of (lot, key), each with its own clock.

    The clock of a road user stops while it waits, so positions depend only on the parking car.

    Attributes:
        outlines: kind and outline, (k, 2) m in its own frame, of each road user, cars first.
        corners: (n, k, 2) m, these outlines; shorter ones repeat their last corner.
    """

    def __init__(self, lot: ParkingLot, traffic: Traffic, key: np.uint64, slots: SlotLot) -> None:
        self._rounds = LotTraffic(lot, 0, traffic, key, slots)
        self.outlines: list[tuple[ObstacleKind, FloatArray]] = []
        movers = self._rounds.at(0.0)
        if movers is not None:
            models = [slots.fleet.models[i] for i in movers.vehicle_model.tolist()]
            self.outlines = [(ObstacleKind.MOVING_CAR, model.footprint()) for model in models]
            self.outlines += [(ObstacleKind.PEDESTRIAN, pedestrian_footprint(0.0))] * movers.n_walkers
        self.corners = padded([outline for _, outline in self.outlines])

    def poses(self, clocks: FloatArray) -> FloatArray:
        """Return poses, (n, 3) x, y in m and yaw in rad, at clocks, (n,) s."""
        return self._rounds.poses_at(clocks)

    def movers(self, clocks: FloatArray) -> Movers | None:
        """Return the road users at clocks, (n,) s, for the sensors, without those whose clock is NaN."""
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


CLEAR_RADIUS_M = 12.0  # radius, m, around the car's centre within which hidden road users do not return

_FAR_AWAY = np.array([1e6, 1e6, 0.0])


class RoadUsers:
    """Cars and pedestrians on their routes around a driving car.

    They wait for the car, and it waits for them. `hide_standing` resolves a deadlock: it removes standing road users
    until the car is `CLEAR_RADIUS_M` away; then they continue from the same position. This replaces evasive manoeuvres:
    a deadlock costs time but always ends. Road users do not interact with each other.

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
        return np.where(self._hidden, np.nan, self._clocks)

    def movers(self, clocks: FloatArray) -> Movers | None:
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
        """Return the time, (n,) s, until each road user is in the car's way, see the function `encounter_times`."""
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


# ---- road users of a scene, which cross it on straight lines, wait for a car in their way, and give way in the end

PATIENCE_S = 3.0  # time that a road user and the car both stand until the road user goes back, s
BACK_S = 4.0  # for how long it does, s
CAR = VehicleParameters()
# Moments between two states at which the car and the others are checked.
_STEPS = np.linspace(0.2, 1.0, 5)


@dataclass(frozen=True)
class Crossing(Validated):
    """A road user that crosses a scene; it stands at the ends of its way before and after."""

    kind: str  # `pedestrian` or `car`
    way: tuple[tuple[float, float], tuple[float, float]]  # start and end, m
    speed: Positive  # m/s
    begins_s: NotNegative = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (np.isfinite(self.way).all() and self.length > 0.0):
            raise InputError(f"way of a road user is {self.way}, want two points apart")

    @property
    def length(self) -> float:
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

    Attributes:
        poses: (n, 3) x, y in m and yaw in rad.
        velocity: (n, 2) m/s, over the last step.
    """

    def __init__(self, crossings: Sequence[Crossing]) -> None:
        self._users = crossings
        self._time = 0.0
        # How far each is, m, how long it has waited with the car standing, and for how long it still goes back, s.
        self._along, self._waited, self._back = np.zeros((3, len(crossings)))
        self._own = padded([user.outline for user in crossings])
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

    `poses`, (n, 3), are of the car's rear axle, `others`, (n, m, 3), of the road users at the same times.
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
