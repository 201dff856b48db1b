"""Pictures of random streets and car parks: rows of cars with foreground and background objects, in random light."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from sim_sensors.camera.models import Frame, PinholeCamera, camera_pose
from sim_sensors.camera.weather import PRESETS, Weather
from sim_sensors.ground_truth import VehicleBoxes, vehicle_boxes
from sim_sensors.scene import Fleet, Scene
from sim_sensors.surroundings import Surroundings
from sim_sensors.vehicles.vehicle import VehicleModel

BODY_SHARE = {"hatchback": 0.26, "sedan": 0.34, "estate": 0.14, "suv": 0.14, "van": 0.09, "pickup": 0.03}
"""Frequency of each body type; flatter than in a European lot, as photographs come from all regions and decades."""

FRAMES = 20
"""Number of pictures of a street."""

_WEATHERS = 4  # of a street
_KINDS = ("along", "across", "aslant")
_REACH = 24.0  # m, half the length of a row
_DEPTH = {"along": 2.3, "across": 5.4, "aslant": 5.4}  # m, of a row
_SEEDS = 1 << 20


@dataclass(frozen=True, eq=False)
class Street:
    """Cars in rows along the x axis; cameras are on the negative y side."""

    kind: str  # `along`: the sides of the first row are visible; `across` or `aslant`: its ends
    pose: FloatArray  # (n, 3) float64: x, y in m, yaw in rad; cars of the first row come first
    first: int  # number of cars in the first row
    front: float  # m, y of the first row's mouth
    fleet: Fleet  # vehicle model of every car, in order, and the surroundings

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Street:
        """Draw one or two rows of cars with walls, houses, trees, posts and pedestrians around them."""
        kind = str(rng.choice(_KINDS, p=[0.52, 0.40, 0.08]))
        poses, models = _row(rng, kind, 0.0, _REACH)
        first, back = len(poses), 0.5 * _DEPTH[kind]
        if rng.random() < 0.5:
            other = str(rng.choice(_KINDS))
            y = back + 0.5 * _DEPTH[other] + rng.uniform(0.5, 7.0)
            more_poses, more_models = _row(rng, other, y, 1.25 * _REACH)
            poses, models, back = [*poses, *more_poses], [*models, *more_models], y + 0.5 * _DEPTH[other]
        front = -0.5 * _DEPTH[kind]
        around = _surroundings(rng, front, back, _DEPTH[kind])
        return cls(kind, np.array(poses), first, front, Fleet(tuple(models), around))

    def draw_scene(self, rng: np.random.Generator, least: float, *, empty: bool) -> tuple[Scene, int]:
        """Return the street with a random part of its cars, and a car of the first row that is there unless `empty`.

        Args:
            rng: random numbers.
            least: least probability of a car to be there; the most is 1.
            empty: whether no car is there.
        """
        n = len(self.pose)
        there = np.zeros(n, dtype=np.bool_) if empty else rng.random(n) < rng.uniform(least, 1.0)
        car = int(rng.integers(self.first))
        if not empty:
            there[car] = True
        chosen, turned = np.flatnonzero(there), rng.random(n) < 0.5
        pose = self.pose[chosen].copy()
        pose[:, 2] += math.pi * turned[chosen]
        return Scene(pose, chosen, self.fleet), car


class LongLens(NamedTuple):
    """How cars are photographed from across the street: limits and standard deviations."""

    size: tuple[int, int]  # px, width and height of the picture
    away: tuple[float, float]  # m, from the street
    height: tuple[float, float]  # m, of the camera
    side: tuple[float, float]  # px, length of the car if its side is seen
    end: tuple[float, float]  # px, its width if its end is seen
    aside: float  # as a fraction of the distance
    roll: float  # rad

    def aim(
        self, street: Street, car: int, rng: np.random.Generator
    ) -> tuple[PinholeCamera, NDArray[np.float64]]:
        """Return a camera that faces one car, and its pose; the car is not always in the middle of the picture."""
        width, height = self.size
        away, height_m = rng.uniform(*self.away), rng.uniform(*self.height)
        extent, (smallest, largest) = (4.6, self.side) if street.kind == "along" else (1.8, self.end)
        focal = math.exp(rng.uniform(math.log(smallest), math.log(largest))) * away / extent
        camera = PinholeCamera(width, height, focal, focal, width / 2.0, height / 2.0, coarse_beyond=math.inf)
        aside = rng.normal(0.0, self.aside) * away
        pan, tilt = rng.normal(0.0, 0.15, 2) * np.array([2.0 * width, height]) / (2.0 * focal)
        pose = camera_pose(
            float(street.pose[car, 0]) + aside, street.front - away, height_m,
            math.pi / 2 + math.atan2(aside, away) + pan, math.atan2(0.7 - height_m, away) + tilt,
            rng.normal(0.0, self.roll),
        )  # fmt: skip
        return camera, pose


class StreetPictures(NamedTuple):
    """How streets are photographed: `FRAMES` pictures of each in four weathers."""

    from_afar: LongLens
    share: float  # fraction of pictures from across the street; the others are taken in passing
    in_passing: Callable[[Street, np.random.Generator], tuple[PinholeCamera, FloatArray]]
    least: float  # least probability of a car to be there
    empty_every: int  # every how many-th picture has no cars

    def of_street(self, number: int, seed: int) -> Iterator[tuple[Frame, VehicleBoxes, np.random.Generator]]:
        """Draw a street; yield its pictures, their cars, and the random numbers, which may be used in between."""
        rng = np.random.default_rng([seed, number])
        street = Street.draw(rng)
        weathers = [
            Weather.draw(str(rng.choice(PRESETS)), int(rng.integers(_SEEDS))) for _ in range(_WEATHERS)
        ]
        for i in range(FRAMES):
            empty = i % self.empty_every == self.empty_every - 1
            scene, car = street.draw_scene(rng, self.least, empty=empty)
            far = rng.random() < self.share
            camera, pose = self.from_afar.aim(street, car, rng) if far else self.in_passing(street, rng)
            frame = camera.render(scene, pose, weathers[i % _WEATHERS], int(rng.integers(_SEEDS)))
            yield frame, vehicle_boxes(camera, scene, pose, frame), rng


def _row(
    rng: np.random.Generator, kind: str, y: float, reach: float
) -> tuple[list[list[float]], list[VehicleModel]]:
    """Return poses and models of cars in a row, from -reach to reach."""
    turn = {"along": 0.0, "across": 0.5 * math.pi, "aslant": rng.uniform(0.9, 1.3) * rng.choice([-1.0, 1.0])}[
        kind
    ]
    gap = rng.uniform(0.5, 2.5) if kind == "along" else rng.uniform(0.55, 1.3)
    bodies, shares = list(BODY_SHARE), list(BODY_SHARE.values())
    poses, models = [], []
    x = -reach
    while x < reach:
        model = VehicleModel.from_seed(str(rng.choice(bodies, p=shares)), int(rng.integers(_SEEDS)))
        # Oblique cars are spaced by the distance of their flanks, not by their bounding boxes.
        wide = (
            model.length if kind == "along" else model.width / abs(math.sin(turn)) + 0.3 * abs(math.cos(turn))
        )
        x += 0.5 * wide
        poses.append([x, y + rng.normal(0.0, 0.15), turn + rng.normal(0.0, 0.03)])
        models.append(model)
        x += 0.5 * wide + gap * rng.uniform(0.8, 1.5)
    return poses, models


def _surroundings(rng: np.random.Generator, front: float, back: float, depth: float) -> Surroundings:
    buildings, walls, kerbs, markings = [], [], [], []
    if rng.random() < 0.6:
        y = back + rng.uniform(0.8, 9.0)
        low, high = np.sort(rng.uniform(-40.0, 40.0, 2)) + np.array([-12.0, 12.0])
        buildings = [[[low, y], [high, y], [high, y + 15.0], [low, y + 15.0]]]
    if rng.random() < 0.5:
        walls = [[-45.0, back + 0.4, 45.0, back + rng.uniform(0.4, 0.9), rng.uniform(0.5, 2.6)]]
    trees = int(rng.integers(0, 22)) if rng.random() < 0.7 else 0
    posts, people = int(rng.integers(0, 4)), int(rng.integers(0, 6))
    if rng.random() < 0.5:
        kerbs = [[[-40.0, back + 0.2], [40.0, back + 0.2]]]
    if rng.random() < 0.7:
        lines = np.arange(-_REACH, _REACH, rng.uniform(2.5, 6.0))
        markings = [[x, front, x, front + depth, 0.1] for x in lines.tolist()]
    return Surroundings(
        paved=[[[-45.0, front - 40.0], [45.0, front - 40.0], [45.0, back + 1.5], [-45.0, back + 1.5]]],
        markings=markings,
        buildings=buildings,
        building_heights=rng.uniform(3.5, 14.0, len(buildings)),
        walls=walls,
        kerbs=kerbs,
        trees=np.column_stack(
            [
                rng.uniform(-35.0, 35.0, trees),
                rng.uniform(back + 1.0, back + 16.0, trees),
                rng.uniform(2.5, 10.0, trees),
            ]
        ),
        lamp_posts=np.column_stack(
            [
                rng.uniform(-20.0, 20.0, posts),
                front - rng.uniform(0.6, 1.5, posts),
                rng.uniform(-3.0, 3.0, posts),
            ]
        ),
        pedestrians=np.column_stack(
            [
                rng.uniform(-18.0, 18.0, people),
                rng.choice([front - 1.2, back + 0.3], people),
                rng.uniform(-3.0, 3.0, people),
                rng.random(people),
            ]
        ),
        seed=int(rng.integers(9973)),
    )
