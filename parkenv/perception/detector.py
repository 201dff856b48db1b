"""Cars in an image: a window slides over every size of it, and a linear model judges each place (T §3.2.1, §3.2.2)."""

from __future__ import annotations

import io
import json
import math
import zipfile
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.files.atomic_write import atomic_write
from parkenv.perception.hog import CELL, Descriptor, correlate

Image = NDArray[np.uint8]
Float32Array = NDArray[np.float32]

SHIPPED = ("side", "front")
"""Models that come with the package; trained on simulated images alone."""
_FORMAT = "parkenv-car-model"
_VERSION = 2  # 1 knew no root of the grey values
_ZOOM = 1.6
_MOST_WINDOWS = 2000  # the best of them; a model that likes more places than that has nothing to say
_EPOCH = (1980, 1, 1, 0, 0, 0)  # equal models are equal files


@dataclass(frozen=True, eq=False)
class CarModel:
    """A linear judge of windows.

    Args:
        descriptor: what is computed of a window.
        weights: `descriptor.shape` float32.
        bias: added to the weighted sum; a window with a score above 0 is taken for a car.
        region_aspect: width over height of what of the image is stretched into the window.
        car: left, top, right, bottom of the car within the window, as shares of its width and height.
        calibration: slope and offset: the probability of a score s is 1/(1 + exp(-(slope·s + offset))).
        ends: whether it knows fronts and rears rather than sides.
        trained_on: a line for people.

    Raises:
        InputError: weights of another shape, or a number out of its range.
    """

    descriptor: Descriptor
    weights: Float32Array
    bias: float
    region_aspect: float
    car: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    calibration: tuple[float, float] = (1.0, 0.0)
    ends: bool = False
    trained_on: str = ""

    def __post_init__(self) -> None:
        weights = np.ascontiguousarray(self.weights, dtype=np.float32)
        if weights.shape != self.descriptor.shape or not np.isfinite(weights).all():
            raise InputError(f"weights are {weights.shape}, want finite {self.descriptor.shape}")
        object.__setattr__(self, "weights", weights)
        left, top, right, bottom = self.car
        if not (0.0 <= left < right <= 1.0 and 0.0 <= top < bottom <= 1.0):
            raise InputError(f"car is {self.car}, want shares left < right, top < bottom within the window")
        if not (self.region_aspect > 0.0 and math.isfinite(self.region_aspect)):
            raise InputError(f"region_aspect is {self.region_aspect}, want a finite number above 0")

    def probability(self, score: Float32Array) -> Float32Array:
        """P(car) of each score."""
        slope, offset = self.calibration
        return np.asarray(1.0 / (1.0 + np.exp(-(slope * score + offset))), dtype=np.float32)

    def scores(self, crops: NDArray[np.uint8]) -> Float32Array:
        """Score of each of (n, height, width) uint8 grey windows."""
        flat = self.weights.reshape(-1)
        return np.array([self.descriptor.describe(c) @ flat + self.bias for c in crops], dtype=np.float32)

    def save(self, path: Path) -> None:
        """Write an `.npz` of some ten kB; equal models give equal bytes."""
        settings = {
            "format": _FORMAT,
            "version": _VERSION,
            "window": [self.descriptor.width, self.descriptor.height],
            "normalization": self.descriptor.normalization,
            "bias": self.bias,
            "region_aspect": self.region_aspect,
            "car": list(self.car),
            "calibration": list(self.calibration),
            "ends": self.ends,
            "trained_on": self.trained_on,
        }
        parts: dict[str, NDArray[Any]] = {
            "settings": np.frombuffer(json.dumps(settings, sort_keys=True).encode(), dtype=np.uint8),
            "weights": self.weights,
        }
        with atomic_write(path) as beside, zipfile.ZipFile(beside, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, array in parts.items():
                data = io.BytesIO()
                np.save(data, array, allow_pickle=False)
                archive.writestr(
                    zipfile.ZipInfo(f"{name}.npy", _EPOCH), data.getvalue(), zipfile.ZIP_DEFLATED
                )

    @classmethod
    def load(cls, name: str | Path) -> CarModel:
        """A shipped model by name, or one from a file.

        Raises:
            InputError: no such model, no such file, or a file of another kind or version.
        """
        if str(name) in SHIPPED:
            source = resources.files("parkenv.perception") / "models" / f"{name}.npz"
            data = source.read_bytes()
        elif Path(name).is_file():
            data = Path(name).read_bytes()
        else:
            raise InputError(f"{name}: no such model; want {', '.join(SHIPPED)}, or an .npz file")
        try:
            with np.load(io.BytesIO(data), allow_pickle=False) as parts:
                settings = json.loads(bytes(parts["settings"]).decode())
                weights = parts["weights"]
            if settings["format"] != _FORMAT:
                raise KeyError("format")
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise InputError(
                f"{name}: is no car model; want an .npz that parkenv train-detector wrote"
            ) from error
        if settings["version"] != _VERSION:
            raise InputError(
                f"{name}: is a model of version {settings['version']}, want {_VERSION}: made by another parkenv"
            )
        try:
            return cls(
                Descriptor(settings["window"][0], settings["window"][1], settings["normalization"]),
                weights,
                float(settings["bias"]),
                float(settings["region_aspect"]),
                tuple(settings["car"]),
                tuple(settings["calibration"]),
                bool(settings["ends"]),
                str(settings["trained_on"]),
            )
        except (KeyError, TypeError) as error:
            raise InputError(f"{name}: the model's settings are incomplete: {error}") from error


@dataclass(frozen=True, eq=False)
class Detections:
    """What was found in an image, best first.

    Attributes:
        boxes: (n, 4) float32 px, left, top, right, bottom of the cars; they may stick out of the image.
        score: (n,) float32, of the model that found each.
        probability: (n,) float32, the score's.
        ends: (n,) bool, found as a front or rear.
        regions: (n, 4) float32 px, what of the image filled the window.
    """

    boxes: Float32Array
    score: Float32Array
    probability: Float32Array
    ends: NDArray[np.bool_]
    regions: Float32Array

    def __len__(self) -> int:
        return len(self.score)

    def chosen(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> Detections:
        """Some of them."""
        return Detections(
            self.boxes[rows], self.score[rows], self.probability[rows], self.ends[rows], self.regions[rows]
        )


@dataclass(frozen=True, eq=False)
class Detector:
    """Slides the models' windows over an image pyramid.

    Args:
        models: side, front, or others.
        least_height: px, of the smallest regions looked for; None: five eighths of each model's window, as what is
            smaller shows little when it is enlarged, and costs the most.
        most_height: px, of the largest; None: as large as the image and its margin allow.
        scale_step: from one size to the next.
        threshold: probability from which a window is taken for a car.
        overlap: share, intersection over union, from which of two boxes only the better is kept.
        margin: cars may stick out of the image by this share of their region; the border is taken to go on.

    Raises:
        InputError: no model, or a number out of its range.
    """

    models: tuple[CarModel, ...]
    least_height: float | None = None
    most_height: float | None = None
    scale_step: float = 1.2
    threshold: float = 0.5
    overlap: float = 0.4
    margin: float = 0.25

    def __post_init__(self) -> None:
        if not self.models:
            raise InputError("models is empty, want at least one")
        if self.least_height is not None and not self.least_height >= 8.0:
            raise InputError(f"least_height is {self.least_height} px, want at least 8")
        if self.most_height is not None and not self.most_height >= (self.least_height or 8.0):
            raise InputError(
                f"most_height is {self.most_height} px, want at least {self.least_height or 8.0}"
            )
        if not self.scale_step > 1.0:
            raise InputError(f"scale_step is {self.scale_step}, want above 1")
        for name in ("threshold", "overlap"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise InputError(f"{name} is {getattr(self, name)}, want between 0 and 1")
        if not 0.0 <= self.margin <= 1.0:
            raise InputError(f"margin is {self.margin}, want a share")

    @classmethod
    def load(cls, *names: str | Path, threshold: float = 0.5, least_height: float | None = None) -> Detector:
        """A detector of shipped models or of model files; of both shipped ones where none is named."""
        models = tuple(CarModel.load(name) for name in names or SHIPPED)
        return cls(models, least_height=least_height, threshold=threshold)

    def detect(self, image: Image) -> Detections:
        """Find the cars.

        Args:
            image: (h, w) grey or (h, w, 3) RGB, uint8.

        Raises:
            InputError: another shape or dtype.
        """
        grey = as_grey(image)
        found = [self.scan(model, grey) for model in self.models]
        together = Detections(
            *(np.concatenate([getattr(f, name) for f in found]) for name in Detections.__dataclass_fields__)
        )
        return together.chosen(best_boxes(together.boxes, together.probability, self.overlap))

    def scan(self, model: CarModel, grey: Image) -> Detections:
        """Every place where a model sees a car, before the best are chosen; the image is (h, w) uint8."""
        height, width = grey.shape
        most = self.most_height or max(height, width / model.region_aspect) * (1.0 + 2.0 * self.margin)
        window = model.descriptor
        regions, scores = [np.empty((0, 4), np.float32)], [np.empty(0, np.float32)]
        # A score that is worth the threshold; what is below need not be kept.
        slope, offset = model.calibration
        enough = (math.log(self.threshold / (1.0 - self.threshold)) - offset) / slope
        least = self.least_height or window.height / _ZOOM
        n_sizes = 1 + int(math.log(max(most / least, 1.0)) / math.log(self.scale_step) + 1e-9)
        smaller: Image | None = None
        for size in range(n_sizes):
            region_height = least * self.scale_step**size
            region_width = region_height * model.region_aspect
            edge_x, edge_y = (math.ceil(self.margin * r) for r in (region_width, region_height))
            if region_width > width + 2 * edge_x or region_height > height + 2 * edge_y:
                break
            scale_x, scale_y = window.width / region_width, window.height / region_height
            scaled = _scaled(grey if smaller is None else smaller, (width * scale_x, height * scale_y))
            if scale_x <= 1.0 and scale_y <= 1.0:
                smaller = scaled
            score = correlate(
                window.features(_bordered(scaled, edge_x * scale_x, edge_y * scale_y)), model.weights
            )
            row, column = np.nonzero(score > enough - model.bias)
            scores.append(score[row, column] + np.float32(model.bias))
            left, top = column * CELL / scale_x - edge_x, row * CELL / scale_y - edge_y
            regions.append(
                np.stack([left, top, left + region_width, top + region_height], axis=1).astype(np.float32)
            )
        region, value = np.concatenate(regions), np.concatenate(scores)
        size_xy = region[:, 2:] - region[:, :2]
        left_top, right_bottom = np.array(model.car[:2]), np.array(model.car[2:])
        boxes = np.concatenate(
            [region[:, :2] + left_top * size_xy, region[:, :2] + right_bottom * size_xy], axis=1
        )
        ends = np.full(len(value), model.ends)
        return Detections(boxes.astype(np.float32), value, model.probability(value), ends, region)


def as_grey(image: Image) -> Image:
    """The image as (h, w) uint8.

    Raises:
        InputError: neither (h, w) nor (h, w, 3), not uint8, or without a pixel.
    """
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise InputError(f"image is {image.shape} of {image.dtype}, want (h, w) or (h, w, 3) uint8")
    if image.size == 0:
        raise InputError(f"image is {image.shape}, want at least one pixel")
    return (
        np.ascontiguousarray(image)
        if image.ndim == 2
        else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    )


def best_boxes(boxes: Float32Array, value: Float32Array, overlap: float) -> NDArray[np.int64]:
    """Which boxes to keep, best first: none that overlaps a better one by more than `overlap`.

    Args:
        boxes: (n, 4) left, top, right, bottom.
        value: (n,) how good each is.
        overlap: share, intersection over union.
    """
    order = np.argsort(-value, kind="stable")[:_MOST_WINDOWS]
    area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    kept = []
    while len(order):
        best, rest = order[0], order[1:]
        kept.append(best)
        inner = np.minimum(boxes[best, 2:], boxes[rest, 2:]) - np.maximum(boxes[best, :2], boxes[rest, :2])
        common = np.clip(inner, 0.0, None).prod(axis=1)
        order = rest[common <= overlap * (area[best] + area[rest] - common)]
    return np.array(kept, dtype=np.int64)


def _scaled(image: Image, size: tuple[float, float]) -> Image:
    """An image at another size, width and height in px.

    A pyramid's next level is made from the one before: a step is small enough for linear interpolation, which is many
    times as fast as averaging the whole image anew.
    """
    width, height = (max(1, round(s)) for s in size)
    far = image.shape[1] > 1.6 * width or image.shape[0] > 1.6 * height
    return np.asarray(
        cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if far else cv2.INTER_LINEAR)
    )


def _bordered(level: Image, x: float, y: float) -> Image:
    """A level with its border carried on, px; before scaling it would cost more and be the same."""
    left, top = round(x), round(y)
    return np.asarray(cv2.copyMakeBorder(level, top, top, left, left, cv2.BORDER_REPLICATE))
