"""Pictures of simulated streets with every car's pixels and box: what the network `net` is trained on.

A picture is drawn once; `training_crops` makes many training examples of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array, FloatArray, Image
from parkenv.errors import InputError
from parkenv.files.archives import read_arrays
from parkenv.perception.hog_detector import as_grey
from parkenv.perception.lab.simulated_streets import FRAMES, LongLens, Street, StreetPictures
from sim_sensors.camera.models import Frame, PinholeCamera, camera_pose
from sim_sensors.ground_truth import VehicleBoxes

DEPTH_STEPS = 32.0
"""Steps of the stored depth for a factor of e: they are 3 % apart."""

_NEAR_SIZE = (512, 384)  # px
_LEAST_PIXELS = 12  # of a car that is seen at all
_ACROSS = LongLens((400, 300), (6.0, 32.0), (0.7, 2.8), (90.0, 300.0), (56.0, 200.0), aside=0.22, roll=0.02)


@dataclass(frozen=True, eq=False)
class SimulatedScene:
    """A grey picture, and where its cars are."""

    grey: Image  # (h, w)
    car: Image  # (h, w), the row of the car that is visible at a pixel, from 1; 0 for everything else
    depth: Image  # (h, w), `DEPTH_STEPS` · log(depth in m), at most 255
    visible: Float32Array  # (n,), visible fraction of each car
    view: NDArray[np.int8]  # (n,), a `sim_sensors.ground_truth.View` each
    distance: Float32Array  # (n,), m

    @cached_property
    def pixels(self) -> Float32Array:
        """(n + 1,), visible pixels of everything else and of each car."""
        return np.bincount(self.car.ravel(), minlength=len(self.visible) + 1).astype(np.float32)

    @cached_property
    def box(self) -> NDArray[np.int32]:
        """(n, 4) px: left, top, width, height of the visible part of each car."""
        rows = range(1, len(self.visible) + 1)
        boxes = [cv2.boundingRect((self.car == row).astype(np.uint8)) for row in rows]
        return np.array(boxes, dtype=np.int32).reshape(-1, 4)

    @cached_property
    def is_cut(self) -> NDArray[np.bool_]:
        """(n,), whether a car reaches the picture's border."""
        height, width = self.grey.shape
        left_top, right_bottom = self.box[:, :2], self.box[:, :2] + self.box[:, 2:]
        return np.asarray((left_top == 0).any(axis=1) | (right_bottom == (width, height)).any(axis=1))


def simulated_scenes(n_streets: int, seed: int = 0, cache: Path | None = None) -> Iterator[SimulatedScene]:
    """Draw random streets in random light, `FRAMES` pictures of each.

    Args:
        n_streets: number of streets; the first ones of a longer run are the same.
        seed: 0 or more.
        cache: folder in which the pictures are kept, a file for each street; those that are there are read.

    Raises:
        InputError: a file of the folder cannot be read.
    """
    pictures = StreetPictures(_ACROSS, 0.55, _in_passing, 0.3, 10)
    for number in range(n_streets):
        file = None if cache is None else cache / f"street_{seed}_{number}.npz"
        if file is not None and file.is_file():
            yield from _read(file)
            continue
        scenes = [_scene(frame, boxes) for frame, boxes, _ in pictures.of_street(number, seed)]
        if file is not None:
            _write(file, scenes)
        yield from scenes


def _scene(frame: Frame, boxes: VehicleBoxes) -> SimulatedScene:
    row = np.zeros(max(int(frame.ids.max(initial=0)), int(boxes.ids.max(initial=0))) + 1, dtype=np.uint8)
    pixels = np.bincount(frame.ids.ravel(), minlength=len(row))
    shown = np.flatnonzero(pixels[boxes.ids] >= _LEAST_PIXELS)[:255]
    row[boxes.ids[shown]] = 1 + np.arange(len(shown))
    with np.errstate(divide="ignore"):
        depth = np.clip(DEPTH_STEPS * np.log(np.minimum(frame.depth, 1e5)), 0.0, 255.0)
    return SimulatedScene(
        as_grey(frame.image), row[frame.ids], depth.astype(np.uint8),
        boxes.visible_fraction[shown].astype(np.float32), boxes.view[shown],
        boxes.distance[shown].astype(np.float32),
    )  # fmt: skip


def _in_passing(street: Street, rng: np.random.Generator) -> tuple[PinholeCamera, FloatArray]:
    """Place a wide-angle camera on a car that passes the slots at close range, looking sideways or ahead."""
    camera = PinholeCamera.from_field_of_view(*_NEAR_SIZE, horizontal=rng.uniform(0.7, 1.6))
    turn = rng.uniform(-0.9, 0.9) if rng.random() < 0.3 else rng.normal(0.0, 0.15)
    pose = camera_pose(
        rng.uniform(-14.0, 14.0), street.front - rng.uniform(1.6, 12.0), rng.uniform(0.8, 2.2),
        math.pi / 2 + turn, rng.uniform(-0.15, 0.07), rng.normal(0.0, 0.015),
    )  # fmt: skip
    return camera, pose


_ARRAYS = [field.name for field in fields(SimulatedScene)]


def _write(file: Path, scenes: list[SimulatedScene]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    unfinished = file.with_suffix(".part.npz")
    arrays = {f"{name}_{i}": getattr(scene, name) for i, scene in enumerate(scenes) for name in _ARRAYS}
    np.savez_compressed(unfinished, **arrays)
    unfinished.replace(file)


def _read(file: Path) -> Iterator[SimulatedScene]:
    stored = read_arrays(file)
    try:
        for i in range(FRAMES):
            yield SimulatedScene(**{name: stored[f"{name}_{i}"] for name in _ARRAYS})
    except KeyError as error:
        raise InputError(f"{file}: holds no array {error}, want pictures of a street; remove it") from error
