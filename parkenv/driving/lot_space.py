"""What a car may run into, as bodies and shapes of pymunk: parked cars, kerbs, walls, and who moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Self

import numpy as np
import pymunk
from numpy.typing import ArrayLike, NDArray

from parkenv.driving.vehicle import PHYSICS_S, VehicleParameters
from parkenv.errors import InputError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


class Thing(IntEnum):
    """What something that stands in the way is."""

    NOTHING = 0
    PARKED_CAR = 1
    KERB = 2
    WALL = 3
    MOVING_CAR = 4
    PEDESTRIAN = 5

    @property
    def words(self) -> str:
        """Its name in a message."""
        return self.name.lower().replace("_", " ")


_EGO = 100


@dataclass(frozen=True, eq=False)
class Obstacles:
    """What stands still around a car; world frame.

    Args:
        corners: (n, k_max, 2) float64, m: convex outlines; a line has two corners. What an outline of fewer corners
            leaves over repeats its last.
        n_corners: (n,) int64, 2 to k_max.
        thing: (n,) int64, a `Thing` each.

    Raises:
        InputError: shapes that do not fit together, or a value that is not finite.
    """

    corners: FloatArray
    n_corners: IntArray
    thing: IntArray

    def __post_init__(self) -> None:
        corners = np.array(self.corners, dtype=np.float64)
        count, thing = (np.array(a, dtype=np.int64) for a in (self.n_corners, self.thing))
        if corners.ndim != 3 or corners.shape[2] != 2 or not count.shape == thing.shape == corners.shape[:1]:
            raise InputError(
                f"obstacles: corners {corners.shape}, n_corners {count.shape}, thing {thing.shape}, want (n, k, 2), "
                "(n,) and (n,)"
            )
        if not np.isfinite(corners).all():
            raise InputError("obstacles: a corner is not finite, want numbers")
        if len(count) and (count.min() < 2 or count.max() > corners.shape[1]):
            raise InputError(
                f"obstacles: n_corners {count.min()} to {count.max()}, want 2 to {corners.shape[1]}"
            )
        for name, values in (("corners", corners), ("n_corners", count), ("thing", thing)):
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(self.thing)

    @classmethod
    def of(cls, outlines: Sequence[tuple[Thing, FloatArray]]) -> Self:
        """From pairs of what a thing is and its outline, (k, 2) m."""
        k_max = max((len(outline) for _, outline in outlines), default=2)
        corners = np.empty((len(outlines), k_max, 2))
        for row, (_, outline) in zip(corners, outlines, strict=True):
            row[: len(outline)] = outline
            row[len(outline) :] = outline[-1]
        count = np.array([len(outline) for _, outline in outlines], dtype=np.int64)
        return cls(corners, count, np.array([int(thing) for thing, _ in outlines], dtype=np.int64))

    def only(self, *things: Thing) -> Self:
        """Those of these kinds."""
        chosen = np.isin(self.thing, things)
        return type(self)(self.corners[chosen], self.n_corners[chosen], self.thing[chosen])

    def outlines(self) -> list[FloatArray]:
        """The outline of each, (k, 2) m."""
        return [c[:k] for c, k in zip(self.corners, self.n_corners, strict=True)]


class LotSpace:
    """A pymunk space with everything that a car may run into, and the car in it.

    The car's pose is told, not simulated: it follows its own kinematics, see `parkenv.driving.vehicle`. The space
    says what it touches. Its footprint is longer than twice the way of any step, so nothing that it drives over
    can fall between two steps.

    Args:
        vehicle: the car.
        obstacles: what stands still.
        movers: outlines, (k, 2) m in their own frames, of what moves, and what they are.
    """

    def __init__(
        self,
        vehicle: VehicleParameters,
        obstacles: Obstacles,
        movers: Sequence[tuple[Thing, FloatArray]] = (),
    ) -> None:
        self.space = pymunk.Space()
        ground = self.space.static_body
        for thing, outline in zip(obstacles.thing.tolist(), obstacles.outlines(), strict=True):
            self._add(ground, thing, outline)
        self.car = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self.space.add(self.car)
        self._add(self.car, _EGO, vehicle.corners(np.zeros(3)))
        self.movers: list[pymunk.Body] = []
        for kind, outline in movers:
            body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
            self.space.add(body)
            self._add(body, int(kind), outline)
            self.movers.append(body)
        self._touched = int(Thing.NOTHING)
        for kind in Thing:
            if kind is not Thing.NOTHING:
                self.space.on_collision(_EGO, int(kind), pre_solve=self._touch, data=int(kind))

    def touched(self, x: float, y: float, yaw: float) -> int:
        """Put the car somewhere and let a step of the physics pass; what it touches, a `Thing`.

        Args:
            x: m, of the rear axle's middle.
            y: m, of the same.
            yaw: rad.
        """
        car = self.car
        car.position = x, y
        car.angle = yaw
        self._touched = 0
        self.space.step(PHYSICS_S)
        return self._touched

    def move(self, poses: ArrayLike) -> None:
        """Put what moves somewhere: (n_movers, 3) x, y in m and yaw in rad."""
        for body, (x, y, yaw) in zip(self.movers, np.asarray(poses, dtype=np.float64).tolist(), strict=True):
            body.position = x, y
            body.angle = yaw

    def _add(self, body: pymunk.Body, kind: int, outline: FloatArray) -> None:
        points = [(x, y) for x, y in outline.tolist()]
        shape: pymunk.Shape = (
            pymunk.Segment(body, points[0], points[1], 0.0) if len(points) == 2 else pymunk.Poly(body, points)
        )
        shape.collision_type = kind
        self.space.add(shape)

    def _touch(self, arbiter: pymunk.Arbiter, space: pymunk.Space, kind: Any) -> None:
        del arbiter, space
        # Of several things the least number counts, whatever order they come in.
        self._touched = min(self._touched, kind) if self._touched else kind
