"""Decode what networks of the YOLO and DETR kinds put out, and our own: boxes and P(car), in pixels of the input."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import special

from parkenv.compiled.arrays import Float32Array
from parkenv.errors import InputError

Layout = Literal["yolo", "yolo5", "boxes", "detr", "centers"]
Scores = Literal["probabilities", "logits", "softmax"]


class LayoutRule(NamedTuple):
    """What a layout is, and the settings that networks of it usually have."""

    wants: str  # its outputs, for messages
    before: int = 0  # numbers of a candidate before its class scores
    resize: Literal["letterbox", "stretch"] = "letterbox"
    box: Literal["center", "corners"] = "center"
    unit: Literal["pixels", "fractions"] = "pixels"
    overlap: float = 0.5
    mean: tuple[float, ...] = (0.0,)  # of three channels
    std: tuple[float, ...] = (255.0,)


LAYOUTS: dict[Layout, LayoutRule] = {
    "yolo": LayoutRule("one output (1, 4 + classes, n)", before=4),
    "yolo5": LayoutRule("one output (1, n, 5 + classes)", before=5),
    "boxes": LayoutRule("one output (1, n, 6)", box="corners", overlap=1.0),
    "detr": LayoutRule(
        "scores (1, n, classes) and boxes (1, n, 4)", resize="stretch", unit="fractions",
        mean=(123.675, 116.28, 103.53), std=(58.395, 57.12, 57.375),
    ),
    "centers": LayoutRule("one output (1, 9, rows, columns)", box="corners"),
}  # fmt: skip
BOXES_MOST = 1_000  # most rows of a network that suppresses non-maxima itself
_STRIDES = (8, 16, 32, 64)
_CENTER_NUMBERS = 9


def guess_layout(shapes: Sequence[tuple[int, ...]], size: tuple[int, int]) -> Layout | None:
    """Return the layout that outputs of these shapes can only have; None where they could have several.

    Networks of the YOLO kind have a row (three before version 8) for every cell of grids of 8, 16, 32 and sometimes 64
    pixels over the input.

    Args:
        shapes: shape of each output.
        size: width and height of the input, px.

    Examples:
        >>> guess_layout([(1, 84, 8400)], (640, 640)), guess_layout([(1, 25200, 85)], (640, 640))
        ('yolo', 'yolo5')
        >>> guess_layout([(1, 300, 6)], (640, 640)), guess_layout([(1, 100, 92), (1, 100, 4)], (800, 800))
        ('boxes', 'detr')
    """
    if len(shapes) == 1 and _is_centers(shapes[0]):
        return "centers"
    if any(len(shape) != 3 or shape[0] != 1 for shape in shapes):
        return None
    if len(shapes) == 2:
        (_, n, a), (_, m, b) = shapes
        return "detr" if n == m and (a == 4) != (b == 4) else None
    if len(shapes) != 1:
        return None
    _, rows, columns = shapes[0]
    cells = [math.ceil(size[0] / s) * math.ceil(size[1] / s) for s in _STRIDES]
    grids = (sum(cells[:3]), sum(cells))
    if columns in grids and rows > 4:
        return "yolo"
    if columns > 5 and rows in [3 * n for n in grids]:
        return "yolo5"
    if columns == 6 and rows <= BOXES_MOST and rows not in grids:
        return "boxes"
    return None


def class_columns(layout: Layout, shapes: Sequence[tuple[int, ...]], grid: bool) -> int | None:
    """Return the number of class scores of a row; None for `boxes`, which has the winning class, and `centers`.

    Args:
        layout: the layout.
        shapes: shape of each output.
        grid: for `yolo`, whether a candidate is a column (1, 4 + classes, n), not a row.

    Raises:
        InputError: the layout does not fit the shapes; the message says what it wants.
    """
    rule = LAYOUTS[layout]
    if layout == "centers":
        fits, classes = len(shapes) == 1 and _is_centers(shapes[0]), None
    elif layout == "detr":
        fits = len(shapes) == 2 and shapes[0][:2] == shapes[1][:2] and shapes[1][2:] == (4,)
        classes = shapes[0][-1]
    else:
        width = shapes[0][1 if layout == "yolo" and grid else -1]
        fits = len(shapes) == 1 and (width == 6 if layout == "boxes" else width > rule.before)
        classes = None if layout == "boxes" else width - rule.before
    if layout != "centers":
        fits = fits and all(len(shape) == 3 and shape[0] == 1 for shape in shapes)
    if not fits:
        raise InputError(f"want {rule.wants}")
    return classes


def decode(
    outputs: Sequence[Float32Array], layout: Layout, cars: Sequence[int], scores: Scores, *, grid: bool
) -> tuple[Float32Array, Float32Array]:
    """Return the boxes, (n, 4) as the network gives them, and P(car) of each, (n,).

    P(car) is the greatest score of the classes that are cars; of `yolo5` times the objectness.

    Args:
        outputs: the outputs; of `detr` the scores first.
        layout: their layout.
        cars: the classes that are cars.
        scores: what the scores are.
        grid: for `yolo`, whether a candidate is a column.
    """
    if layout == "boxes":
        rows = outputs[0][0]
        is_car = np.isin(np.rint(rows[:, 5]), cars)
        return rows[:, :4], np.where(is_car, _probability(rows[:, 4:5], scores)[:, 0], np.float32(0.0))
    chosen = list(cars)
    if layout == "detr":
        return outputs[1][0], _probability(outputs[0][0], scores)[:, chosen].max(axis=1)
    rows = outputs[0][0].T if layout == "yolo" and grid else outputs[0][0]
    if layout == "yolo":
        return rows[:, :4], _probability(rows[:, 4:], scores)[:, chosen].max(axis=1)
    objectness = _probability(rows[:, 4:5], "logits" if scores == "logits" else "probabilities")[:, 0]
    return rows[:, :4], objectness * _probability(rows[:, 5:], scores)[:, chosen].max(axis=1)


class Centers(NamedTuple):
    """The cars that a network of the layout `centers` sees."""

    boxes: Float32Array  # (n, 4) px of the input: left, top, right, bottom
    score: Float32Array  # (n,) P(car)
    end_on: NDArray[np.bool_]  # (n,) whether a front or rear is more likely than a side
    view: NDArray[np.int8]  # (n,) the most likely `sim_sensors.ground_truth.View`
    visible: Float32Array  # (n,) visible fraction


def decode_centers(output: Float32Array, size: tuple[int, int], threshold: float) -> Centers:
    """Return the cells that score higher than their neighbours.

    Args:
        output: (1, 9, rows, columns): P(car), the box's sides from the cell's centre in px, P(end), P(oblique) and
            P(side) of the view, visible fraction.
        size: width and height of the input, px.
        threshold: least P(car).
    """
    cells = output[0]
    # Above the cells before it and not below those after it: of equal neighbours one is left.
    before = np.ones((3, 3), np.uint8)
    before[1, 1:] = before[2] = 0
    after = np.ascontiguousarray(before[::-1, ::-1])
    score = np.ascontiguousarray(cells[0])
    top = (score > _highest(score, before)) & (score >= _highest(score, after))
    row, column = np.nonzero(top & (score >= threshold))
    left, above, right, below, end, oblique, side, visible = cells[1:, row, column]
    x = (column + np.float32(0.5)) * np.float32(size[0] / score.shape[1])
    y = (row + np.float32(0.5)) * np.float32(size[1] / score.shape[0])
    boxes = np.stack([x - left, y - above, x + right, y + below], axis=1).astype(np.float32)
    view = np.argmax([end, oblique, side], axis=0).astype(np.int8)
    return Centers(boxes, score[row, column], end > side, view, visible)


def mirrored_centers(output: Float32Array) -> Float32Array:
    """Return what a network of the layout `centers` would put out for the mirrored input: left and right exchanged."""
    return output[:, [0, 3, 2, 1, *range(4, _CENTER_NUMBERS)], :, ::-1]


def _highest(score: Float32Array, neighbours: NDArray[np.uint8]) -> Float32Array:
    highest = cv2.dilate(score, neighbours, borderType=cv2.BORDER_CONSTANT, borderValue=-1.0)
    return np.asarray(highest, dtype=np.float32)


def _is_centers(shape: tuple[int, ...]) -> bool:
    return len(shape) == 4 and shape[:2] == (1, _CENTER_NUMBERS)


def _probability(values: Float32Array, scores: Scores) -> Float32Array:
    if scores == "logits":
        return np.asarray(special.expit(values))
    return np.asarray(special.softmax(values, axis=1)) if scores == "softmax" else values
