"""Made photographs: crops of cars pasted at many sizes into images without cars, to test detectors at all scales."""

from __future__ import annotations

import math

import cv2
import numpy as np

from parkenv.compiled.arrays import Float32Array, Image
from parkenv.perception.lab.car_datasets import Crops, LabelledImage

Box = tuple[int, int, int, int]  # left, top, right, bottom, px

SIZES = (0.8, 2.2)
"""Smallest and largest size of a pasted car relative to its crop; UIUC's multi-scale cars are 0.89 to 2.12."""
_WIDE, _HIGH = (1.8, 3.6), (3.6, 6.0)  # sizes of a photograph relative to the width and the height of a crop
_TWO_CARS = 0.3  # fraction of photographs with a second car
_FEATHER = 0.09  # width of the blended border of a crop, as a fraction of its sides
_STEP = 0.9  # from one tile of a mosaic to the next, as a fraction of its sides
_TRIES = 60


def made_photos(crops: Crops, n: int, seed: int = 0) -> list[LabelledImage]:
    """Paste cars into mosaics of images without cars, one or two into each; every car is pasted in turn.

    Args:
        crops: aligned crops of cars, and images without cars.
        n: number of photographs.
        seed: seed of sizes, places and backgrounds.

    Returns:
        Photographs with the boxes of the pasted crops, border included, as UIUC labels its test images.
    """
    rng = np.random.default_rng(seed)
    height, width = np.median([car.shape for car in crops.positives], axis=0)
    waiting: list[int] = []
    photos = []
    for number in range(n):
        shape = round(height * rng.uniform(*_HIGH)), round(width * rng.uniform(*_WIDE))
        canvas = _mosaic(crops.negatives, shape, rng)
        boxes: list[Box] = []
        for _ in range(2 if rng.random() < _TWO_CARS else 1):
            box = _free_place((height, width), shape, boxes, rng)
            if box is not None:
                waiting = waiting or rng.permutation(len(crops.positives)).tolist()
                _paste(canvas, _perhaps_mirrored(crops.positives[waiting.pop()], rng), box)
                boxes.append(box)
        image = np.clip(canvas, 0.0, 255.0).astype(np.uint8)
        photos.append(LabelledImage(f"made {number}", image, np.array(boxes, np.float64).reshape(-1, 4)))
    return photos


def _free_place(
    car: tuple[float, float], shape: tuple[int, int], boxes: list[Box], rng: np.random.Generator
) -> Box | None:
    """Draw a box for a car, (height, width), inside the image and apart from the other boxes."""
    for _ in range(_TRIES):
        size = math.exp(rng.uniform(*np.log(SIZES)))
        height, width = round(car[0] * size), round(car[1] * size)
        if height > shape[0] or width > shape[1]:
            continue
        top, left = int(rng.integers(shape[0] - height + 1)), int(rng.integers(shape[1] - width + 1))
        if all(left >= b[2] or left + width <= b[0] or top >= b[3] or top + height <= b[1] for b in boxes):
            return left, top, left + width, top + height
    return None


def _paste(canvas: Float32Array, car: Image, box: Box) -> None:
    """Paste a car at a box, enlarged or reduced, its border blended into the background."""
    left, top, right, bottom = box
    size = right - left, bottom - top
    how = cv2.INTER_LANCZOS4 if size[0] > car.shape[1] else cv2.INTER_AREA
    place = canvas[top:bottom, left:right]
    place += _feather(size) * (cv2.resize(car, size, interpolation=how).astype(np.float32) - place)


def _mosaic(tiles: list[Image], shape: tuple[int, int], rng: np.random.Generator) -> Float32Array:
    """Cover an image, (height, width), with enlarged images, their borders blended into one another."""

    def tile(grow: float) -> Float32Array:
        drawn = _perhaps_mirrored(tiles[int(rng.integers(len(tiles)))], rng)
        enlarged = cv2.resize(drawn, None, fx=grow, fy=grow, interpolation=cv2.INTER_CUBIC)
        return np.asarray(enlarged, dtype=np.float32)

    canvas = np.asarray(cv2.resize(tile(1.0), shape[::-1], interpolation=cv2.INTER_CUBIC))
    top = 0
    while top < shape[0]:
        left, grow = 0, rng.uniform(1.0, SIZES[1])
        while left < shape[1]:
            patch = tile(grow)
            place = canvas[top : top + patch.shape[0], left : left + patch.shape[1]]
            high, wide = place.shape
            weights = _feather((patch.shape[1], patch.shape[0]))
            place += weights[:high, :wide] * (patch[:high, :wide] - place)
            left += max(1, int(_STEP * patch.shape[1]))
        top += max(1, int(_STEP * patch.shape[0]))
    return canvas


def _feather(size: tuple[int, int]) -> Float32Array:
    """Return weights, (height, width) float32 for a (width, height): 1 inside, falling to 0 at the border."""
    across, down = (
        np.clip((np.minimum(np.arange(n), np.arange(n)[::-1]) + 0.5) / (_FEATHER * n), 0.0, 1.0) for n in size
    )
    return np.outer(down, across).astype(np.float32)


def _perhaps_mirrored(image: Image, rng: np.random.Generator) -> Image:
    return np.ascontiguousarray(image[:, ::-1]) if rng.random() < 0.5 else image
