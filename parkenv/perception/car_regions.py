"""Where a car stands in the window of a detector: the regions around boxes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from parkenv.compiled.arrays import FloatArray

END_BELOW = 1.8
"""Width over height of a box below which it shows a front or rear."""
END_WIDEST = 2.0
"""Width over height of a box above which no long lens shows a car's whole front or rear in it."""


class CarWindow(NamedTuple):
    """The window of a HOG model, in which a car always stands at the same place.

    Attributes:
        car: left, top, right, bottom of the car, as fractions of the window.
        aspect: width over height of the image region that is resized to the window.
        size: width and height of the window, px.
    """

    car: tuple[float, float, float, float]
    aspect: float
    size: tuple[int, int]

    def region(self, box: FloatArray) -> FloatArray:
        """Return the image region of a window that is aligned to a car's box: (4,) px, left, top, right, bottom."""
        width = (box[2] - box[0]) / (self.car[2] - self.car[0])
        height = width / self.aspect
        left = box[0] - self.car[0] * width
        top = box[3] - self.car[3] * height
        return np.array([left, top, left + width, top + height])


SIDE = CarWindow((0.08, 0.22, 0.92, 0.885), 2.5, (128, 64))
"""That of a car seen from its side; as in UIUC's crops."""
END = CarWindow((0.08, 0.12, 0.92, 0.92), 1.0, (128, 128))
"""That of a front or rear."""
