"""Labelled pictures of simulated cars, as hard and varied as they can be made: what shipped models are trained on."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.perception.car_datasets import LabelledImage
from parkenv.perception.detector import as_grey
from sim_sensors.camera import PinholeCamera, camera_pose
from sim_sensors.ground_truth import VehicleBoxes, View, vehicle_boxes
from sim_sensors.scene import Scene
from sim_sensors.slot_scenes import ParkingManners, SlotLot, slot_surroundings
from sim_sensors.surroundings import Surroundings
from sim_sensors.weather import PRESETS, Weather

Image = NDArray[np.uint8]
FloatArray = NDArray[np.float64]

SIDE_CAR = (0.07, 0.22, 0.93, 0.88)
"""Where a car lies in a side view's region, left, top, right, bottom: as in UIUC's crops."""
SIDE_ASPECT = 2.5
END_CAR = (0.08, 0.12, 0.92, 0.92)
"""The same of a front or rear."""
END_ASPECT = 1.0

_CLEAR = 0.8  # visible share from which a car is a positive
_NEGLIGIBLE = 0.25  # share below which a car may be missed
_LEAST_WIDTH = 36  # px
_FRAMES, _WEATHERS = 20, 2


@dataclass(frozen=True, eq=False)
class SimulatedPhoto:
    """A picture, its cars, and the crops that it gives.

    Attributes:
        labelled: the grey picture with the boxes of all cars in it.
        sides: crops of cars seen from the side, aligned alike.
        ends: crops of fronts and rears.
    """

    labelled: LabelledImage
    sides: list[Image]
    ends: list[Image]


def simulated_photos(n_scenes: int, seed: int = 0) -> Iterator[SimulatedPhoto]:
    """Pictures of random car parks in random light, twenty of each, every fifth without a car.

    Cars stand along the street, across it or aslant; lenses, heights and distances differ; trees, walls, houses, posts
    and people stand before and behind them. Every picture then goes through random exposure, blur, noise and scale.

    Args:
        n_scenes: how many car parks.
        seed: 0 or more.
    """
    for number in range(n_scenes):
        rng = np.random.default_rng([seed, number])
        lot = _car_park(rng, seed * 100_003 + number)
        n = len(np.asarray(lot.slot_xy))
        weathers = [_weather(rng) for _ in range(_WEATHERS)]
        for frame in range(_FRAMES):
            empty = frame % 5 == 4
            taken = np.zeros(n, dtype=bool) if empty else rng.random(n) < rng.uniform(0.35, 1.0)
            scene = lot.scene(taken, int(rng.integers(1 << 20)))
            yield _photo(scene, weathers[frame % _WEATHERS], rng, f"scene {number}, frame {frame}")


def region_of(box: FloatArray, car: tuple[float, float, float, float], aspect: float) -> FloatArray:
    """What a window shows whose car has this box: as wide as the car asks for, on the car's own ground.

    Args:
        box: (4,) px, left, top, right, bottom of the car.
        car: where the car lies in the window, as shares.
        aspect: width over height of the window.
    """
    width = (box[2] - box[0]) / (car[2] - car[0])
    height = width / aspect
    left = box[0] - car[0] * width
    top = box[3] - car[3] * height
    return np.array([left, top, left + width, top + height])


def roughened(image: Image, rng: np.random.Generator) -> Image:
    """The image through another camera: contrast, gamma, blur, noise."""
    values = image.astype(np.float32) / 255.0
    low, high = np.quantile(values, [0.02, 0.98])
    if rng.random() < 0.5 and high - low > 0.05:
        values = np.clip((values - low) / (high - low), 0.0, 1.0)
    values = values ** np.float32(rng.uniform(0.55, 1.7))
    values = np.clip((values - 0.5) * rng.uniform(0.6, 1.5) + 0.5 + rng.uniform(-0.12, 0.12), 0.0, 1.0)
    if rng.random() < 0.6:
        values = cv2.GaussianBlur(values, (0, 0), float(rng.uniform(0.3, 1.3)))
    values += rng.normal(0.0, rng.uniform(0.0, 0.035), values.shape).astype(np.float32)
    return np.asarray(np.clip(255.0 * values, 0, 255), dtype=np.uint8)


def _car_park(rng: np.random.Generator, seed: int) -> SlotLot:
    kind = rng.choice(["along", "across", "aslant"], p=[0.55, 0.35, 0.1])
    count = int(rng.integers(8, 13))
    if kind == "along":
        length, width, pitch, yaw = 6.0, 2.1, rng.uniform(5.6, 7.5), rng.choice([0.0, math.pi])
    else:
        turn = math.pi / 2 if kind == "across" else rng.uniform(0.9, 1.3)
        length, width, pitch, yaw = 5.0, 2.5, 2.5 / math.sin(turn), turn * rng.choice([1.0, -1.0])
    x = pitch * (np.arange(count) - (count - 1) / 2.0)
    rows = [np.column_stack([x, np.zeros(count)])]
    # A second row behind the first, and one on the other side of the street.
    depth = 2.6 if kind == "along" else 5.6
    if rng.random() < 0.3:
        rows.append(
            np.column_stack([x + rng.uniform(0.0, 2.0), np.full(count, depth + rng.uniform(0.0, 6.0))])
        )
    xy = np.concatenate(rows)
    plain = SlotLot(
        xy, np.full(len(xy), yaw), length, width, kerbside=kind == "along",
        surroundings=Surroundings(seed=seed), manners=ParkingManners(nose_out=0.5), seed=seed,
    )  # fmt: skip
    back = float(xy[:, 1].max()) + 3.5
    around = slot_surroundings(plain, [np.array([[-30.0, -6.0], [30.0, -6.0]])], **_scenery(rng, back, seed))
    return SlotLot(
        xy, np.full(len(xy), yaw), length, width, kerbside=kind == "along",
        surroundings=around, manners=plain.manners, seed=seed,
    )  # fmt: skip


def _scenery(rng: np.random.Generator, back: float, seed: int) -> dict[str, object]:
    things: dict[str, object] = {"seed": seed % 9973}
    if rng.random() < 0.45:
        y, far = back + rng.uniform(1.0, 8.0), back + 20.0
        edges = np.sort(rng.uniform(-40.0, 40.0, 2)) + np.array([-12.0, 12.0])
        outline = [[edges[0], y], [edges[1], y], [edges[1], far], [edges[0], far]]
        things |= {"buildings": [outline], "building_heights": [rng.uniform(3.5, 14.0)]}
    elif rng.random() < 0.6:
        things["walls"] = [[-45.0, back, 45.0, back + rng.uniform(-0.5, 2.0), rng.uniform(0.6, 2.6)]]
    trees = int(rng.integers(0, 9))
    spots = np.column_stack([rng.uniform(-30, 30, trees), rng.uniform(back + 0.5, back + 14.0, trees)])
    things["trees"] = np.column_stack([spots, rng.uniform(4.0, 10.0, trees)])
    before = int(rng.integers(0, 3))
    spots = np.column_stack([rng.uniform(-20, 20, before), rng.uniform(-3.4, -2.8, before)])
    things["lamp_posts"] = np.column_stack([spots, rng.uniform(-3, 3, before)])
    people = int(rng.integers(0, 5))
    spots = np.column_stack([rng.uniform(-18, 18, people), rng.choice([-3.6, back - 0.5], people)])
    things["pedestrians"] = np.column_stack([spots, rng.uniform(-3, 3, people), rng.random(people)])
    if rng.random() < 0.5:
        things["kerbs"] = [[[-40.0, back - 1.0], [40.0, back - 1.0]]]
    return things


def _weather(rng: np.random.Generator) -> Weather:
    return Weather.draw(str(rng.choice(PRESETS)), int(rng.integers(1 << 20)))


def _photo(scene: Scene, weather: Weather, rng: np.random.Generator, name: str) -> SimulatedPhoto:
    camera = PinholeCamera.from_field_of_view(horizontal=rng.uniform(0.7, 1.6))
    away = rng.uniform(4.2, 13.0)
    pose = camera_pose(
        rng.uniform(-14.0, 14.0), -away, rng.uniform(0.9, 2.0), math.pi / 2 + rng.normal(0.0, 0.12),
        rng.uniform(-0.12, 0.04), rng.normal(0.0, 0.01),
    )  # fmt: skip
    frame = camera.render(scene, pose, weather, int(rng.integers(1 << 20)))
    boxes = vehicle_boxes(camera, scene, pose, frame)
    grey = roughened(as_grey(frame.image), rng)
    sides, ends = _crops(grey, boxes, rng)
    there = boxes.visible_fraction > _NEGLIGIBLE
    return SimulatedPhoto(LabelledImage(name, grey, boxes.visible_box[there].astype(np.float64)), sides, ends)


def _crops(grey: Image, boxes: VehicleBoxes, rng: np.random.Generator) -> tuple[list[Image], list[Image]]:
    crops: dict[View, list[Image]] = {View.SIDE: [], View.END: []}
    height, width = grey.shape
    for i in np.flatnonzero(boxes.visible_fraction > _CLEAR).tolist():
        view, box = View(boxes.view[i]), boxes.box[i].astype(np.float64)
        whole = box[0] > 0 and box[1] > 0 and box[2] < width and box[3] < height
        wide, high = box[2] - box[0], box[3] - box[1]
        if view not in crops or not whole or wide < _LEAST_WIDTH:
            continue
        if (view is View.SIDE and wide < 2.1 * high) or (view is View.END and wide > 1.7 * high):
            continue
        car, aspect = (SIDE_CAR, SIDE_ASPECT) if view is View.SIDE else (END_CAR, END_ASPECT)
        region = region_of(box, car, aspect)
        size = (100, 40) if view is View.SIDE else (64, 64)
        crops[view].append(_patch(grey, region, size, rng))
    return crops[View.SIDE], crops[View.END]


def _patch(grey: Image, region: FloatArray, size: tuple[int, int], rng: np.random.Generator) -> Image:
    """The region at a resolution as photographs have it: coarse ones are drawn out, fine ones stay at most double."""
    edge = int(max(region[2] - region[0], region[3] - region[1])) + 2
    wider = cv2.copyMakeBorder(grey, edge, edge, edge, edge, cv2.BORDER_REPLICATE)
    left, top, right, bottom = np.round(region + edge).astype(int)
    patch = wider[top:bottom, left:right]
    scale = rng.uniform(0.5, 1.6)
    coarse = max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
    if coarse[0] < patch.shape[1]:
        patch = cv2.resize(patch, coarse, interpolation=cv2.INTER_AREA)
    return np.asarray(patch)
