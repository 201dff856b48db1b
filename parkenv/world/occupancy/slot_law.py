"""What is known of the slots of a world when its day is known, and nothing else: its law."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.world.week import HOUR_S


class SlotLaw(NamedTuple):
    """Independent two-state Markov chains from an arrival on, one per slot, with rates by the hour.

    Attributes:
        p_taken: (n,) float64, P(taken) at the arrival.
        arriving: (2, n) float64, 1/s, rates at which free slots are taken in the hour of the arrival, and in the next.
        leaving: (2, n) float64, 1/s, rates at which taken slots become free.
        hour_ends_s: s from the arrival to the end of its hour.

    Examples:
        Half of the cars leave within ln 2 mean stays; nobody comes.

        >>> law = SlotLaw(np.ones(1), np.zeros((2, 1)), np.full((2, 1), 1 / 600.0), 100.0)
        >>> round(float(law.p_taken_after(600 * np.log(2))[0]), 6)
        0.5
        >>> round(float(law.stays(50.0, 50.0 + 600 * np.log(2))[0]), 6)
        0.5
    """

    p_taken: FloatArray
    arriving: FloatArray
    leaving: FloatArray
    hour_ends_s: float

    @property
    def known_for_s(self) -> float:
        """S from the arrival for which the rates are known."""
        return self.hour_ends_s + HOUR_S

    def take(self, slots: IntArray) -> SlotLaw:
        return SlotLaw(self.p_taken[slots], self.arriving[:, slots], self.leaving[:, slots], self.hour_ends_s)

    def p_taken_after(self, seconds: ArrayLike) -> FloatArray:
        """Return P(taken) of each slot at a time of its own, (..., n) s after the arrival."""
        p, end = self.p_taken, np.asarray(seconds, np.float64)
        for arriving, leaving, spent in zip(self.arriving, self.leaving, self._spent(0.0, end), strict=True):
            rate = arriving + leaving
            usual = np.divide(arriving, rate, out=np.zeros_like(rate), where=rate > 0.0)
            p = usual + (p - usual) * np.exp(-rate * spent)
        return np.asarray(p)

    def stays(self, begin: ArrayLike, end: ArrayLike) -> FloatArray:
        """Return P(one car stays until `end`), given that the slot is taken at `begin`; times as above."""
        spent = self._spent(np.asarray(begin, np.float64), np.asarray(end, np.float64))
        hazard = sum(leaving * seconds for leaving, seconds in zip(self.leaving, spent, strict=True))
        return np.asarray(np.exp(-hazard))

    def _spent(self, begin: ArrayLike, end: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return the seconds of a span that are in the hour of the arrival, and after it."""
        first = np.clip(end, None, self.hour_ends_s) - np.clip(begin, None, self.hour_ends_s)
        return first, np.asarray(end) - np.asarray(begin) - first
