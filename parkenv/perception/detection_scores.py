"""Scores of a detector on labelled photographs: recall and precision by UIUC's matching rule, and recall on crops."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, Image
from parkenv.errors import InputError
from parkenv.perception.car_datasets import UIUC_SIZE, UIUC_TESTS, Crops, LabelledImage, read_uiuc_test
from parkenv.perception.car_model import CarModel
from parkenv.perception.detector import Detections, Detector
from parkenv.perception.hog_detector import END_WIDEST, HogDetector

# Semi-axes of the ellipse around a true box, as fractions of its width and height (README of the UIUC set).
REACH = 0.25
# Number of blocks of consecutive crops; images of the same car are neighbours and should share a block.
BLOCKS = 30
# Range of searched sizes relative to UIUC's 100×40 box; all cars of the single-scale set have the same size, those of
# the multi-scale set are 0.89 to 2.12 times as large.
_SIZES = {"single": (0.85, 1.2), "multi": (0.8, 2.6)}
_TOLERANCE = 1.25  # of these sizes, for detectors
_CROP_RATES = (0.01, 0.1)  # of false positives
# Farthest a box's centre may be from its crop's, and least width, as fractions of the crop's sides.
_CROP_MIDDLE, _CROP_WIDTH = 0.19, 0.45


@dataclass(frozen=True, eq=False)
class RecallPrecision:
    """A recall-precision curve with one point per threshold, strictest first."""

    recall: FloatArray  # (k,) float64, fraction of the cars that are found
    precision: FloatArray  # (k,) float64, fraction of the detections that are cars

    @property
    def average_precision(self) -> float:
        best = np.maximum.accumulate(self.precision[::-1])[::-1]
        return float(np.sum(np.diff(self.recall, prepend=0.0) * best))

    @property
    def at_equal_error(self) -> tuple[float, float]:
        """Recall and precision at the threshold where the lower of them, the equal-error rate, is largest."""
        if not len(self.recall):
            return 0.0, 0.0
        i = int(np.minimum(self.recall, self.precision).argmax())
        return float(self.recall[i]), float(self.precision[i])


def recall_precision(
    boxes: Sequence[NDArray[np.floating]],
    scores: Sequence[NDArray[np.floating]],
    truth: Sequence[FloatArray],
    *,
    scales: bool = True,
) -> RecallPrecision:
    """Match the detections of each image to its true boxes, best detection first, one per car, and return the curve.

    With `scales` the width counts as a third axis, as in the multi-scale set.
    """
    cars = sum(len(t) for t in truth)
    hits, values = [], []
    for detected, score, true in zip(boxes, scores, truth, strict=True):
        order = np.argsort(-np.asarray(score), kind="stable")
        hits.append(matches(np.asarray(detected, dtype=np.float64)[order], true, scales=scales))
        values.append(np.asarray(score, dtype=np.float64)[order])
    hit, value = np.concatenate(hits), np.concatenate(values)
    order = np.argsort(-value, kind="stable")
    value, right = value[order], np.cumsum(hit[order])
    # Detections with equal scores are accepted or rejected together.
    last = np.flatnonzero(np.diff(value, append=-np.inf) != 0.0)
    return RecallPrecision(right[last] / max(cars, 1), right[last] / (last + 1.0))


def matches(detected: FloatArray, true: FloatArray, *, scales: bool = True) -> NDArray[np.bool_]:
    """Return which detections of an image, (n, 4), best first, match a car that no better one has matched."""
    hit = np.zeros(len(detected), dtype=np.bool_)
    if not len(true):
        return hit
    size = true[:, 2:] - true[:, :2]
    taken = np.zeros(len(true), dtype=np.bool_)
    for i, box in enumerate(detected):
        off = (((box[:2] + box[2:] - true[:, :2] - true[:, 2:]) / 2.0 / (REACH * size)) ** 2).sum(axis=1)
        if scales:
            off += ((box[2] - box[0] - size[:, 0]) / (REACH * size[:, 0])) ** 2
        off[taken] = np.inf
        nearest = int(off.argmin())
        if off[nearest] <= 1.0:
            hit[i] = taken[nearest] = True
    return hit


def score_on_uiuc(
    model: CarModel | Detector, folder: Path, *, on_image: Callable[[], None] = lambda: None
) -> list[dict[str, Any]]:
    """Measure recall and precision of a side model, or any detector, on the test sets in UIUC's folder `CarData`."""
    sets = [name for name, (_, truth) in UIUC_TESTS.items() if (folder / truth).is_file()] or ["single"]
    return [score_on(model, read_uiuc_test(folder, name), name, on_image=on_image) for name in sets]


def score_on(
    model: CarModel | Detector,
    images: Sequence[LabelledImage],
    test_set: str,
    *,
    on_image: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Measure recall and precision on labelled images, by UIUC's matching rule.

    A model's windows are searched at the sizes of the set's cars. A detector works as it does anywhere; its boxes of
    other sizes, and of fronts and rears, are left out, as the sets label neither. A box more than twice as wide as high
    is a side.
    """
    least, most = (size * UIUC_SIZE[1] for size in _SIZES[test_set])
    is_model = isinstance(model, CarModel)
    detector = HogDetector.for_evaluation(model, least, most) if isinstance(model, CarModel) else model
    detected, begun = [], time.perf_counter()
    for labelled in images:
        detections = detector.detect(labelled.image)
        detected.append(detections if is_model else _of_the_set(detections, test_set))
        on_image()
    seconds = time.perf_counter() - begun
    curve = recall_precision(
        [d.regions for d in detected],
        [d.score for d in detected],
        [i.boxes for i in images],
        scales=test_set == "multi",
    )
    recall, precision = curve.at_equal_error
    return {
        "test_set": test_set,
        "images": len(images),
        "cars": sum(len(i.boxes) for i in images),
        "eer": min(recall, precision),
        "average_precision": curve.average_precision,
        "recall": recall,
        "precision": precision,
        "frames_per_s": len(images) / seconds,
    }


def _of_the_set(detections: Detections, test_set: str) -> Detections:
    width = (detections.regions[:, 2] - detections.regions[:, 0]) / UIUC_SIZE[0]
    least, most = _SIZES[test_set]
    size = detections.boxes[:, 2:] - detections.boxes[:, :2]
    side = ~detections.end_on | (size[:, 0] > END_WIDEST * size[:, 1])
    return detections.select(side & (width >= least / _TOLERANCE) & (width <= most * _TOLERANCE))


def recall_on_crops(
    model: CarModel | Detector, crops: Crops, *, on_image: Callable[[], None] = lambda: None
) -> list[dict[str, Any]]:
    """Measure the fraction of crops of cars that are found at some rates of false positives, with 95 % intervals.

    A crop's score is a model's of its window, or a detector's greatest probability of a box in the crop's middle, at
    least 0.45 times as wide. Consecutive crops often show the same car: the intervals are over blocks of them.
    """
    if len(crops.positives) < BLOCKS:
        raise InputError(f"{len(crops.positives)} crops of cars, want at least {BLOCKS}")
    cars, others = (_crop_scores(model, images, on_image) for images in (crops.positives, crops.negatives))
    rows = []
    for rate in _CROP_RATES:
        hit = cars > np.quantile(others, 1.0 - rate, method="higher")
        blocks = [block.mean() for block in np.array_split(hit, BLOCKS)]
        rows.append(
            {
                "false_positives": rate,
                "recall": float(hit.mean()),
                "interval": float(1.96 * np.std(blocks, ddof=1) / math.sqrt(BLOCKS)),
                "cars": len(cars),
                "others": len(others),
            }
        )
    return rows


def _crop_scores(
    model: CarModel | Detector, images: Sequence[Image], on_image: Callable[[], None]
) -> NDArray[np.float64]:
    if isinstance(model, CarModel):
        window = (model.descriptor.width, model.descriptor.height)
        resized = np.stack([cv2.resize(i, window, interpolation=cv2.INTER_LINEAR) for i in images])
        return model.scores(resized).astype(np.float64)
    scores = []
    for image in images:
        detections, size = model.detect(image), np.array(image.shape[1::-1])
        off = np.abs(0.5 * (detections.boxes[:, :2] + detections.boxes[:, 2:]) / size - 0.5).max(axis=1)
        wide = (detections.boxes[:, 2] - detections.boxes[:, 0]) / size[0]
        scores.append(detections.probability[(off < _CROP_MIDDLE) & (wide > _CROP_WIDTH)].max(initial=0.0))
        on_image()
    return np.array(scores, dtype=np.float64)
