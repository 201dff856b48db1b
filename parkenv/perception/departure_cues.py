"""What shows that parked cars are about to leave: lamps that are lit, somebody beside a car, a car that moves."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.perception.monocular import GroundView
from parkenv.perception.pipeline import PerceptionResult
from parkenv.world.lot import Mouth, ParkingLot

WEIGHTS = {"picture": -0.26, "red": 1.33, "white": 1.04, "both": 1.72, "moved": 2.98, "person": 0.6}
"""Weights of the features of the car in a slot: whether a picture shows its outer end, how bright red and white light
is there, and the less bright of both; how far it has moved out since the scan before, m; and a person-sized thing
beside it. By `tests/builders/departure_cues.py fit`."""
BIAS = -0.05

_LAMPS_M = (0.35, 1.25)  # heights above ground, between which lamps are
_RED, _WHITE = (200, 225), (230, 245)  # range of light that may be that of a lamp
_LEAST_HUE = 40  # by which red exceeds green and blue
_LEAST_PIXELS, _LEAST_BEAMS = 30, 3
_LIT_PIXELS, _LIT_SHARE = 6, 0.003  # that a lamp has of the end of a car
_SHOWN = 0.25  # fraction of the end of a car that a picture must show
_OVERHANG_M, _PERSON_M = 0.4, 0.9


# Image, its projection, and x, y in m and yaw in rad of its camera in the world.
_Picture = tuple[NDArray[np.uint8], GroundView, float, float, float]


class DepartureCues:
    """What pictures and scans show of parked cars, as evidence that they are about to leave.

    Args:
        lot: the lot with the slots.
    """

    def __init__(self, lot: ParkingLot) -> None:
        self._mouth = lot.mouth_xy()
        way = self._mouth - lot.slot_xy
        half = np.hypot(*way.T)
        self._out, self._depth = way / half[:, None], 2.0 * half
        self._side = np.column_stack([-self._out[:, 1], self._out[:, 0]])
        self._at_kerb = lot.slot_mouth != Mouth.REAR
        self._half_width = 0.5 * np.where(self._at_kerb, lot.slot_length, lot.slot_width)

    def features(self, newest: Sequence[PerceptionResult], slots: IntArray) -> FloatArray:
        """Return the features of cars in slots, (k, n) as in `WEIGHTS`, from one or two captures, oldest first."""
        scans = [_points(result) for result in newest]
        # What the newest capture does not show, the one before may.
        pictures: list[_Picture] = [
            (view.image, GroundView(view.camera, view.mount), *view.mount.in_world(result.vehicle))
            for result in newest[::-1]
            for view in result.views
        ]
        rows = np.zeros((len(slots), len(WEIGHTS)))
        for row, slot in zip(rows, slots.tolist(), strict=True):
            outs = [self._outline(points, slot) for points in scans]
            out, person = outs[-1]
            if light := self._lights(pictures, slot, 0.0 if math.isnan(out) else out):
                row[:4] = 1.0, *light, min(light)
            if out > _OVERHANG_M:
                row[4] = np.clip(np.nan_to_num(out - outs[0][0]), 0.0, 1.0)
            row[5] = person
        return rows

    def _outline(self, points: FloatArray, slot: int) -> tuple[float, bool]:
        """Return how far a car stands out of its slot, m, NaN if no beams meet it, and if somebody is beside it."""
        away, wide, deep = points - self._mouth[slot], self._half_width[slot], self._depth[slot]
        ahead, aside = away @ self._out[slot], away @ self._side[slot]
        near, outside = np.abs(aside), (ahead > _OVERHANG_M) & (ahead < deep)
        least = 0.0 if self._at_kerb[slot] else _OVERHANG_M
        beside = (near < wide + 0.4) & (ahead > least) & (ahead < least + 1.6)
        person = beside.sum() > 1 and max(np.ptp(ahead[beside]), np.ptp(aside[beside])) < _PERSON_M
        # What is longer than a car is wide passes by on the aisle.
        passes = (outside & (near > wide + 0.3) & (near < wide + 2.5)).sum() >= _LEAST_BEAMS
        car = ahead[(near < wide - 0.2) & (ahead > -deep) & (ahead < (_OVERHANG_M if passes else deep))]
        return (float(np.sort(car)[-_LEAST_BEAMS]) if len(car) >= _LEAST_BEAMS else math.nan), bool(person)

    def _lights(self, pictures: Sequence[_Picture], slot: int, end: float) -> list[float]:
        """Return how bright red and white light is at the outer end of a car, 0 to 1; nothing without a picture of it.

        At kerbs, walls and paint beside the car look like lamps as often as lamps do.
        """
        out = self._out[slot]
        if self._at_kerb[slot]:
            return []
        corner = np.array([(a, side) for a in (end - 0.8, end + 0.2) for side in (-0.8, 0.8)])
        xy = (
            self._mouth[slot]
            + corner[:, :1] * out
            + corner[:, 1:] * self._half_width[slot] * self._side[slot]
        )
        for image, ground, x, y, yaw in pictures:
            heading = np.array([math.cos(yaw), math.sin(yaw)])
            forward, right = (xy - [x, y]) @ heading, (xy - [x, y]) @ [heading[1], -heading[0]]
            if forward.min() > 0.5 and ([x, y] - self._mouth[slot]) @ out > 0.0:
                corners = [ground.pixels(forward, right, np.full(4, z)) for z in _LAMPS_M]
                pixels = _within(image, np.concatenate(corners))
                if len(pixels) >= _LEAST_PIXELS:
                    return _brightness(pixels)
        return []


def log_likelihood_ratio(features: FloatArray) -> FloatArray:
    """Return log of P(features | about to leave) over P(features | not), (k,), by a logistic model."""
    return np.asarray(features @ np.array(list(WEIGHTS.values())) + BIAS)


def _points(result: PerceptionResult) -> FloatArray:
    met = [scan.points(np.flatnonzero(np.isfinite(scan.distance))) for scan in result.scans]
    return np.concatenate([np.empty((0, 2)), *met])


def _within(image: NDArray[np.uint8], corners: FloatArray) -> NDArray[np.int64]:
    """Return the pixels of an image in the convex hull of points, (k, 3); none if too little of it is in the image."""
    hull = cv2.convexHull(np.round(np.clip(corners, -1e5, 1e5)).astype(np.int32))[:, 0]
    low, high = hull.min(axis=0), hull.max(axis=0) + 1
    first, end = np.maximum(low, 0), np.minimum(high, image.shape[1::-1])
    if (end <= first).any() or np.prod(end - first) < _SHOWN * np.prod((high - low).astype(float)):
        return np.empty((0, 3), np.int64)
    mask = np.zeros((end - first)[::-1], np.uint8)
    cv2.fillConvexPoly(mask, hull - first, 1)
    return image[first[1] : end[1], first[0] : end[0]][mask > 0].astype(np.int64)


def _brightness(pixels: NDArray[np.int64]) -> list[float]:
    red, others, white = pixels[:, 0], pixels[:, 1:].max(axis=1), pixels.min(axis=1)
    few = max(int(_LIT_SHARE * len(pixels)), _LIT_PIXELS)
    lights = (np.where(red - others > _LEAST_HUE, red, 0), *_RED), (white, *_WHITE)
    return [
        min(max((np.partition(light, -few)[-few] - dark) / (lit - dark), 0.0), 1.0)
        for light, dark, lit in lights
    ]
