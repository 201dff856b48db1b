"""Paths of arcs for a car that drives forward and backward."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.vehicle import VehicleParameters, move_along

SHORTEST_ARC = 1e-6  # arcs shorter than this, m, are ignored
_STRAIGHT = 1e-5  # rad


@dataclass(frozen=True, eq=False)
class CarPath:
    start: FloatArray  # (3,) x, y in m and yaw in rad of the rear axle
    length: FloatArray  # (k,) length of each arc, m, negative backward
    curvature: FloatArray  # (k,) 1/m, positive to the left
    expansions: int = 0  # nodes that the search expanded
    margin: float = 0.0  # clearance to obstacles, m
    vehicle: VehicleParameters | None = None  # the car that it was planned for

    @property
    def driven_m(self) -> float:
        return float(np.abs(self.length).sum())

    @property
    def direction_changes(self) -> int:
        return count_changes(self.length[np.abs(self.length) > SHORTEST_ARC])

    def reversed(self, start: FloatArray) -> Self:
        """Return the path driven the other way, from its end, `start`, (3,)."""
        return dataclasses.replace(
            self, start=start, length=-self.length[::-1], curvature=self.curvature[::-1]
        )

    def sampled(self, step: float = 0.05) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Sample the path: poses, (n, 3), and curvature, (n,) 1/m, and direction, (n,) ±1, of the arc ending there."""
        poses, curvature, direction = [tuple(self.start.tolist())], [float(self.curvature[0])], [0.0]
        direction[0] = math.copysign(1.0, self.length[0])
        for length, bend in zip(self.length.tolist(), self.curvature.tolist(), strict=True):
            n = max(1, math.ceil(abs(length) / step))
            for _ in range(n):
                poses.append(move_along(*poses[-1], bend, length / n))
            curvature += [bend] * n
            direction += [math.copysign(1.0, length)] * n
        return np.array(poses), np.array(curvature), np.array(direction)


def count_changes(values: FloatArray) -> int:
    return int(np.count_nonzero(np.diff(np.sign(values))))


def rounded(points: FloatArray, radius: float) -> CarPath:
    """Make a path along a polyline with rounded corners; points are (k, 2) m, in the order driven.

    Arcs are smaller where legs are short: they use at most half of each adjacent leg.
    """
    step = np.diff(points, axis=0)
    leg = np.hypot(step[:, 0], step[:, 1])
    step, leg = step[leg > 1e-9], leg[leg > 1e-9]
    yaw = np.arctan2(step[:, 1], step[:, 0])
    lengths, curvatures = [], []
    taken = 0.0
    for i in range(len(leg)):
        turn = math.remainder(float(yaw[i + 1] - yaw[i]), 2.0 * math.pi) if i + 1 < len(leg) else 0.0
        cut = 0.0
        if abs(turn) > _STRAIGHT:
            cut = min(radius * math.tan(0.5 * abs(turn)), 0.5 * leg[i], 0.5 * leg[i + 1])
        lengths.append(float(leg[i]) - taken - cut)
        curvatures.append(0.0)
        if cut > 0.0:
            arc = cut / math.tan(0.5 * abs(turn))
            lengths.append(arc * abs(turn))
            curvatures.append(math.copysign(1.0 / arc, turn))
        taken = cut
    start = np.array([*points[0], yaw[0]])
    return CarPath(start, np.array(lengths), np.array(curvatures))


def joined(first: CarPath, second: CarPath) -> CarPath:
    return CarPath(
        first.start,
        np.r_[first.length, second.length],
        np.r_[first.curvature, second.curvature],
        first.expansions + second.expansions,
        min(first.margin, second.margin),
    )
