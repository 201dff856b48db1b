"""Detection scores: recall and precision by the matching rule of UIUC."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray

REACH = 0.25
"""Semi-axes of the ellipse around a true box, as fractions of its width and height (README of the UIUC set)."""


@dataclass(frozen=True, eq=False)
class RecallPrecision:
    """A recall-precision curve with one point per threshold, strictest first."""

    threshold: FloatArray  # (k,) float64
    recall: FloatArray  # (k,) float64, fraction of the cars that are found
    precision: FloatArray  # (k,) float64, fraction of the detections that are cars

    @property
    def equal_error(self) -> float:
        """Equal-error rate: the largest value that recall and precision both reach at one threshold."""
        if not len(self.recall):
            return 0.0
        return float(np.minimum(self.recall, self.precision).max())

    @property
    def average_precision(self) -> float:
        """Area under the curve, with the best precision at this recall or a higher one."""
        if not len(self.recall):
            return 0.0
        best = np.maximum.accumulate(self.precision[::-1])[::-1]
        return float(np.sum(np.diff(self.recall, prepend=0.0) * best))

    def at_equal_error(self) -> tuple[float, float, float]:
        """Return threshold, recall and precision at the equal-error point."""
        i = int(np.minimum(self.recall, self.precision).argmax())
        return float(self.threshold[i]), float(self.recall[i]), float(self.precision[i])


def recall_precision(
    boxes: Sequence[NDArray[np.floating]],
    scores: Sequence[NDArray[np.floating]],
    truth: Sequence[NDArray[np.floating]],
    *,
    scales: bool = True,
) -> RecallPrecision:
    """Match detections to true boxes, best detection first, one per car, and return the curve.

    Args:
        boxes: for each image, (n, 4) left, top, right, bottom of the detections.
        scores: for each image, (n,) scores of the detections.
        truth: for each image, (m, 4) boxes of the cars.
        scales: whether the width counts as a third axis, as in the multi-scale set.
    """
    cars = sum(len(t) for t in truth)
    hits, values = [], []
    for found, score, true in zip(boxes, scores, truth, strict=True):
        order = np.argsort(-np.asarray(score), kind="stable")
        hits.append(
            matches(
                np.asarray(found, dtype=np.float64)[order], np.asarray(true, dtype=np.float64), scales=scales
            )
        )
        values.append(np.asarray(score, dtype=np.float64)[order])
    hit, value = np.concatenate(hits), np.concatenate(values)
    order = np.argsort(-value, kind="stable")
    value, right = value[order], np.cumsum(hit[order])
    # Detections with equal scores are accepted or rejected together.
    last = (
        np.flatnonzero(np.append(np.diff(value) != 0.0, True)) if len(value) else np.empty(0, dtype=np.int64)
    )
    return RecallPrecision(value[last], right[last] / max(cars, 1), right[last] / (last + 1.0))


def matches(found: FloatArray, true: FloatArray, *, scales: bool = True) -> NDArray[np.bool_]:
    """Return which detections of an image, (n, 4), best first, match a car that no better one has matched."""
    hit = np.zeros(len(found), dtype=np.bool_)
    if not len(true):
        return hit
    size = true[:, 2:] - true[:, :2]
    taken = np.zeros(len(true), dtype=np.bool_)
    for i, box in enumerate(found):
        away = ((box[:2] + box[2:] - true[:, :2] - true[:, 2:]) / 2.0 / (REACH * size)) ** 2
        off = away.sum(axis=1)
        if scales:
            off += ((box[2] - box[0] - size[:, 0]) / (REACH * size[:, 0])) ** 2
        off[taken] = np.inf
        nearest = int(off.argmin())
        if off[nearest] <= 1.0:
            hit[i] = taken[nearest] = True
    return hit


def recall_at(false_positives: float, positive: FloatArray, negative: FloatArray) -> float:
    """Return the fraction of positive scores above the score that this fraction of the negative ones exceeds."""
    limit = np.quantile(negative, 1.0 - false_positives, method="higher")
    return float((positive > limit).mean())
