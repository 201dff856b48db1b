"""Scores of a detector on labelled photographs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from parkenv.compiled.arrays import Image
from parkenv.errors import InputError
from parkenv.perception.car_model import CarModel
from parkenv.perception.car_regions import END_WIDEST
from parkenv.perception.detector import Detections, Detector
from parkenv.perception.hog_detector import HogDetector
from parkenv.perception.lab.car_datasets import UIUC_SIZE, UIUC_TESTS, Crops, LabelledImage, read_uiuc_test
from parkenv.perception.lab.cross_validation import BLOCKS, scores_of
from parkenv.perception.lab.detection_scores import RecallPrecision, recall_precision
from parkenv.show.figures.picture_files import STYLE, save_picture

_SMALLEST = {"single": 0.85, "multi": 0.8}
_LARGEST = {"single": 1.2, "multi": 2.6}
"""Range of searched sizes relative to UIUC's 100×40 box; all cars of the single-scale set have the same size, those of
the multi-scale set are 0.89 to 2.12 times as large."""
_TOLERANCE = 1.25  # of these sizes, for detectors
_CROP_RATES = (0.01, 0.1)  # of false positives
_CROP_MIDDLE, _CROP_WIDTH = 0.19, 0.45
"""Farthest a box's centre may be from its crop's, and least width, as fractions of the crop's sides."""


@dataclass(frozen=True, eq=False)
class TestSetScore:
    """Result on one test set: its row in `summary.json` and its curve."""

    row: dict[str, Any]
    curve: RecallPrecision


def score_on_uiuc(
    model: CarModel | Detector, folder: Path, *, on_image: Callable[[], None] = lambda: None
) -> list[TestSetScore]:
    """Measure recall and precision on the UIUC test sets in a folder.

    Args:
        model: a side model, or any detector.
        folder: the published folder `CarData`.
        on_image: called after every image.

    Raises:
        InputError: no test set, or a damaged one.
    """
    sets = [name for name, (_, truth) in UIUC_TESTS.items() if (folder / truth).is_file()] or ["single"]
    return [score_on(model, read_uiuc_test(folder, name), name, on_image=on_image) for name in sets]


def score_on(
    model: CarModel | Detector,
    images: Sequence[LabelledImage],
    test_set: str,
    *,
    on_image: Callable[[], None] = lambda: None,
) -> TestSetScore:
    """Measure recall and precision on labelled images, by UIUC's matching rule.

    A model's windows are searched at the sizes of the set's cars. A detector looks as it does anywhere; its boxes of
    other sizes, and of fronts and rears, are left out, as the sets label neither. A box more than twice as wide as high
    is a side.
    """
    detector = _searching(model, test_set) if isinstance(model, CarModel) else model
    found, begun = [], time.perf_counter()
    for labelled in images:
        seen = detector.detect(labelled.image)
        found.append(seen if isinstance(model, CarModel) else _of_the_set(seen, test_set))
        on_image()
    seconds = time.perf_counter() - begun
    curve = recall_precision(
        [f.regions for f in found],
        [f.score for f in found],
        [i.boxes for i in images],
        scales=test_set == "multi",
    )
    _, recall, precision = curve.at_equal_error() if len(curve.recall) else (0.0, 0.0, 0.0)
    row = {
        "test_set": test_set,
        "images": len(images),
        "cars": sum(len(i.boxes) for i in images),
        "eer": curve.equal_error,
        "average_precision": curve.average_precision,
        "recall": recall,
        "precision": precision,
        "frames_per_s": len(images) / seconds,
    }
    return TestSetScore(row, curve)


def _of_the_set(found: Detections, test_set: str) -> Detections:
    width = (found.regions[:, 2] - found.regions[:, 0]) / UIUC_SIZE[0]
    least, most = _SMALLEST[test_set] / _TOLERANCE, _LARGEST[test_set] * _TOLERANCE
    size = found.boxes[:, 2:] - found.boxes[:, :2]
    side = ~found.end_on | (size[:, 0] > END_WIDEST * size[:, 1])
    return found.select(side & (width >= least) & (width <= most))


def _searching(model: CarModel, test_set: str) -> HogDetector:
    height = UIUC_SIZE[1]
    return HogDetector.for_evaluation(model, _SMALLEST[test_set] * height, _LARGEST[test_set] * height)


def recall_on_crops(
    model: CarModel | Detector, crops: Crops, *, on_image: Callable[[], None] = lambda: None
) -> list[dict[str, Any]]:
    """Measure the fraction of crops of cars that are found at some rates of false positives, with 95 % intervals.

    A crop's score is a model's of its window, or a detector's greatest probability of a box in the crop's middle, at
    least 0.45 times as wide. Consecutive crops often show the same car: the intervals are over blocks of them.

    Raises:
        InputError: fewer crops of cars than blocks.
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
        return scores_of(model, images)
    scores = []
    for image in images:
        found, size = model.detect(image), np.array(image.shape[1::-1])
        off = np.abs(0.5 * (found.boxes[:, :2] + found.boxes[:, 2:]) / size - 0.5).max(axis=1)
        wide = (found.boxes[:, 2] - found.boxes[:, 0]) / size[0]
        scores.append(found.probability[(off < _CROP_MIDDLE) & (wide > _CROP_WIDTH)].max(initial=0.0))
        on_image()
    return np.array(scores, dtype=np.float64)


def save_curves(scores: Sequence[TestSetScore], title: str, path: Path) -> None:
    """Plot recall against 1 - precision, as in the papers on these data sets."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.4, 4.4))
        ax = figure.subplots()
        for score in scores:
            label = f"{score.row['test_set']}-scale: equal error at {score.row['eer']:.1%}"
            ax.plot(1.0 - score.curve.precision, score.curve.recall, label=label)
        ax.plot([0.0, 1.0], [1.0, 0.0], color="0.7", linewidth=0.8, linestyle=":")
        ax.set(xlim=(0.0, 0.3), ylim=(0.7, 1.005), xlabel="1 - precision", ylabel="recall", title=title)
        ax.legend(loc="lower right")
        figure.tight_layout()
        save_picture(figure, path)
