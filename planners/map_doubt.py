"""Doubt in the map: what the slots seen so far say of those not yet seen.

Forecasts err together: on the day of an event every slot near the goal is likelier to be taken than the map
says. So the log-odds that slot s is taken are held to be logit(forecast_s) + a·(1 - z_s) + b·z_s, where z_s runs from
0 at the slot nearest to the goal to 1 at the farthest, and (a, b) is unknown and small most of the time. Every
first look at a slot tells of (a, b) by Bayes's rule, on a grid.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

SHIFTS = np.array([-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 4.0])
"""Values of a and of b, logits. The last one is an event: 60 % taken becomes 99 %."""
TYPICAL_SHIFT = 1.0
"""Scale of the double exponential prior of a and of b, logits, where the map is off."""
MAP_IS_RIGHT = 0.9
"""Prior probability that the map is not off at all."""


class MapDoubt:
    """Beliefs in how far a forecast is off.

    Args:
        p_occupied: (n_slots,) float64, the forecast.
        walk_s: (n_slots,) float64, s.

    Example:
        A map says 60 % everywhere; of ten slots seen all are taken, so the others are thought fuller.

        >>> doubt = MapDoubt(np.full(40, 0.6), np.arange(40.0))
        >>> round(float(doubt.p_occupied()[20]), 2)
        0.6
        >>> for slot in range(10):
        ...     doubt.look(np.array([slot]), np.array([True]))
        >>> bool(doubt.p_occupied()[20] > 0.7)
        True
    """

    def __init__(self, p_occupied: FloatArray, walk_s: FloatArray) -> None:
        p = np.clip(p_occupied, 1e-6, 1.0 - 1e-6)
        rank = np.argsort(np.argsort(walk_s, kind="stable"), kind="stable")
        far = rank / max(len(walk_s) - 1, 1)
        near_shift, far_shift = (g.ravel()[:, None] for g in np.meshgrid(SHIFTS, SHIFTS))
        logits = np.log(p / (1.0 - p)) + near_shift * (1.0 - far) + far_shift * far
        self._taken = 1.0 / (1.0 + np.exp(-logits))
        self._log_taken = -np.logaddexp(0.0, -logits)
        self._log_free = -np.logaddexp(0.0, logits)
        # Grid points stand for unequal stretches of the shift.
        width = np.gradient(SHIFTS)
        each = np.log(width) - np.abs(SHIFTS) / TYPICAL_SHIFT
        off = np.exp(np.add.outer(each, each).ravel())
        exact = (near_shift[:, 0] == 0.0) & (far_shift[:, 0] == 0.0)
        self._log_weight = np.log(MAP_IS_RIGHT * exact + (1.0 - MAP_IS_RIGHT) * off / off.sum())
        # The mean over the grid is not the forecast itself where that is uneven; what is told is how it moved.
        self._forecast = p
        self._at_first = self._mean()

    def look(self, slots: NDArray[np.int64], taken: NDArray[np.bool_]) -> None:
        """Take in first looks at slots, (k,) int64, that showed them taken or not, (k,) bool."""
        told = self._log_taken[:, slots[taken]].sum(axis=1) + self._log_free[:, slots[~taken]].sum(axis=1)
        self._log_weight += told

    def p_occupied(self) -> FloatArray:
        """Probability, (n_slots,), that a slot not yet seen is taken."""
        mean = self._mean()
        moved = np.log(mean / (1.0 - mean)) - np.log(self._at_first / (1.0 - self._at_first))
        odds = self._forecast / (1.0 - self._forecast) * np.exp(moved)
        return np.asarray(odds / (1.0 + odds))

    def _mean(self) -> FloatArray:
        weight = np.exp(self._log_weight - self._log_weight.max())
        mean: FloatArray = np.clip(weight @ self._taken / weight.sum(), 1e-9, 1.0 - 1e-9)
        return mean
