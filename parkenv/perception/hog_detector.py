"""The HOG detector of the thesis: a linear classifier scores sliding windows over an image pyramid.

T §3.2.1 and §3.2.2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array, FloatArray, Image
from parkenv.compiled.threads import in_threads
from parkenv.errors import InputError, require_number
from parkenv.perception.car_model import PACKAGED_MODELS, CarModel
from parkenv.perception.detector import Detections, DetectorErrors, GroundBand
from parkenv.perception.hog import CELL, Descriptor, correlate

END_BELOW = 1.8  # width over height of a box below which it shows a front or rear
END_WIDEST = 2.0  # width over height of a box that is too wide for the whole front or rear of a car
# Least probability of a detection that counts in an evaluation: curves go on to many false positives.
LEAST_SCORED = 0.002
_ZOOM = 1.6
_MOST_WINDOWS = 2000  # only the best are kept; a useful model does not report more


class CarWindow(NamedTuple):
    """The window of a HOG model, in which a car always stands at the same place."""

    car: tuple[float, float, float, float]  # left, top, right, bottom of the car, as fractions of the window
    aspect: float  # width over height of the image region that is resized to the window
    size: tuple[int, int]  # width and height of the window, px

    def region(self, box: FloatArray) -> FloatArray:
        """Return the image region of a window that is aligned to a car's box: (4,) px, left, top, right, bottom."""
        width = (box[2] - box[0]) / (self.car[2] - self.car[0])
        height = width / self.aspect
        left = box[0] - self.car[0] * width
        top = box[3] - self.car[3] * height
        return np.array([left, top, left + width, top + height])


SIDE = CarWindow((0.08, 0.22, 0.92, 0.885), 2.5, (128, 64))  # a car from its side, as in UIUC's crops
END = CarWindow((0.08, 0.12, 0.92, 0.92), 1.0, (128, 128))  # a front or rear


@dataclass(frozen=True, eq=False)
class HogDetector:
    """A `Detector` that slides the windows of one or more models over an image pyramid.

    Args:
        models: the packaged side and front models, or others.
        least_height: px, height of the smallest regions searched; None: five eighths of each model's window, because
            smaller cars show little detail when enlarged, and cost the most time.
        most_height: px, height of the largest regions; None: as large as the image and its margin allow.
        scale_step: ratio of one region size to the next smaller one.
        threshold: probability from which a window is reported as a car.
        overlap: intersection over union from which only the better of two boxes is kept.
        inside: fraction of the smaller of two boxes from which only the better one is kept, because one shows a part of
            the other's car. 1: they are two cars, as where rows of cars hide one another.
        margin: cars may reach beyond the image by this fraction of their region; the border pixels are replicated.

    Raises:
        InputError: no model, or a number outside its range.
    """

    models: tuple[CarModel, ...]
    least_height: float | None = None
    most_height: float | None = None
    scale_step: float = 1.2
    threshold: float = 0.5
    overlap: float = 0.4
    inside: float = 1.0
    margin: float = 0.25

    concurrent: ClassVar[bool] = True
    errors: ClassVar[DetectorErrors] = DetectorErrors(
        0.2, 0.6, (0.0, -0.26, 0.0, 0.0), (0.08, 0.12, 0.08, 0.065)
    )
    """As measured in simulated drives; its windows reach above the roof."""

    def __post_init__(self) -> None:
        if not self.models:
            raise InputError("models is empty, want at least one")
        if self.least_height is not None:
            require_number("least_height", self.least_height, least=8.0, finite=False)
        if self.most_height is not None:
            require_number("most_height", self.most_height, least=self.least_height or 8.0, finite=False)
        require_number("scale_step", self.scale_step, above=1.0, finite=False)
        for name in ("threshold", "overlap"):
            require_number(name, getattr(self, name), above=0.0, below=1.0)
        for name in ("inside", "margin"):
            require_number(name, getattr(self, name), least=0.0, most=1.0)

    @classmethod
    def load(
        cls, *names: str | Path, threshold: float = 0.5, least_height: float | None = None
    ) -> HogDetector:
        """Load packaged models or model files; both packaged models if none is named."""
        models = tuple(CarModel.load(name) for name in names or PACKAGED_MODELS)
        return cls(models, least_height=least_height, threshold=threshold)

    @classmethod
    def for_evaluation(cls, model: CarModel, least_height: float, most_height: float) -> HogDetector:
        """Search regions of these heights, px, in small steps, for cars that stand apart, also weak ones."""
        return cls(
            (model,), least_height=least_height, most_height=most_height,
            scale_step=1.05, threshold=LEAST_SCORED, overlap=0.3, inside=0.6, margin=0.35,
        )  # fmt: skip

    def detect(self, image: Image) -> Detections:
        """Find the cars in an image, best first.

        Args:
            image: (h, w) grey or (h, w, 3) RGB, uint8.

        Raises:
            InputError: an image of another shape or dtype.
        """
        return self.detect_on_ground(image, None)

    def detect_on_ground(self, image: Image, band: GroundBand | None) -> Detections:
        """Find the cars whose boxes lie in a band; the rows of the image that cannot have one are not looked at."""
        grey = as_grey(image)
        of_each = in_threads(lambda model: self.scan(model, grey, band), self.models)
        all_models = Detections(
            *(
                np.concatenate([getattr(f, name) for f in of_each])
                for name in ("boxes", "probability", "end_on", "score", "regions")
            )
        )
        return all_models.select(
            best_boxes(all_models.boxes, all_models.probability, self.overlap, self.inside)
        )

    def scan(self, model: CarModel, grey: Image, band: GroundBand | None = None) -> Detections:
        """Return all windows above the threshold, before non-maximum suppression."""
        height, width = grey.shape
        most = self.most_height or max(height, width / model.region_aspect) * (1.0 + 2.0 * self.margin)
        window = model.descriptor
        regions, scores = [np.empty((0, 4), np.float32)], [np.empty(0, np.float32)]
        # The score at the threshold; lower ones are dropped.
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
            beside, above = round(edge_x * scale_x), round(edge_y * scale_y)
            level = np.asarray(cv2.copyMakeBorder(scaled, above, above, beside, beside, cv2.BORDER_REPLICATE))
            first, end = 0, level.shape[0] // CELL
            if band is not None:
                tops = (np.array(_region_tops(model, region_height, band)) + edge_y) * (scale_y / CELL)
                first = max(math.ceil(tops[0]), 0)
                end = min(math.floor(tops[1]) + window.height // CELL, end)
                if end - first < window.height // CELL:
                    continue
            score = correlate(_features_of_rows(window, level, first, end), model.weights)
            row, column = np.nonzero(score > enough - model.bias)
            scores.append(score[row, column] + np.float32(model.bias))
            row += first
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
        return Detections(boxes, model.probability(value), np.full(len(value), model.end_on), value, region)


def _region_tops(model: CarModel, region_height: float, band: GroundBand) -> tuple[float, float]:
    _, top, _, bottom = model.car
    height = (bottom - top) * region_height
    below = band.horizon - bottom * region_height
    return below + band.least * height, below + band.most * height


def _features_of_rows(window: Descriptor, level: Image, first: int, end: int) -> Float32Array:
    # The features of a cell depend on the next cells, and their histograms on the pixels of those after them.
    start, stop = max(first - 2, 0), min(end + 2, level.shape[0] // CELL)
    whole = window.features(level[CELL * start : CELL * stop if stop < level.shape[0] // CELL else None])
    return whole[first - start : first - start + (end - first) + window.shape[0] - window.height // CELL]


def as_grey(image: Image) -> Image:
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise InputError(f"image is {image.shape} of {image.dtype}, want (h, w) or (h, w, 3) uint8")
    if image.size == 0:
        raise InputError(f"image is {image.shape}, want at least one pixel")
    return (
        np.ascontiguousarray(image)
        if image.ndim == 2
        else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    )


def best_boxes(
    boxes: Float32Array, value: Float32Array, overlap: float, inside: float = 1.0
) -> NDArray[np.int64]:
    """Suppress non-maxima: return the rows of the boxes that no better box claims for its own car, best first.

    A box that is much smaller or larger than a better one has little of its union in common with it: a wheel in a car
    counts as another car by `overlap` (intersection over union), but not by `inside` (over the area of the smaller).
    """
    order = np.argsort(-value, kind="stable")[:_MOST_WINDOWS]
    area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    kept = []
    while len(order):
        best, rest = order[0], order[1:]
        kept.append(best)
        inner = np.minimum(boxes[best, 2:], boxes[rest, 2:]) - np.maximum(boxes[best, :2], boxes[rest, :2])
        common = np.clip(inner, 0.0, None).prod(axis=1)
        apart = common <= overlap * (area[best] + area[rest] - common)
        order = rest[apart & (common <= inside * np.minimum(area[best], area[rest]))]
    return np.array(kept, dtype=np.int64)


def _scaled(image: Image, size: tuple[float, float]) -> Image:
    """Resize an image to (width, height) px.

    Each level of a pyramid is made from the level before: one step is small enough for linear interpolation, which is
    many times as fast as area averaging of the whole image.
    """
    width, height = (max(1, round(s)) for s in size)
    far = image.shape[1] > 1.6 * width or image.shape[0] > 1.6 * height
    return np.asarray(
        cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if far else cv2.INTER_LINEAR)
    )
