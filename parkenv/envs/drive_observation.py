"""Observations of `parkenv/Drive-v1`: the space, the car's own state, the laser's scene, and the obstacle map."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled
from parkenv.driving.collision_world import ObstacleKind
from parkenv.driving.parking_task import REACH, ParkingTask
from parkenv.driving.vehicle import VehicleParameters
from sim_sensors.laser.footprints import ScanPlane
from sim_sensors.laser.scanner import LaserScanner

FAR = 1000.0  # coordinate, m, slot frame, that fills unused rows of the obstacle map
MOST_CARS, MOST_LINES = 160, 320  # rows of the obstacle map
CORNERS = 24  # corners of an outline in the obstacle map
BOUND = 2.0 * REACH  # bound of positions in the observation, m


def drive_observation_space(
    vehicle: VehicleParameters, laser: LaserScanner | None, *, n_movers: int, obstacle_map: bool
) -> spaces.Dict:
    """The observation space of `DriveEnv`.

    Args:
        vehicle: defines the bounds of speed, steering and acceleration.
        laser: adds `scan`.
        n_movers: number of moving road users, rows of `movers`.
        obstacle_map: whether to add `cars`, `lines`, `vehicle` and, with traffic, `movers`.
    """
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
    if obstacle_map:
        shown["cars"] = spaces.Box(-FAR, FAR, (MOST_CARS, CORNERS, 2), np.float32)
        shown["lines"] = spaces.Box(-FAR, FAR, (MOST_LINES, 2, 2), np.float32)
        shown["vehicle"] = spaces.Box(0.0, 1000.0, vehicle.numbers.shape, np.float32)
        if n_movers:
            shown["movers"] = spaces.Box(-FAR, FAR, (n_movers, CORNERS, 2), np.float32)
    return spaces.Dict(shown)


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
    """The scene of a laser low on the car: parked cars as footprints, kerbs and walls as walls.

    Args:
        task: defines the obstacles.
        movers: number of rows reserved after the cars for moving outlines.
    """
    cars = task.obstacles.only(ObstacleKind.PARKED_CAR)
    lines = task.obstacles.only(ObstacleKind.KERB, ObstacleKind.WALL)
    corners = np.zeros((len(cars) + movers, CORNERS, 2))
    corners[: len(cars), : cars.corners.shape[1]] = cars.corners
    n_corners = np.r_[cars.n_corners, np.zeros(movers, dtype=np.int64)]
    return ScanPlane(corners, n_corners, np.array(lines.corners[:, :2]))


def obstacle_map(task: ParkingTask) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """`cars` and `lines` of the observation (see `DriveEnv`), nearest first; rows beyond the space are dropped."""
    cars = np.full((MOST_CARS, CORNERS, 2), FAR, dtype=np.float32)
    lines = np.full((MOST_LINES, 2, 2), FAR, dtype=np.float32)
    parked = task.in_slot_frame(task.obstacles.only(ObstacleKind.PARKED_CAR).corners[:MOST_CARS])
    cars[: len(parked), : parked.shape[1]] = parked
    cars[: len(parked), parked.shape[1] :] = parked[:, -1:]
    drawn = task.in_slot_frame(task.obstacles.only(ObstacleKind.KERB, ObstacleKind.WALL).corners[:, :2])
    drawn = drawn[np.argsort(np.hypot(*drawn.mean(axis=1).T), kind="stable")][:MOST_LINES]
    lines[: len(drawn)] = drawn
    return cars, lines
