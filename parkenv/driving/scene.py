"""Scenes of manoeuvres: a vehicle, its start and target, and exact obstacles; and the check of driven footprints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.collision_world import ObstacleKind, Obstacles
from parkenv.driving.road_users import Crossing
from parkenv.driving.vehicle import VehicleParameters, finite_pose
from parkenv.errors import InputError

MAX_DISTANCE_M = 500.0  # greatest distance from start to target, m
MAX_POINTS = 20_000  # greatest number of points of all obstacles of a scene
CHECK_M = 0.02  # greatest distance that any point of the car moves between two checked footprints, m
# How exactly a manoeuvre has to end: ParkBench's tolerances.
POSITION_TOLERANCE_M, ANGLE_TOLERANCE_RAD = 0.05, 0.01
_TOUCHING = 1e-9  # m², overlap of a footprint and a polygon from which on they are in contact


class Contour(NamedTuple):
    """An obstacle: a simple polygon, or a line."""

    points: FloatArray  # (n, 2) m; a polygon is not closed
    closed: bool = True


@dataclass(frozen=True, eq=False)
class Scene:
    """A parking manoeuvre: where a car starts, where it has to stand, and what it must not touch.

    Coordinates are relative to `origin`, so that scenes far from zero lose no digits.
    """

    name: str
    vehicle: VehicleParameters
    start: FloatArray  # (3,) x, y in m and yaw in rad of the middle of the rear axle
    target: FloatArray  # (3,) likewise
    contours: tuple[Contour, ...]  # the obstacles; polygons need not be convex
    # least x and y and greatest x and y, m, that the footprint may reach; None for no limits
    bounds: tuple[float, float, float, float] | None = None
    origin: FloatArray = field(
        default_factory=lambda: np.zeros(2)
    )  # m, of the coordinates in those of the file
    crossings: tuple[Crossing, ...] = ()  # road users that cross it

    def __post_init__(self) -> None:
        for name in ("start", "target"):
            object.__setattr__(self, name, finite_pose(name, getattr(self, name)))
        count = sum(len(contour.points) for contour in self.contours)
        if count > MAX_POINTS:
            raise InputError(f"obstacles have {count:,} points, want at most {MAX_POINTS:,}")
        for i, (points, closed) in enumerate(self.contours):
            if (
                points.shape[1:] != (2,)
                or len(points) < (3 if closed else 1)
                or not np.isfinite(points).all()
            ):
                raise InputError(
                    f"obstacle {i} has the shape {points.shape}, want finite x and y of 3 corners or more"
                )
        for i, shape in enumerate(self.shapes):
            if not shape.is_valid:
                reason = shapely.is_valid_reason(
                    shapely.transform(shape, lambda points: points + self.origin)
                )
                raise InputError(f"obstacle {i} is no simple polygon: {reason}")
        for name in ("start", "target"):
            self._require_free(name, getattr(self, name))
        if (apart := math.dist(self.start[:2], self.target[:2])) > MAX_DISTANCE_M:
            raise InputError(
                f"target is {apart:,.0f} m from start, want a manoeuvre of {MAX_DISTANCE_M:g} m at most"
            )

    def _require_free(self, name: str, pose: FloatArray) -> None:
        """Check a pose; messages have the coordinates of the file."""
        where = f"{name} is {[*(pose[:2] + self.origin).tolist(), float(pose[2])]}"
        if abs(pose[2]) > 2.0 * math.pi + 0.02:
            raise InputError(
                f"{where}: its yaw is beyond ±2π, want radians; {pose[2]:g}° are {math.radians(pose[2]):.4f} rad"
            )
        if self.bounds is not None and not shapely.box(*self.bounds).covers(
            shapely.Polygon(self.vehicle.corners(pose))
        ):
            raise InputError(f"{where}: the car reaches beyond the bounds there")
        if self.check(pose[None]).contact:
            raise InputError(f"{where}: the car touches an obstacle there")

    @cached_property
    def shapes(self) -> list[BaseGeometry]:
        """The obstacles as polygons, lines and points."""
        shapes: list[BaseGeometry] = []
        for points, closed in self.contours:
            alone = len(points) == 1 or (not closed and (points == points[0]).all())
            kind = shapely.Polygon if closed else shapely.LineString
            shapes.append(shapely.Point(points[0]) if alone else kind(points))
        if self.bounds is not None:
            shapes.append(shapely.box(*self.bounds).exterior)
        return shapes

    @cached_property
    def obstacles(self) -> Obstacles:
        """The same as convex outlines: the edges of what is not convex."""
        outlines: list[FloatArray] = []
        for shape in self.shapes:
            points = shapely.get_coordinates(shape)
            if shape.geom_type == "Polygon" and shape.convex_hull.area - shape.area < 1e-9 * shape.area:
                outlines.append(points[:-1])
            elif len(points) == 1:
                outlines.append(np.repeat(points, 2, axis=0))
            else:
                outlines += [np.array(edge) for edge in pairwise(points)]
        return Obstacles.of([(ObstacleKind.WALL, outline) for outline in outlines])

    def check(self, poses: FloatArray) -> FootprintCheck:
        """Check the footprints at poses of the rear axle, (n, 3), and between them, against the exact obstacles."""
        poses = _between(np.asarray(poses, dtype=np.float64), self.vehicle)
        cars = np.asarray(shapely.polygons(self.vehicle.corners(poses)))
        shapes = np.array(self.shapes, dtype=object)
        if not len(shapes):
            return FootprintCheck(False, math.inf)
        tree = shapely.STRtree(shapes)
        car, near = tree.query(cars, predicate="intersects")
        solid = shapely.get_dimensions(shapes[near]) == 2
        # A common edge is no contact, an overlap is; lines and points touch as soon as they are reached.
        overlap = shapely.area(shapely.intersection(cars[car[solid]], shapes[near[solid]])) > _TOUCHING
        if not solid.all() or overlap.any():
            return FootprintCheck(True, 0.0)
        away = tree.query_nearest(cars, return_distance=True)[1]
        return FootprintCheck(False, float(away.min()) if away.size else math.inf)

    def error(self, pose: FloatArray) -> tuple[float, float]:
        """Return distance, m, and angle, rad, of a pose of the rear axle from the target."""
        off = self.target[:2] - pose[:2]
        return math.hypot(*off), abs(math.remainder(float(self.target[2] - pose[2]), 2.0 * math.pi))


class FootprintCheck(NamedTuple):
    """Whether footprints touch an obstacle, and the smallest distance, m; infinite without obstacles."""

    contact: bool
    clearance: float


def _between(poses: FloatArray, vehicle: VehicleParameters) -> FloatArray:
    """Add poses in between, so that no corner moves farther than `CHECK_M` from one to the next."""
    if len(poses) < 2:
        return poses
    step = np.diff(poses, axis=0)
    step[:, 2] -= 2.0 * np.pi * np.round(step[:, 2] / (2.0 * np.pi))
    reach = math.hypot(
        max(vehicle.length - vehicle.rear_overhang, vehicle.rear_overhang), 0.5 * vehicle.width
    )
    parts = np.ceil((np.hypot(step[:, 0], step[:, 1]) + reach * np.abs(step[:, 2])) / CHECK_M)
    parts = np.maximum(parts, 1).astype(np.int64)
    first = np.repeat(np.arange(len(step)), parts)
    share = (np.arange(len(first)) - np.repeat(np.cumsum(parts) - parts, parts)) / parts[first]
    # Along an arc, whose chord turns by half its angle against either end.
    half = 0.5 * step[first, 2]
    x, y = step[first, 0], step[first, 1]
    along = share * np.where(np.abs(half) < 1e-6, 1.0, np.sinc(share * half / np.pi) / np.sinc(half / np.pi))
    turn = half * (share - 1.0)
    moved = np.stack([x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)], axis=1)
    between = poses[first].copy()
    between[:, :2] += along[:, None] * moved
    between[:, 2] += share * step[first, 2]
    return np.concatenate([between, poses[-1:]])


def outlines_without(
    lines: Sequence[FloatArray], pose: FloatArray, vehicle: VehicleParameters, step: float
) -> list[Contour]:
    """Leave out what of obstacle lines lies in the footprint at a pose, as ParkBench does with points every `step` m.

    Pieces beside points in the footprint go, too; what is left of a line stays in one piece, single points stay points.
    """
    car = shapely.Polygon(vehicle.corners(pose))
    shapely.prepare(car)
    outside: list[Contour] = []
    for line in lines:
        if car.distance(shapely.LineString(line) if len(line) > 1 else shapely.Point(line[0])) > step:
            outside.append(Contour(line, closed=False))
            continue
        parts = [line[:1]]
        for start, end in pairwise(line):
            n = int(math.hypot(*(end - start)) // step) + 1
            parts.append(start + (end - start) * (np.arange(1, n + 1) / n)[:, None])
        points = np.concatenate(parts)
        inside = shapely.intersects_xy(car, points)
        whole = ~(inside[1:] | inside[:-1])
        edges = np.asarray(shapely.linestrings(np.stack([points[:-1], points[1:]], axis=1)))
        whole &= ~shapely.intersects(car, edges)
        parts = np.split(np.arange(len(points)), np.flatnonzero(~whole) + 1)
        outside += [Contour(points[part], closed=False) for part in parts if not inside[part].any()]
    return outside
