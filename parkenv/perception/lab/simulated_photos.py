"""Labelled images of simulated cars in varied conditions: the training data of the packaged models."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, Image
from parkenv.perception.car_regions import END, SIDE, CarWindow
from parkenv.perception.hog_detector import as_grey
from parkenv.perception.lab.backdrops import with_backdrop
from parkenv.perception.lab.car_datasets import LabelledImage
from parkenv.perception.lab.simulated_streets import LongLens, Street, StreetPictures
from sim_sensors.camera.models import Frame, PinholeCamera, camera_pose
from sim_sensors.ground_truth import VehicleBoxes, View

_CLEAR = 0.8  # visible fraction from which a car is a positive
_NEGLIGIBLE = 0.25  # visible fraction below which a car may be missed
_LEAST_WIDTH = 36  # px
_TEXTURED = 0.9  # fraction of images with a backdrop
_ACROSS = LongLens((400, 300), (7.0, 32.0), (0.9, 2.4), (90.0, 230.0), (56.0, 170.0), aside=0.17, roll=0.015)


@dataclass(frozen=True, eq=False)
class SimulatedPhoto:
    """An image, its cars, and crops of them."""

    labelled: LabelledImage  # the grey image with the boxes of all its cars
    crops: Mapping[
        CarWindow, list[Image]
    ]  # aligned crops of cars seen from the side, and of fronts and rears


def simulated_photos(n_scenes: int, seed: int = 0) -> Iterator[SimulatedPhoto]:
    """Render images of random streets in random light, twenty per street, every fifth without cars.

    Cars are parked along the street, perpendicular or at an angle. About half of the images have a long focal length,
    the others come from a rig's camera. The background gets random texture, and every image random exposure, blur and
    noise.

    Args:
        n_scenes: number of streets.
        seed: 0 or more.
    """
    pictures = StreetPictures(_ACROSS, 0.6, _as_rigs_see, 0.4, 5)
    for number in range(n_scenes):
        for i, (frame, boxes, rng) in enumerate(pictures.of_street(number, seed)):
            yield _photo(frame, boxes, rng, f"street {number}, frame {i}")


def roughened(image: Image, rng: np.random.Generator) -> Image:
    """Simulate another camera: exposure, contrast, gamma, blur, sharpening, noise."""
    values = image.astype(np.float32) / 255.0
    height = len(values)
    # Expose for the objects on the ground, as a photographer would, and not for the sky.
    middle = values[int(0.3 * height) : int(0.8 * height) + 1]
    low, high = np.quantile(middle, [rng.uniform(0.0, 0.04), rng.uniform(0.93, 1.0)])
    if rng.random() < 0.75 and high - low > 0.03:
        values = np.clip((values - low) / (high - low), 0.0, 1.0)
    values = values ** np.float32(math.exp(rng.uniform(-0.6, 0.35)))
    contrast, brightness = math.exp(rng.uniform(-0.7, 0.2)), rng.uniform(-0.1, 0.1)
    values = np.clip((values - 0.5) * np.float32(contrast) + np.float32(0.5 + brightness), 0.0, 1.0)
    if rng.random() < 0.6:
        values = cv2.GaussianBlur(values, (0, 0), float(rng.uniform(0.3, 1.3)))
    if rng.random() < 0.2:
        values = values + (values - cv2.GaussianBlur(values, (0, 0), 1.2)) * np.float32(rng.uniform(0.4, 1.2))
    values = values + rng.normal(0.0, rng.uniform(0.0, 0.03), values.shape).astype(np.float32)
    return np.asarray(np.clip(255.0 * values, 0, 255), dtype=np.uint8)


def _photo(frame: Frame, boxes: VehicleBoxes, rng: np.random.Generator, name: str) -> SimulatedPhoto:
    there_at_all = boxes.visible_fraction > _NEGLIGIBLE
    grey, clear = as_grey(frame.image), boxes.visible_fraction > _CLEAR
    if rng.random() < _TEXTURED:
        nearest = boxes.distance[clear].min() if clear.any() else rng.uniform(6.0, 20.0)
        behind = nearest + rng.uniform(1.5, 5.0)
        grey = with_backdrop(grey, frame.depth > behind, rng)
        # Cars that the texture may cover are neither positives nor negatives.
        clear &= boxes.distance < behind - 1.5
    grey = roughened(grey, rng)
    crops = _crops(grey, boxes, clear, rng)
    labelled = LabelledImage(name, grey, boxes.visible_box[there_at_all].astype(np.float64))
    return SimulatedPhoto(labelled, crops)


def _as_rigs_see(street: Street, rng: np.random.Generator) -> tuple[PinholeCamera, FloatArray]:
    """Place a wide-angle camera on a car that passes the slots at close range."""
    camera = PinholeCamera.from_field_of_view(horizontal=rng.uniform(0.8, 1.6))
    pose = camera_pose(
        rng.uniform(-14.0, 14.0), street.front - rng.uniform(1.6, 9.0), rng.uniform(1.0, 1.8),
        math.pi / 2 + rng.normal(0.0, 0.15), rng.uniform(-0.1, 0.05), rng.normal(0.0, 0.01),
    )  # fmt: skip
    return camera, pose


def _crops(
    grey: Image, boxes: VehicleBoxes, clear: NDArray[np.bool_], rng: np.random.Generator
) -> dict[CarWindow, list[Image]]:
    """Return crops of sides and ends of unoccluded cars that are completely in the image and seen at a right angle."""
    crops: dict[CarWindow, list[Image]] = {SIDE: [], END: []}
    height, width = grey.shape
    for i in np.flatnonzero(clear).tolist():
        view, box = View(boxes.view[i]), boxes.box[i].astype(np.float64)
        whole = box[0] > 0 and box[1] > 0 and box[2] < width and box[3] < height
        wide, high = box[2] - box[0], box[3] - box[1]
        if not whole or wide < _LEAST_WIDTH:
            continue
        if view is View.SIDE and wide >= 2.1 * high:
            crops[SIDE].append(_patch(grey, SIDE.region(box), (100, 40), rng))
        if view is View.END and wide <= 1.7 * high:
            crops[END].append(_patch(grey, END.region(box), (64, 64), rng))
    return crops


def _patch(grey: Image, region: FloatArray, size: tuple[int, int], rng: np.random.Generator) -> Image:
    """Cut out a region at the resolution of photographs: enlarge small ones, reduce large ones to twice the size."""
    edge = int(max(region[2] - region[0], region[3] - region[1])) + 2
    wider = cv2.copyMakeBorder(grey, edge, edge, edge, edge, cv2.BORDER_REPLICATE)
    left, top, right, bottom = np.round(region + edge).astype(int)
    patch = wider[top:bottom, left:right]
    scale = rng.uniform(0.5, 1.6)
    coarse = max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
    if coarse[0] < patch.shape[1]:
        patch = cv2.resize(patch, coarse, interpolation=cv2.INTER_AREA)
    return np.asarray(patch)
