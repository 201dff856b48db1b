"""Levels of scenes, drawn from a seed: a slot as long or wide as the car and a margin, an aisle, and clutter beyond it.

After Jiang, Li, Zhang, Shen, Yin and Wang, "HOPE: a reinforcement learning-based hybrid policy path planner for diverse
parking scenarios" (2024): its margins, widths of aisles and amounts of clutter. Ours are oblique slots, extreme ones
across the aisle, and the level `moving`: normal, with pedestrians and cars that come through the aisle.
"""

import math
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.affinity import rotate, translate
from shapely.geometry.base import BaseGeometry

from parkenv.driving.road_users import CAR, Crossing
from parkenv.driving.scene import Contour, Scene
from parkenv.driving.vehicle import VehicleParameters
from parkenv.errors import InputError, nearest
from parkenv.files.known_names import SCENE_LEVELS


@dataclass(frozen=True)
class Level:
    """How tight a level is: least and greatest margins of slots, widths of the aisle, m, and amount of clutter."""

    along: tuple[float, float]  # of the slot's length over the car's, parallel slots
    across: tuple[float, float]  # of the slot's width over the car's, the other slots
    aisle: tuple[float, float]  # width before parallel slots, and before the others
    clutter: int  # number of obstacles beyond the aisle, where there is no wall
    crossings: int = 0  # number of pedestrians and cars in the aisle


def levels(vehicle: VehicleParameters) -> dict[str, Level]:
    quarter = 0.25 * vehicle.length
    return {
        "normal": Level((quarter, quarter + 0.5), (0.85, 1.2), (4.5, 7.0), 3),
        "complex": Level((min(0.9, quarter), quarter), (0.4, 0.85), (4.0, 6.0), 5),
        "extreme": Level((0.6, 0.9), (0.3, 0.4), (3.5, 6.0), 8),
        "moving": Level((quarter, quarter + 0.5), (0.85, 1.2), (4.5, 7.0), 3, crossings=3),
    }


_HALF_M = 16.0  # half the length of the row of slots, m
_FAR_M = 14.0  # from the slot to where road users start and end, m
_NEIGHBOURS, _TAKEN = 3, 0.7  # further places on either side, and the chance that a car stands there
_TRIES = 1_000


def level_scene(level: str, seed: int, vehicle: VehicleParameters | None = None) -> Scene:
    """Draw a scene of a level, one of `SCENE_LEVELS`; equal seeds give equal scenes."""
    if level not in SCENE_LEVELS:
        raise InputError(f"level is {level!r:.60}; {nearest(level, SCENE_LEVELS)}")
    vehicle = vehicle or VehicleParameters()
    rng = np.random.default_rng([int(seed), SCENE_LEVELS.index(level)])
    kind, _, how = level.partition("-")
    for _ in range(_TRIES):
        scene = _drawn(f"{level}-{seed}", vehicle, kind, levels(vehicle)[how], rng)
        if scene is not None:
            return scene
    raise InputError(f"level {level} with seed {seed}: the car finds no place, want a smaller one")


def _drawn(
    name: str, vehicle: VehicleParameters, kind: str, level: Level, rng: np.random.Generator
) -> Scene | None:
    """Draw a scene; None if its parts overlap. The aisle is along x, the slots are below y = 0."""
    parallel = kind == "parallel"
    oblique = rng.choice([math.pi / 4, math.pi / 3])
    angle = {"perpendicular": math.pi / 2, "oblique": oblique, "parallel": 0.0}[kind]
    margin = rng.uniform(*(level.along if parallel else level.across))
    aisle = level.aisle[0 if parallel else 1]
    half = 0.5 * np.array([vehicle.length, vehicle.width])
    car = rotate(shapely.box(*-half, *half), angle, (0, 0), use_radians=True)
    depth = car.bounds[3] - car.bounds[1]

    def parked(x: float) -> BaseGeometry:
        askew = rotate(car, rng.normal(0.0, math.pi / 72), (0, 0), use_radians=True)
        return translate(askew, x, -0.5 * depth - 0.2 + np.clip(rng.normal(0.0, 0.1), -0.2, 0.2))

    askew = float(np.clip(rng.normal(0.0, math.pi / 72), -math.pi / 24, math.pi / 24))
    center = np.array([0.0, -0.5 * depth - 0.2])
    own = translate(rotate(car, askew, (0, 0), use_radians=True), *center)
    share = rng.uniform(0.2, 0.8)
    solids: list[BaseGeometry] = []
    for side, gap in ((-1.0, share * margin), (1.0, (1.0 - share) * margin)):
        length = vehicle.length if parallel else vehicle.width / math.sin(angle)
        x = side * length
        if rng.random() < 0.5 and kind != "oblique":
            edges = sorted((side * (0.5 * length + 1.0), side * _HALF_M))
            block = shapely.box(edges[0], -depth - 0.4, edges[1], 0.0)
            solids.append(_moved_to(block, own, gap, side))
            continue
        solids.append(_moved_to(parked(1.5 * x), own, gap, side))
        at = 0.5 * (solids[-1].bounds[0] + solids[-1].bounds[2])
        for _ in range(_NEIGHBOURS):
            at += x + side * rng.uniform(0.3, 0.3 + margin)
            if rng.random() < _TAKEN and abs(at) < _HALF_M:
                solids.append(parked(at))
    wall = min(shape.bounds[1] for shape in (own, *solids)) - rng.uniform(0.1, 0.4)
    contours = [Contour(np.array([[-_HALF_M, wall], [_HALF_M, wall]]), closed=False)]
    # As HOPE measures it: from what protrudes the most.
    aisle += max(0.0, *(shape.bounds[3] for shape in solids))
    if rng.random() < 0.2:
        contours.append(Contour(np.array([[-_HALF_M, aisle], [_HALF_M, aisle]]), closed=False))
    else:
        for _ in range(level.clutter):
            box = rotate(car, rng.uniform(0.0, 2.0 * math.pi), (0, 0), use_radians=True)
            high = rng.uniform(2.0, 6.0)
            box = translate(box, rng.uniform(2.0 - _HALF_M, _HALF_M - 2.0), aisle + high)
            if box.bounds[1] > aisle and not any(box.intersects(shape) for shape in solids):
                solids.append(box)
    contours += [Contour(shapely.get_coordinates(shape)[:-1]) for shape in solids]
    crossings = [_crossing(aisle, rng) for _ in range(level.crossings)]
    x, y = rng.uniform(-7.5, 7.5), rng.uniform(1.0, aisle - 1.0)
    yaw = float(np.clip(rng.normal(0.0, math.pi / 6), -math.pi / 2, math.pi / 2))
    turned = 0.0
    if rng.random() < 0.5:
        yaw += math.pi
        # In a parallel slot the car faces as it came.
        turned = math.pi if parallel else 0.0
    if not parallel and rng.random() < 0.5:
        turned = math.pi
    target = vehicle.at_rear_axle(np.array([*center, angle + askew + turned]))
    start = vehicle.at_rear_axle(np.array([x, y, yaw]))
    if shapely.Polygon(vehicle.corners(start)).intersects(own):
        return None
    try:
        return Scene(name, vehicle, start, target, tuple(contours), crossings=tuple(crossings))
    except InputError:
        return None


def _crossing(aisle: float, rng: np.random.Generator) -> Crossing:
    side = rng.choice([-1.0, 1.0])
    if rng.random() < 0.5:
        low, high = sorted((0.5 * CAR.width + 0.3, aisle - 0.5 * CAR.width - 0.3))
        y = rng.uniform(max(low, 0.5 * aisle), max(high, 0.5 * aisle))
        ends, speed, kind = np.array([y, y]), rng.uniform(1.5, 2.5), "car"
    else:
        ends, speed, kind = rng.uniform(0.5, aisle - 0.5, 2), rng.uniform(0.9, 1.6), "pedestrian"
    start, end = ((float(x), float(y)) for x, y in zip((side * _FAR_M, -side * _FAR_M), ends, strict=True))
    return Crossing(kind, (start, end), float(speed), float(rng.uniform(0.0, 6.0)))


def _moved_to(shape: BaseGeometry, own: BaseGeometry, gap: float, side: float) -> BaseGeometry:
    """Move a shape beside the car along x until their distance is `gap`."""
    for _ in range(30):
        shape = translate(shape, side * (gap - shape.distance(own)), 0.0)
    return shape
