"""Where a car stands in the window of a detector: the regions around boxes."""

from __future__ import annotations

import numpy as np

from parkenv.compiled.arrays import FloatArray

SIDE_CAR = (0.08, 0.22, 0.92, 0.885)
"""Left, top, right, bottom of the car in a side view's region, as fractions; as in UIUC's crops."""
SIDE_ASPECT = 2.5
END_CAR = (0.08, 0.12, 0.92, 0.92)  # the same for a front or rear view
END_ASPECT = 1.0
END_WIDEST = 2.0
"""Width over height of a box above which no long lens shows a car's whole front or rear in it."""


def region_of(box: FloatArray, car: tuple[float, float, float, float], aspect: float) -> FloatArray:
    """Return the image region of a window that is aligned to a car's box.

    Args:
        box: (4,) px, left, top, right, bottom of the car.
        car: left, top, right, bottom of the car in the window, as fractions.
        aspect: width over height of the window.
    """
    width = (box[2] - box[0]) / (car[2] - car[0])
    height = width / aspect
    left = box[0] - car[0] * width
    top = box[3] - car[3] * height
    return np.array([left, top, left + width, top + height])
