"""Observation and action of learned parking agents, on top of `parkenv/Drive-v1`.

The policy observes the free distance in every direction, from the car's outline to the nearest obstacle, and commands
speed and steering for the next 0.4 s. The current and the desired pose are in the goals.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from parkenv.compiled.arrays import Float32Array, FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.driving.vehicle import ACCELERATION, SPEED, STEERING, YAW, VehicleParameters

INTERFACE = "drive-1"
"""Version of the layout of observation and action; models of another version are refused."""
ACTION_REPEAT = 4  # environment steps per decision
BEAMS = 48  # number of directions in which free distance is measured, all around, the first one ahead
FARTHEST_M = 10.0  # maximum measured free distance, m
SPEEDS = (2.0, 1.5)  # maximum commanded speed forward and backward, m/s: about that of the planner
STAND = 0.2  # dead band of the speed command, within which the car stands
OBSERVATION_SIZE = 8 + BEAMS  # length of the observation vector

_CONTROL_S = 0.1
_NOWHERE = 999.0  # m; unused rows of the obstacle map are farther away
_CIRCLE = 2.0 * math.pi / BEAMS


class Outlines(NamedTuple):
    """Obstacles in the slot's frame, as arrays for compiled code."""

    edges: FloatArray  # (n_edges, 4) float64, m: x, y of both ends; edges of one obstacle are consecutive
    first: IntArray  # (n + 1,) int64: index of the first edge of each obstacle
    circle: FloatArray  # (n, 3) float64, m: centre x, y and radius of a circle around each obstacle

    @classmethod
    def of(cls, corners: FloatArray, n_corners: IntArray, circle: FloatArray) -> Outlines:
        """Convert convex outlines, (n, k_max, 2) m, with circles around them, (n, 3) m; lines have two corners."""
        around = np.concatenate([corners, np.roll(corners, -1, axis=1)], axis=2)
        last = np.maximum(n_corners, 2) - 1
        around[np.arange(len(corners)), last, 2:] = corners[:, 0]
        # A line has one edge.
        count = np.where(n_corners > 2, n_corners, 1)
        edges = around[np.arange(corners.shape[1]) < count[:, None]]
        return cls(edges, np.concatenate([[0], np.cumsum(count)]).astype(np.int64), circle)

    @classmethod
    def of_map(cls, cars: Float32Array, lines: Float32Array) -> Outlines:
        """Convert `cars`, (n, 24, 2) m, and `lines`, (m, 2, 2) m, from an observation with the obstacle map."""
        cars = cars[cars[:, 0, 0] < _NOWHERE].astype(np.float64)
        lines = lines[lines[:, 0, 0] < _NOWHERE].astype(np.float64)
        around = np.concatenate([cars, np.roll(cars, -1, axis=1)], axis=2)
        # Outlines with fewer corners repeat the last one.
        long = (np.abs(around[..., :2] - around[..., 2:]) > 0.0).any(axis=2)
        edges = np.concatenate([around[long], lines.reshape(-1, 4)])
        count = np.concatenate([long.sum(axis=1), np.ones(len(lines), dtype=np.int64)])
        middle = np.concatenate(
            [0.5 * (corners.min(axis=1) + corners.max(axis=1)) for corners in (cars, lines)]
        )
        radius = np.concatenate(
            [
                np.hypot(*np.moveaxis(corners - middle[part, None], 2, 0)).max(axis=1, initial=0.0)
                for corners, part in ((cars, slice(len(cars))), (lines, slice(len(cars), None)))
            ]
        )
        first = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
        return cls(edges, first, np.column_stack([middle, radius]))


@dataclass(frozen=True)
class PolicyInterface:
    """Constants of the interface for one car."""

    vehicle: VehicleParameters  # the car

    @cached_property
    def half(self) -> FloatArray:
        """Half the car's length and width, (2,) m."""
        return 0.5 * np.array([self.vehicle.length, self.vehicle.width])

    @cached_property
    def body(self) -> FloatArray:
        """Distance from the car's middle to its outline along each beam, (BEAMS,) m."""
        angle = _CIRCLE * np.arange(BEAMS)
        directions = np.abs(np.stack([np.cos(angle), np.sin(angle)]))
        reach: FloatArray = (self.half[:, None] / np.maximum(directions, 1e-9)).min(axis=0)
        return reach

    @cached_property
    def pedals(self) -> FloatArray:
        """Parameters of `pedal_command`, (4,): maximum braking and acceleration, m/s², and `SPEEDS`."""
        return np.array([self.vehicle.max_braking, self.vehicle.max_acceleration, *SPEEDS])


@compiled(error_model="numpy")
def pedal_command(action: Float32Array, speed: float, pedals: FloatArray) -> float:
    """Return the acceleration command, -1 to 1, that reaches the commanded speed.

    Args:
        action: (2,) speed as a fraction of the maximum, and steering, both -1 to 1.
        speed: speed of the car, m/s.
        pedals: `PolicyInterface.pedals`.
    """
    target = min(max(float(action[0]), -1.0), 1.0)
    size = (abs(target) - STAND) / (1.0 - STAND)
    wanted = 0.0 if size <= 0.0 else size * pedals[2] if target > 0.0 else -size * pedals[3]
    needed = (wanted - speed) / _CONTROL_S
    return float(min(max(needed / (pedals[0] if needed * speed < 0.0 else pedals[1]), -1.0), 1.0))


@compiled(error_model="numpy")
def encode_observation(
    middle: FloatArray,
    state: FloatArray,
    outlines: tuple[FloatArray, IntArray, FloatArray],
    body: FloatArray,
    about: FloatArray,
    seen: Float32Array,
) -> None:
    """Fill the observation vector: the car's state and the free distance around it.

    Args:
        middle: (2,) x, y of the footprint's middle, m, slot frame.
        state: (6,) state of the vehicle, with the yaw in the slot frame.
        outlines: see `Outlines`.
        body: `PolicyInterface.body`.
        about: (5,) half the differences of length and width of slot and car, m, and the slot's kind, one-hot.
        seen: (`OBSERVATION_SIZE`,) float32, output: speed, steering angle and acceleration, each scaled to about one;
            `about`; and for each beam 1 / (1 + free distance in m), which is 1 at contact.
    """
    seen[0], seen[1], seen[2] = state[SPEED] / 2.0, state[STEERING] / 0.6, state[ACCELERATION] / 3.0
    for k in range(5):
        seen[3 + k] = about[k]
    free_distances(middle, state[YAW], outlines, body, seen[8:])


@compiled(error_model="numpy")
def free_distances(
    middle: FloatArray,
    yaw: float,
    outlines: tuple[FloatArray, IntArray, FloatArray],
    body: FloatArray,
    seen: Float32Array,
) -> None:
    """Fill `seen`, (`BEAMS`,), with 1 / (1 + free distance in m) for each beam; arguments as above."""
    edges, first, circle = outlines
    # Compare edges by inverse distance, 1/m: beams parallel to an edge then need no special case.
    near = np.full(BEAMS, 1.0 / (FARTHEST_M + 3.0))
    ahead, aside = np.empty(BEAMS), np.empty(BEAMS)
    for b in range(BEAMS):
        ahead[b], aside[b] = math.cos(yaw + _CIRCLE * b), math.sin(yaw + _CIRCLE * b)
    for i in range(len(circle)):
        dx, dy = circle[i, 0] - middle[0], circle[i, 1] - middle[1]
        reach = circle[i, 2] + FARTHEST_M + 3.0
        if dx * dx + dy * dy > reach * reach:
            continue
        for k in range(first[i], first[i + 1]):
            px, py = edges[k, 0] - middle[0], edges[k, 1] - middle[1]
            qx, qy = edges[k, 2] - middle[0], edges[k, 3] - middle[1]
            twice = px * qy - py * qx
            if abs(twice) < 1e-12:
                continue
            for b in range(BEAMS):
                # The ray crosses the edge if the edge's ends lie on opposite sides of the ray.
                left, right = ahead[b] * qy - aside[b] * qx, aside[b] * px - ahead[b] * py
                if left * twice >= 0.0 and right * twice >= 0.0:
                    near[b] = max(near[b], (left + right) / twice)
    for b in range(BEAMS):
        seen[b] = 1.0 / (1.0 + min(max(1.0 / near[b] - body[b], 0.0), FARTHEST_M))
