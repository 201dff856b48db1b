"""What the car holds to be true of each slot: a prior, and what it saw, growing old."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from parkenv.occupancy import Forecast

FloatArray = NDArray[np.float64]


class SlotBelief:
    """Probability that each slot is taken, from a forecast and the sightings of one search.

    A slot that was never seen keeps its forecast. After a sighting the probability is Bayes's, and from
    then on it relaxes to the forecast as a two-state chain does: p(t) = p∞ + (p_seen - p∞)·exp(-(λ+μ)t).
    So one reads off it what is known: a slot below its forecast was last seen free, above it taken.

    Args:
        forecast: prior and relaxation rate of each slot.
        time: s, when the search starts.

    Attributes:
        p_occupied: (n_slots,) float64, as of `time`.
        time: s, of the last update.
        seen: (n_slots,) bool, seen in this search.
        n_known_taken: how many slots were seen and looked taken at the last look.
    """

    def __init__(self, forecast: Forecast, time: float) -> None:
        self.prior = forecast.p_occupied
        self.rate = forecast.relaxation_rate
        self.p_occupied = forecast.p_occupied.copy()
        self.time = time
        self.seen = np.zeros(len(self.prior), dtype=np.bool_)
        self._looked_taken = np.zeros(len(self.prior), dtype=np.bool_)
        self.n_known_taken = 0

    @property
    def proven_full(self) -> bool:
        """Whether every slot has been seen in this search and looked taken at its last look."""
        return self.n_known_taken == len(self.prior)

    def relax(self, time: float) -> None:
        """Let what was seen grow old until `time`, s."""
        if time > self.time:
            _relax(self.p_occupied, self.prior, self.rate, self.seen, time - self.time)
            self.time = time

    def update(
        self,
        slots: NDArray[np.int64],
        looks_taken: NDArray[np.bool_],
        hit_rate: FloatArray,
        false_alarm_rate: FloatArray,
    ) -> None:
        """Take in one look at each of `slots`, (k,), made at `self.time`; Bayes's rule.

        Args:
            slots: (k,) int64.
            looks_taken: (k,) bool.
            hit_rate: (k,) float64, P(looks taken | taken).
            false_alarm_rate: (k,) float64, P(looks taken | free).
        """
        self.n_known_taken += _update(
            self.p_occupied,
            self.seen,
            self._looked_taken,
            slots,
            looks_taken,
            hit_rate,
            false_alarm_rate,
        )


@njit(cache=True)
def _relax(
    p: FloatArray, prior: FloatArray, rate: FloatArray, seen: NDArray[np.bool_], elapsed: float
) -> None:
    for s in range(len(p)):
        if seen[s]:
            p[s] = prior[s] + (p[s] - prior[s]) * math.exp(-rate[s] * elapsed)


@njit(cache=True)
def _update(
    p: FloatArray,
    seen: NDArray[np.bool_],
    looked_taken: NDArray[np.bool_],
    slots: NDArray[np.int64],
    looks: NDArray[np.bool_],
    hit: FloatArray,
    false_alarm: FloatArray,
) -> int:
    more_taken = 0
    for i in range(len(slots)):
        s = slots[i]
        if_taken = hit[i] if looks[i] else 1.0 - hit[i]
        if_free = false_alarm[i] if looks[i] else 1.0 - false_alarm[i]
        evidence = if_taken * p[s] + if_free * (1.0 - p[s])
        # A look that the belief held to be impossible: believe the look, as a perfect sensor's.
        p[s] = if_taken * p[s] / evidence if evidence > 0.0 else (1.0 if looks[i] else 0.0)
        seen[s] = True
        more_taken += int(looks[i]) - int(looked_taken[s])
        looked_taken[s] = looks[i]
    return more_taken
