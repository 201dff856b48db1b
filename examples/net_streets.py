"""Simulated streets as a car that drives along them sees them: what `train_net.py` learns from.

Cars stand at both kerbs, before hedges, garden walls, steps, bins and house fronts; the camera looks ahead, aslant or
to the side, so that near cars are cut by the picture's border and far ones hide one another. A street with
a dozen pictures takes some seconds.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np

from sim_sensors.camera.models import PinholeCamera, camera_pose
from sim_sensors.camera.weather import PRESETS, Weather
from sim_sensors.errors import SensorError
from sim_sensors.ground_truth import vehicle_boxes
from sim_sensors.scene import Fleet, Scene
from sim_sensors.surroundings import Surroundings
from sim_sensors.vehicles.vehicle import VehicleModel

BODIES = {"hatchback": 0.3, "sedan": 0.25, "estate": 0.17, "suv": 0.15, "van": 0.1, "pickup": 0.03}
SIZES = ((832, 256), (640, 224), (512, 384))  # px; the rendered pictures
LENGTH = (-15.0, 75.0)  # m, of a street along x; cameras are near its beginning


class Picture(NamedTuple):
    """A grey picture and its cars, of which at least some pixels are visible."""

    grey: np.ndarray  # (h, w) uint8
    car: np.ndarray  # (h, w) uint8, the row of the car at a pixel, from 1; 0 for everything else
    depth: np.ndarray  # (h, w) float16, m
    visible: np.ndarray  # (n,) fraction of the car that nothing hides, within the picture
    inside: np.ndarray  # (n,) fraction of the car that the picture's border leaves
    view: np.ndarray  # (n,) `sim_sensors.ground_truth.View`
    distance: np.ndarray  # (n,) m


def model_of(rng):
    """Return a random car."""
    return VehicleModel.from_seed(
        str(rng.choice(list(BODIES), p=list(BODIES.values()))), int(rng.integers(1 << 20))
    )


def row_of_cars(rng, kerb, side):
    """Return poses (x, y, yaw) and models of cars at a kerb, y = `kerb`: one after the other, or side by side."""
    across, full = rng.random() < 0.25, rng.uniform(0.3, 1.0)
    poses, models, x = [], [], LENGTH[0] + rng.uniform(0.0, 8.0)
    onto = rng.choice([0.0, 0.0, 0.6, 1.1])  # m that they stand on the pavement
    turn = math.pi / 2 * (1.0 if rng.random() < 0.7 else rng.uniform(0.5, 0.9)) if across else 0.0
    while x < LENGTH[1]:
        model = model_of(rng)
        length = model.width / math.sin(turn) if across else model.length
        if rng.random() < full:
            half = 0.5 * model.length if across else 0.5 * model.width + 0.2
            yaw = turn * side + math.pi * rng.integers(2) + rng.normal(0.0, 0.03)
            poses.append((x + length / 2, kerb - side * (half - onto) + rng.normal(0.0, 0.1), yaw))
            models.append(model)
        x += length + (rng.uniform(0.5, 1.5) if across else rng.gamma(2.0, 0.6) + 0.4)
    return poses, models


def behind_a_kerb(rng, kerb, side):
    """Return buildings, walls, hedges and trees (x, y, height) between a pavement and what lies beyond."""
    buildings, heights, walls, hedges, trees = [], [], [], [], []
    pavement = rng.uniform(0.8, 4.0)
    garden = rng.choice([0.0, rng.uniform(1.0, 8.0)])
    x = LENGTH[0] - 15.0
    while x < LENGTH[1]:
        end, edge = x + rng.uniform(5.0, 22.0), kerb + side * pavement
        front = edge + side * (garden * rng.uniform(0.7, 1.0) + 0.3)
        if rng.random() < 0.75:
            corners = [(x, front), (end, front), (end, front + side * 10.0), (x, front + side * 10.0)]
            buildings.append(corners[::-1] if side < 0 else corners)
            heights.append(rng.uniform(2.6, 12.0))
        if garden or rng.random() < 0.3:
            kind, gap = rng.random(), rng.uniform(0.0, 2.5)
            line = [
                x + gap,
                edge + side * rng.uniform(0.0, 0.8),
                end - gap,
                edge + side * rng.uniform(0.0, 0.8),
            ]
            if kind < 0.4:
                hedges.append([*line, rng.uniform(0.6, 2.4)])
            elif kind < 0.8:
                walls.append([*line, rng.uniform(0.3, 2.0)])
        if rng.random() < 0.5:  # steps, bins, boxes, the ends of garden walls
            for _ in range(rng.integers(1, 4)):
                at, out = rng.uniform(x, end), rng.uniform(0.0, 1.2)
                wide = rng.uniform(0.4, 1.8)
                y = edge - side * out
                walls.append(
                    [at, y, at + wide * rng.choice([0.02, 1.0]), y + side * wide * 0.7, rng.uniform(0.2, 1.4)]
                )
        if rng.random() < 0.4:
            trees.append([rng.uniform(x, end), kerb + side * rng.uniform(0.3, 0.9), rng.uniform(3.5, 11.0)])
        if rng.random() < 0.5:
            trees.append([rng.uniform(x, end), edge + side * rng.uniform(1.0, 14.0), rng.uniform(2.0, 12.0)])
        x = end + rng.choice([0.2, rng.uniform(0.5, 12.0)])
    return buildings, heights, walls, hedges, trees


def street(rng):
    """Return poses of cars, a `Fleet` with their models in this order, and the half width of the road."""
    half = rng.uniform(2.2, 7.0)
    poses, models, behind = [], [], ([], [], [], [], [])
    for side in (1, -1):
        if rng.random() < 0.85:
            row = row_of_cars(rng, side * half, side)
            poses, models = poses + row[0], models + row[1]
        for all_of_them, more in zip(behind, behind_a_kerb(rng, side * half, side), strict=True):
            all_of_them.extend(more)
    for lane in (1, -1):  # cars that drive
        for x in rng.uniform(LENGTH[0] + 18.0, LENGTH[1], rng.integers(0, 3)):
            poses.append(
                (x, -lane * rng.uniform(0.0, 0.4) * half, math.pi * (lane < 0) + rng.normal(0.0, 0.05))
            )
            models.append(model_of(rng))
    people = rng.uniform((LENGTH[0], -half - 2.5, -3, 0), (40, half + 2.5, 3, 1), (rng.integers(6), 4))
    people[:, 1] = np.where(rng.random(len(people)) < 0.7, np.sign(people[:, 1]) * (half + 0.8), people[:, 1])
    low, high, broad = LENGTH[0] - 15.0, LENGTH[1] + 15.0, half + rng.uniform(0.3, 4.0)
    dashes = [[x, 0.0, x + 3.0, 0.0, 0.12] for x in np.arange(low, high, 9.0)] if rng.random() < 0.5 else []
    buildings, heights, walls, hedges, trees = behind
    around = Surroundings(
        paved=[[[low, -broad], [high, -broad], [high, broad], [low, broad]]], markings=dashes, buildings=buildings,
        building_heights=heights, walls=walls, trees=trees, pedestrians=people,
        seed=int(rng.integers(9973)), hedges=hedges,
    )  # fmt: skip
    return np.array(poses).reshape(-1, 3), Fleet(tuple(models), around), half


def camera_on_a_car(rng, half):
    """Return a camera on a car in its lane, which looks ahead, aslant or to the side, and its pose."""
    width, height = SIZES[rng.choice(len(SIZES), p=(0.5, 0.2, 0.3))]
    camera = PinholeCamera.from_field_of_view(
        width, height, horizontal=math.radians(rng.uniform(50.0, 100.0))
    )
    kind = rng.random()
    turn = rng.normal(0.0, 0.12) if kind < 0.45 else rng.uniform(-1.05, 1.05)
    if kind > 0.75:
        turn = (math.pi / 2 + rng.normal(0.0, 0.25)) * rng.choice([-1, 1])
    y = rng.uniform(-0.75, 0.3) * max(half - 1.5, 0.8)
    pose = camera_pose(
        rng.uniform(-4.0, 12.0),
        y,
        rng.uniform(1.1, 1.9),
        turn,
        rng.normal(-0.02, 0.04),
        rng.normal(0.0, 0.015),
    )
    return camera, pose


def part_inside(camera, pose, scene):
    """Return of each vehicle the fraction of its surroundings' points that the picture holds, (n,)."""
    unit = np.stack(np.meshgrid(*(np.linspace(-0.5, 0.5, k) for k in (13, 5, 5)), indexing="ij"), -1).reshape(
        -1, 3
    )
    points = (unit + np.array([0.0, 0.0, 0.5])) * scene.vehicle_boxes[:, None]
    c, s = np.cos(scene.vehicle_pose[:, 2, None]), np.sin(scene.vehicle_pose[:, 2, None])
    x = c * points[..., 0] - s * points[..., 1] + scene.vehicle_pose[:, 0, None]
    y = s * points[..., 0] + c * points[..., 1] + scene.vehicle_pose[:, 1, None]
    seen = np.stack([x, y, points[..., 2], np.ones_like(x)], -1) @ np.linalg.inv(pose).T
    depth = np.maximum(seen[..., 2], 1e-6)
    u, v = (camera.fx * seen[..., 0] / depth + camera.cx, camera.fy * seen[..., 1] / depth + camera.cy)
    within = (seen[..., 2] > 0.1) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)
    return within.mean(axis=1)


def pictures_of_a_street(seed, number, pictures):
    """Yield pictures of a random street."""
    rng = np.random.default_rng([seed, number])
    poses, fleet, half = street(rng)
    weathers = [Weather.draw(str(rng.choice(PRESETS)), int(rng.integers(1 << 20))) for _ in range(3)]
    for i in range(pictures):
        camera, pose = camera_on_a_car(rng, half)
        there = rng.random(len(poses)) < (0.0 if i % 10 == 9 else rng.uniform(0.5, 1.0))
        corner = np.hypot(*(poses[:, :2] - pose[:2, 3]).T)
        # The camera's own car has room.
        there = np.flatnonzero(
            there & (corner > 1.8) & ~((np.abs(poses[:, 1] - pose[1, 3]) < 1.6) & (corner < 4.5))
        )
        scene = Scene(poses[there], there, fleet)
        try:
            frame = camera.render(scene, pose, weathers[i % 3], int(rng.integers(1 << 20)))
        except SensorError:  # the camera is inside a car that stands aslant
            continue
        truth, inside = vehicle_boxes(camera, scene, pose, frame), part_inside(camera, pose, scene)
        pixels = np.bincount(frame.ids.ravel(), minlength=len(there) + 1)
        shown = np.flatnonzero(pixels[truth.ids] >= 12)[:255]
        row = np.zeros(len(there) + 1, np.uint8)
        row[truth.ids[shown]] = 1 + np.arange(len(shown))
        grey, depth = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), np.minimum(frame.depth, 6e4)
        mine = (
            truth.visible_fraction[shown],
            inside[truth.ids[shown] - 1],
            truth.view[shown],
            truth.distance[shown],
        )
        yield Picture(grey, row[frame.ids], depth.astype(np.float16), *mine)
