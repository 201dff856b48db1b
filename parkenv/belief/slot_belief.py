"""What the car holds to be true of each slot: a forecast, and what it saw, growing old."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from parkenv.world.decay import decay_factor
from sim_sensors.compilation import compiled

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SlotBelief:
    """Probability that each slot is taken, from a forecast and the sightings of one search, at one moment.

    A slot that was never seen keeps its forecast. After a sighting the probability is Bayes's, and from
    then on it relaxes to the forecast as a two-state chain does: p(t) = p∞ + (p_seen - p∞)·exp(-(λ+μ)t).
    So one reads off it what is known: a slot below its forecast was last seen free, above it taken.

    Args:
        prior: (n_slots,) float64, the forecast.
        rate: (n_slots,) float64, 1/s, at which sightings fade.
        p_occupied: (n_slots,) float64, now.
        seen: (n_slots,) bool, seen in this search.
        n_known_taken: how many slots were seen and looked taken at the last look.
    """

    prior: FloatArray
    rate: FloatArray
    p_occupied: FloatArray
    seen: NDArray[np.bool_]
    n_known_taken: int

    @property
    def proven_full(self) -> bool:
        """Whether every slot has been seen in this search and looked taken at its last look."""
        return self.n_known_taken == len(self.prior)


@compiled(inline="always")
def decay_to_prior(prior: float, rate: float, said: float, elapsed: float) -> float:
    """The belief in a slot, `elapsed` s after a look that left it at `said`."""
    return float(prior + (said - prior) * decay_factor(rate * elapsed))


@compiled(error_model="numpy", forceinline=True)
def bayes_update(p: float, looks_taken: bool, hit_rate: float, false_alarm_rate: float) -> float:
    """The belief `p` in a slot after one look at it; Bayes's rule.

    Args:
        p: before the look.
        looks_taken: what it showed.
        hit_rate: P(looks taken | taken).
        false_alarm_rate: P(looks taken | free).
    """
    if_taken = hit_rate if looks_taken else 1.0 - hit_rate
    if_free = false_alarm_rate if looks_taken else 1.0 - false_alarm_rate
    evidence = if_taken * p + if_free * (1.0 - p)
    # A look that the belief held to be impossible: believe the look, as a perfect sensor's.
    if evidence <= 0.0:
        return 1.0 if looks_taken else 0.0
    return if_taken * p / evidence
