"""Fit a car's rectangle to the end points of laser beams."""

import math
from typing import NamedTuple

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled
from parkenv.errors import InputError

CAR_LENGTH, CAR_WIDTH = 4.4, 1.8  # assumed length and width, m, of sides that are not visible
LONG_SIDE = 2.3  # length, m, from which a side is a flank: no car is this wide
_SIDE_SEEN = 0.6  # m, visible length from which a side counts as seen
_NEAREST = 0.02  # m; points closer to a side than this all count the same
_CUT = 0.1  # m; an end of the run this close to a side counts as on it
_STEPS = 90


class FittedCar(NamedTuple):
    """A car's rectangle, m."""

    x: float  # its centre
    y: float
    yaw: float  # rad, along the car, in [0, π): beams do not distinguish front and rear
    length: float  # at least that of a typical car, as the width
    width: float
    seen_length: float  # visible part of a side and of an end; near 0 for a side that is not visible
    seen_width: float


def fit_box(
    points: FloatArray, sensor: FloatArray, *, end_on: bool, cut: tuple[bool, bool] = (False, False)
) -> FittedCar:
    """Fit a car to points on its sides.

    The direction is that of the rectangle closest to the points, by the closeness criterion of Zhang et al.
    ("Efficient L-shape fitting for vehicle detection using laser scanners", IV 2017). A side longer than the width of
    any car is a flank; without one, `end_on` distinguishes front and flank. Partly visible sides are extended to a
    car's usual size, away from the sensor or beyond the point where the view is cut.

    Points, (k, 2) m, are in order of direction; `cut` says whether the car continues unseen before the first and after
    the last one.

    Examples:
        >>> front = np.stack([np.linspace(-0.9, 0.9, 30), np.full(30, 4.0)], axis=1)
        >>> car = fit_box(front, np.zeros(2), end_on=True)
        >>> round(car.x, 6), round(car.y, 6), round(math.degrees(car.yaw)), round(car.seen_width, 6)
        (0.0, 6.2, 90, 1.8)
    """
    if points.ndim != 2 or points.shape[1] != 2 or not len(points) or not np.isfinite(points).all():
        raise InputError(f"points have shape {points.shape}, want (at least 1, 2) finite numbers")
    theta = direction_of(points)
    axis = np.array([[math.cos(theta), math.sin(theta)], [-math.sin(theta), math.cos(theta)]])
    local, seen_from = points @ axis.T, axis @ sensor
    low, high = local.min(axis=0), local.max(axis=0)
    extent = high - low
    sight = np.abs(0.5 * (low + high) - seen_from)
    along = int((extent if extent.max() > LONG_SIDE else sight if end_on else -sight).argmax())
    size = np.maximum(np.where(np.arange(2) == along, CAR_LENGTH, CAR_WIDTH), extent)
    anchor = np.zeros(2)  # -1: the low side is a true side of the car, 1: the high side, 0: undecided
    for i in (0, 1):
        anchor[i] = -1.0 if seen_from[i] < low[i] else 1.0 if seen_from[i] > high[i] else 0.0
        # Whether the low or the high side is only where the view ends.
        low_cut = any(c and local[k, i] - low[i] < _CUT for k, c in zip((0, -1), cut, strict=True))
        high_cut = any(c and high[i] - local[k, i] < _CUT for k, c in zip((0, -1), cut, strict=True))
        if low_cut != high_cut and extent[i] > _SIDE_SEEN:
            anchor[i] = 1.0 if low_cut else -1.0
    middle = 0.5 * (low + high) + anchor * 0.5 * (extent - size)
    x, y = axis.T @ middle
    yaw = (theta + (math.pi / 2 if along == 1 else 0.0)) % math.pi
    sides = np.stack([size, extent])[:, [along, 1 - along]]
    return FittedCar(float(x), float(y), yaw, *sides.ravel().tolist())


def direction_of(points: FloatArray) -> float:
    """Return the direction, rad in [0, π/2), of the rectangle closest to points, (k, 2) m, on its sides."""
    return float(_direction(np.ascontiguousarray(points, dtype=np.float64)))


@compiled
def _direction(points: FloatArray) -> float:
    best, answer = -1.0, 0.0
    for step in range(_STEPS):
        theta = 0.5 * math.pi * step / _STEPS
        c, s = math.cos(theta), math.sin(theta)
        low1 = low2 = math.inf
        high1 = high2 = -math.inf
        for k in range(len(points)):
            a = c * points[k, 0] + s * points[k, 1]
            b = c * points[k, 1] - s * points[k, 0]
            low1, high1 = min(low1, a), max(high1, a)
            low2, high2 = min(low2, b), max(high2, b)
        value = 0.0
        for k in range(len(points)):
            a = c * points[k, 0] + s * points[k, 1]
            b = c * points[k, 1] - s * points[k, 0]
            value += 1.0 / max(min(min(a - low1, high1 - a), min(b - low2, high2 - b)), _NEAREST)
        if value > best:
            best, answer = value, theta
    return answer
