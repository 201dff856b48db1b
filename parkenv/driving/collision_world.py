"""Collision detection with pymunk: parked cars, kerbs, walls, and moving road users."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Self

import numpy as np
import pymunk
from numpy.typing import ArrayLike

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.driving.vehicle import PHYSICS_S, VehicleParameters


class ObstacleKind(IntEnum):
    """Kind of an obstacle; `NOTHING` if the car touches none."""

    NOTHING = 0
    PARKED_CAR = 1
    KERB = 2
    WALL = 3
    MOVING_CAR = 4
    PEDESTRIAN = 5

    @property
    def label(self) -> str:
        """Name for messages."""
        return self.name.lower().replace("_", " ")


_EGO = 100
_OTHERS = 1  # group of all other shapes, which are not checked against each other


def padded(outlines: Sequence[FloatArray]) -> FloatArray:
    """Outlines as one array, (n, k, 2) m; shorter ones repeat their last corner."""
    corners = np.empty((len(outlines), max(map(len, outlines), default=2), 2))
    for row, outline in zip(corners, outlines, strict=True):
        row[: len(outline)] = outline
        row[len(outline) :] = outline[-1]
    return corners


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Static obstacles around a car; world frame."""

    # (n, k_max, 2) float64, m: convex outlines; a line has two corners. Outlines with fewer corners are padded with
    # their last corner.
    corners: FloatArray
    n_corners: IntArray  # (n,) int64, 2 to k_max
    kind: IntArray  # (n,) int64, an `ObstacleKind` each

    def __len__(self) -> int:
        return len(self.kind)

    @classmethod
    def of(cls, outlines: Sequence[tuple[ObstacleKind, FloatArray]]) -> Self:
        """Create obstacles from pairs of kind and outline, (k, 2) m."""
        corners = padded([outline for _, outline in outlines])
        count = np.array([len(outline) for _, outline in outlines], dtype=np.int64)
        return cls(corners, count, np.array([kind for kind, _ in outlines], dtype=np.int64))

    def only(self, *kinds: ObstacleKind) -> Self:
        chosen = np.isin(self.kind, kinds)
        return type(self)(self.corners[chosen], self.n_corners[chosen], self.kind[chosen])

    def outlines(self) -> list[FloatArray]:
        """The outline of each obstacle without padding, (k, 2) m."""
        return [c[:k] for c, k in zip(self.corners, self.n_corners, strict=True)]


class CollisionWorld:
    """A pymunk space with a car, static obstacles and moving ones, for collision queries.

    Poses are set, not simulated: the car follows its own kinematics (`parkenv.driving.vehicle`). The car is longer
    than twice the distance of any step, so it cannot pass an obstacle between two steps. Outlines of `movers` are
    (k, 2) m in their own frames.
    """

    def __init__(
        self,
        vehicle: VehicleParameters,
        obstacles: Obstacles,
        movers: Sequence[tuple[ObstacleKind, FloatArray]] = (),
    ) -> None:
        self.space = pymunk.Space()
        ground = self.space.static_body
        for kind, outline in zip(obstacles.kind.tolist(), obstacles.outlines(), strict=True):
            self._add(ground, kind, outline)
        self.car = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self.space.add(self.car)
        self._add(self.car, _EGO, vehicle.corners(np.zeros(3)))
        self.movers: list[pymunk.Body] = []
        for kind, outline in movers:
            body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
            self.space.add(body)
            self._add(body, int(kind), outline)
            self.movers.append(body)
        self._touched = int(ObstacleKind.NOTHING)
        for kind in ObstacleKind:
            if kind is not ObstacleKind.NOTHING:
                self.space.on_collision(_EGO, int(kind), pre_solve=self._touch, data=int(kind))

    def touched(self, x: float, y: float, yaw: float) -> int:
        """Place the car at a pose of its rear axle, m and rad; return the `ObstacleKind` that it touches."""
        self.car.position = x, y
        self.car.angle = yaw
        self._touched = 0
        self.space.step(PHYSICS_S)
        return self._touched

    def move(self, poses: ArrayLike) -> None:
        """Place the moving obstacles: (n_movers, 3) x, y in m and yaw in rad."""
        for body, (x, y, yaw) in zip(self.movers, np.asarray(poses, dtype=np.float64).tolist(), strict=True):
            body.position = x, y
            body.angle = yaw

    def _add(self, body: pymunk.Body, kind: int, outline: FloatArray) -> None:
        points = [(x, y) for x, y in outline.tolist()]
        shape: pymunk.Shape = (
            pymunk.Segment(body, points[0], points[1], 0.0) if len(points) == 2 else pymunk.Poly(body, points)
        )
        shape.collision_type = kind
        if kind != _EGO:
            shape.filter = pymunk.ShapeFilter(group=_OTHERS)
        self.space.add(shape)

    def _touch(self, arbiter: pymunk.Arbiter, space: pymunk.Space, kind: Any) -> None:
        del arbiter, space
        # With several contacts the lowest kind counts, whatever their order.
        self._touched = min(self._touched, kind) if self._touched else kind
