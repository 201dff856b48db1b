"""Observations and goals of `parkenv/Drive-v1`: space, own state, laser scene, obstacle map, errors of a goal."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled
from parkenv.driving.collision_world import ObstacleKind
from parkenv.driving.parking_task import KINDS, REACH, DriveState, ParkingTask
from parkenv.driving.vehicle import VehicleParameters
from sim_sensors.laser.footprints import ScanPlane
from sim_sensors.laser.scanner import LaserScanner

FAR = 1000.0  # coordinate, m, slot frame, that fills unused rows of the obstacle map
MOST_CARS, MOST_LINES = 160, 320  # rows of the obstacle map
CORNERS = 24  # corners of an outline in the obstacle map
POSITION_TOLERANCE = 0.25  # largest distance, m, of a parked car's centre from the goal
ANGLE_TOLERANCE = math.radians(5.0)  # largest angle, rad, between a parked car's yaw and the goal's
STANDING = 0.05  # speed, m/s, up to which a car counts as standing
BOUND = 2.0 * REACH  # bound of positions in the observation, m


class DriveObserver:
    """What a car observes in a parking task: see the environment."""

    def __init__(
        self, vehicle: VehicleParameters, laser: LaserScanner | None, n_movers: int, has_map: bool
    ) -> None:
        self._vehicle, self._laser, self._n_movers, self._has_map = vehicle, laser, n_movers, has_map
        fastest = max(vehicle.max_speed, vehicle.max_reverse_speed)
        goal = np.array([BOUND, BOUND, 1.0, 1.0, fastest, BOUND, BOUND], dtype=np.float32)
        strongest = max(vehicle.max_braking, vehicle.max_acceleration)
        own = np.r_[goal[:5], vehicle.max_steering, strongest, BOUND, BOUND, 1.0, 1.0, 1.0]
        own = (own * (1.0 + 1e-6)).astype(np.float32)
        shown: dict[str, spaces.Space[Any]] = {
            "observation": spaces.Box(-own, own, dtype=np.float32),
            "achieved_goal": spaces.Box(-goal, goal, dtype=np.float32),
            "desired_goal": spaces.Box(-goal, goal, dtype=np.float32),
        }
        if laser is not None:
            shown["scan"] = spaces.Box(0.0, laser.max_range, (laser.n_beams,), np.float32)
        if has_map:
            shown["cars"] = spaces.Box(-FAR, FAR, (MOST_CARS, CORNERS, 2), np.float32)
            shown["lines"] = spaces.Box(-FAR, FAR, (MOST_LINES, 2, 2), np.float32)
            shown["vehicle"] = spaces.Box(0.0, 1000.0, vehicle.numbers.shape, np.float32)
            if n_movers:
                shown["movers"] = spaces.Box(-FAR, FAR, (n_movers, CORNERS, 2), np.float32)
        self.space = spaces.Dict(shown)

    def enter(self, task: ParkingTask) -> None:
        self._slot = np.array([*task.slot.tolist(), *task.room.tolist()])
        self._kind = np.array([kind == task.kind for kind in KINDS], dtype=np.float32)
        self._desired = goal_of(task)
        if self._laser is not None:
            self._plane = scan_plane(task, self._n_movers)
        if self._has_map:
            self._map = obstacle_map(task)

    def observe(self, state: DriveState, movers: Sequence[FloatArray]) -> tuple[dict[str, Any], float]:
        """Return the observation among the outlines of moving road users, and the distance from the slot along x or y.

        The laser draws its noise from the state's generator.
        """
        own, achieved = np.empty(12, np.float32), np.empty(7, np.float32)
        away = fill_observation(state.vehicle, self._slot, self._kind, self._vehicle.middle, own, achieved)
        observation = {"observation": own, "achieved_goal": achieved, "desired_goal": self._desired.copy()}
        if self._laser is not None:
            for k, outline in enumerate(movers):
                self._plane.replace(self._plane.n_footprints - 1 - k, outline)
            scan = self._laser.scan(self._plane, self._vehicle.at_middle(state.vehicle[:3]), state.rng)
            observation["scan"] = np.minimum(scan, np.float32(self._laser.max_range))
        if self._has_map:
            observation["cars"], observation["lines"] = self._map[0].copy(), self._map[1].copy()
            observation["vehicle"] = self._vehicle.numbers.copy()
            if self._n_movers:
                seen = np.array([np.r_[o, np.repeat(o[-1:], CORNERS - len(o), axis=0)] for o in movers])
                seen = np.clip(state.task.in_slot_frame(seen), -FAR, FAR)
                observation["movers"] = seen.astype(np.float32)
        return observation, away


@compiled(error_model="numpy")
def fill_observation(
    vehicle: FloatArray,
    slot: FloatArray,
    kind: NDArray[np.float32],
    middle: float,
    own: NDArray[np.float32],
    achieved: NDArray[np.float32],
) -> float:
    """Fill `own`, (12,), and `achieved`, (7,); return the car's distance from the slot along x or y, m."""
    yaw = vehicle[2]
    dx, dy = vehicle[0] + middle * math.cos(yaw) - slot[0], vehicle[1] + middle * math.sin(yaw) - slot[1]
    c, s = math.cos(slot[2]), math.sin(slot[2])
    own[0], own[1] = c * dx + s * dy, c * dy - s * dx
    own[2], own[3] = math.cos(yaw - slot[2]), math.sin(yaw - slot[2])
    own[4], own[5], own[6] = vehicle[3], vehicle[4], vehicle[5]
    own[7], own[8] = slot[3], slot[4]
    for i in range(3):
        own[9 + i] = kind[i]
    for i in range(7):
        achieved[i] = own[i if i < 5 else i + 2]
    return float(max(abs(dx), abs(dy)))


def scan_plane(task: ParkingTask, movers: int = 0) -> ScanPlane:
    cars = task.obstacles.only(ObstacleKind.PARKED_CAR)
    lines = task.obstacles.only(ObstacleKind.KERB, ObstacleKind.WALL)
    corners = np.zeros((len(cars) + movers, CORNERS, 2))
    corners[: len(cars), : cars.corners.shape[1]] = cars.corners
    n_corners = np.r_[cars.n_corners, np.zeros(movers, dtype=np.int64)]
    return ScanPlane(corners, n_corners, np.array(lines.corners[:, :2]))


def obstacle_map(task: ParkingTask) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    cars = np.full((MOST_CARS, CORNERS, 2), FAR, dtype=np.float32)
    lines = np.full((MOST_LINES, 2, 2), FAR, dtype=np.float32)
    parked = task.in_slot_frame(task.obstacles.only(ObstacleKind.PARKED_CAR).corners[:MOST_CARS])
    cars[: len(parked), : parked.shape[1]] = parked
    cars[: len(parked), parked.shape[1] :] = parked[:, -1:]
    drawn = task.in_slot_frame(task.obstacles.only(ObstacleKind.KERB, ObstacleKind.WALL).corners[:, :2])
    drawn = drawn[np.argsort(np.hypot(*drawn.mean(axis=1).T), kind="stable")][:MOST_LINES]
    lines[: len(drawn)] = drawn
    return cars, lines


def goal_errors(
    achieved: NDArray[np.float32], desired: NDArray[np.float32], half: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return distance, m, angle, rad, and whether the car is parked, (n,) each, of achieved goals, (n, 7).

    `half` are half the car's length and width, m.
    """
    errors = np.array([goal_error(a, d, half) for a, d in zip(achieved, desired, strict=True)]).reshape(-1, 3)
    return errors[:, 0], errors[:, 1], errors[:, 2] > 0.5


def goal_of(task: ParkingTask) -> NDArray[np.float32]:
    turned = float(task.target[2] - task.slot[2])
    still = [0.0, 0.0, round(math.cos(turned), 9), round(math.sin(turned), 9), 0.0, *task.room.tolist()]
    return np.array(still, dtype=np.float32)


@compiled(error_model="numpy")
def goal_error(
    achieved: NDArray[np.float32], desired: NDArray[np.float32], half: FloatArray
) -> tuple[float, float, float]:
    dx, dy = float(achieved[0]) - float(desired[0]), float(achieved[1]) - float(desired[1])
    c, s = float(desired[2]), float(desired[3])
    cosine = float(achieved[2]) * c + float(achieved[3]) * s
    sine = float(achieved[3]) * c - float(achieved[2]) * s
    ahead, aside = abs(c * dx + s * dy), abs(c * dy - s * dx)
    distance, angle = math.hypot(dx, dy), abs(math.atan2(sine, cosine))
    long = half[0] * math.cos(angle) + half[1] * math.sin(angle)
    wide = half[0] * math.sin(angle) + half[1] * math.cos(angle)
    inside = ahead + long <= half[0] + float(desired[5]) and aside + wide <= half[1] + float(desired[6])
    near = distance <= POSITION_TOLERANCE and angle <= ANGLE_TOLERANCE
    stands = abs(float(achieved[4]) - float(desired[4])) <= STANDING
    return distance, angle, 1.0 if (near and inside and stands) else 0.0
