"""Days on a grid of levels and slopes, for exact solutions of searches on days that are hidden."""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.world.occupancy.centred_logits import centred_logits
from parkenv.world.occupancy.day_error import DayError, nearness

LEVELS, SLOPES = 13, 7  # numbers of levels and slopes of the grid, from -3.6 to 3.6 standard deviations
_MOST_DEVIATIONS = 3.6


class Days(NamedTuple):
    """Days that a search may meet; slots are independent given the day."""

    chance: FloatArray  # (k,) float64, probability of each day
    p_free: FloatArray  # (n_slots, k) float64, P(free) of each slot on each day

    @classmethod
    def of(cls, p_occupied: FloatArray, walk: FloatArray, day_error: DayError) -> Self:
        """Return the days of a forecast, (n_slots,); one day if they do not differ. `walk` orders the slots."""
        near = nearness(walk)
        if not day_error:
            return cls(np.ones(1), 1.0 - p_occupied[:, None])
        (levels, level_chance), (slopes, slope_chance) = (
            _grid(deviation, count)
            for deviation, count in ((day_error.level, LEVELS), (day_error.slope, SLOPES))
        )
        shift = (levels + near[:, None, None] * slopes[:, None]).reshape(len(near), -1)
        centre = centred_logits(p_occupied, day_error.deviations(near))[:, None]
        return cls(np.outer(slope_chance, level_chance).ravel(), 1.0 / (1.0 + np.exp(centre + shift)))


def _grid(deviation: float, count: int) -> tuple[FloatArray, FloatArray]:
    """Return values of a normal distribution around 0 and their probabilities, (k,) each."""
    if deviation == 0.0:
        return np.zeros(1), np.ones(1)
    z = np.linspace(-_MOST_DEVIATIONS, _MOST_DEVIATIONS, count)
    density = np.exp(-0.5 * z**2)
    return deviation * z, density / density.sum()
