"""What a driver that learns sees of `parkenv/Drive-v1`, and what its decisions make the car do.

It sees how much room there is in every direction, from a car's outline to the nearest of the others', and decides how
fast to go and where to steer for the next 0.4 s. Where it is and where it is to stand, it reads off the goals.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.driving.vehicle import ACCELERATION, SPEED, STEERING, YAW, VehicleParameters
from sim_sensors.compilation import compiled

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]

VIEW = "drive-1"
"""The layout of what is seen and decided: a model of another one would read nonsense."""
HOLD = 4
"""Steps of the environment for which a decision holds."""
BEAMS = 48
"""Directions in which room is measured, all around, the first one ahead."""
FARTHEST_M = 10.0
"""Room beyond this is not told apart."""
SPEEDS = (2.0, 1.5)
"""m/s, the greatest speed forward and backward that a decision can ask for: about the planner's."""
STAND = 0.2
"""A decision whose first number is smaller than this, either way, asks the car to stand."""
N_SEEN = 8 + BEAMS
"""Numbers of the observation; see `seen`."""

_CONTROL_S = 0.1
_NOWHERE = 999.0  # m; unused rows of the obstacle map lie beyond
_CIRCLE = 2.0 * math.pi / BEAMS


class Outlines(NamedTuple):
    """What is in the way, in the slot's frame, as compiled code walks it.

    Attributes:
        edges: (n_edges, 4) float64, m: x, y of either end; those of one thing stand together.
        first: (n + 1,) int64: where the edges of each thing begin.
        circle: (n, 3) float64, m: x, y and radius of a circle round each thing.
    """

    edges: FloatArray
    first: IntArray
    circle: FloatArray

    @classmethod
    def of_map(cls, cars: Float32Array, lines: Float32Array) -> Outlines:
        """From `cars` and `lines` of an observation with the obstacle map, (n, 24, 2) and (m, 2, 2) m."""
        cars = cars[cars[:, 0, 0] < _NOWHERE].astype(np.float64)
        lines = lines[lines[:, 0, 0] < _NOWHERE].astype(np.float64)
        around = np.concatenate([cars, np.roll(cars, -1, axis=1)], axis=2)
        # An outline of fewer corners repeats its last.
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
class DriverView:
    """The eyes and the feet of a driver of one car.

    Args:
        vehicle: the car.
    """

    vehicle: VehicleParameters

    @cached_property
    def half(self) -> FloatArray:
        """(2,) half the car's length and width, m."""
        return 0.5 * np.array([self.vehicle.length, self.vehicle.width])

    @cached_property
    def body(self) -> FloatArray:
        """(BEAMS,) from the car's middle to its outline in the direction of each beam, m."""
        angle = _CIRCLE * np.arange(BEAMS)
        directions = np.abs(np.stack([np.cos(angle), np.sin(angle)]))
        reach: FloatArray = (self.half[:, None] / np.maximum(directions, 1e-9)).min(axis=0)
        return reach

    @cached_property
    def pedals(self) -> FloatArray:
        """(4,) what `command` takes: the greatest braking and acceleration, m/s², and `SPEEDS`."""
        return np.array([self.vehicle.max_braking, self.vehicle.max_acceleration, *SPEEDS])


@compiled(error_model="numpy")
def command(action: Float32Array, speed: float, pedals: FloatArray) -> float:
    """The pedal, -1 to 1, that brings the car to the speed that a decision asks for.

    Args:
        action: (2,) speed, as a share of the greatest, and steering, both -1 to 1.
        speed: the car's, m/s.
        pedals: of a `DriverView`.
    """
    asked = min(max(float(action[0]), -1.0), 1.0)
    size = (abs(asked) - STAND) / (1.0 - STAND)
    wanted = 0.0 if size <= 0.0 else size * pedals[2] if asked > 0.0 else -size * pedals[3]
    needed = (wanted - speed) / _CONTROL_S
    return float(min(max(needed / (pedals[0] if needed * speed < 0.0 else pedals[1]), -1.0), 1.0))


@compiled(error_model="numpy")
def see(
    middle: FloatArray,
    state: FloatArray,
    outlines: tuple[FloatArray, IntArray, FloatArray],
    body: FloatArray,
    about: FloatArray,
    seen: Float32Array,
) -> None:
    """Fill in what is seen of the car and around it.

    Args:
        middle: (2,) x, y of the footprint's middle, m, slot frame.
        state: (6,) of the vehicle, with the yaw in the slot frame.
        outlines: see `Outlines`.
        body: of a `DriverView`.
        about: (5,) half of what the slot is longer and wider than the car, m, and a 1 for its kind.
        seen: (`N_SEEN`,) filled: speed, steering angle and acceleration, all scaled to about one; `about`; and the
            room at each beam, 1 / (1 + m) from the car's outline on, so that 1 is a contact.
    """
    seen[0], seen[1], seen[2] = state[SPEED] / 2.0, state[STEERING] / 0.6, state[ACCELERATION] / 3.0
    for k in range(5):
        seen[3 + k] = about[k]
    edges, first, circle = outlines
    # Nearness, 1 / m, is what edges are compared by: it needs no special case for beams that run beside an edge.
    near = np.full(BEAMS, 1.0 / (FARTHEST_M + 3.0))
    ahead, aside = np.empty(BEAMS), np.empty(BEAMS)
    for b in range(BEAMS):
        ahead[b], aside[b] = math.cos(state[YAW] + _CIRCLE * b), math.sin(state[YAW] + _CIRCLE * b)
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
                # The ray meets the edge where its ends lie on either side of it.
                left, right = ahead[b] * qy - aside[b] * qx, aside[b] * px - ahead[b] * py
                if left * twice >= 0.0 and right * twice >= 0.0:
                    near[b] = max(near[b], (left + right) / twice)
    for b in range(BEAMS):
        seen[8 + b] = 1.0 / (1.0 + min(max(1.0 / near[b] - body[b], 0.0), FARTHEST_M))
