"""Doubt in the map: what the slots seen so far say of those not yet seen.

Forecasts err together: on the day of an event every slot near the goal is likelier to be taken than the map
says, and a map may be plain wrong. Each hypothesis of how the map is off gives every slot a probability of its own,
and given the hypothesis slots are independent. First looks tell of the hypotheses by Bayes's rule, and so may looks
that are only imagined: on a path on which nowhere was parked so far, the next slot is likelier to be taken, too.

The hypotheses are: the map is right; the log-odds of the slots nearest to the goal, a fifth of the lot to all of it,
are shifted alike; an event has filled the slots nearest to the goal, six tenths of the lot or more; or the map knows
nothing, and slots are the fuller the nearer to the goal they are. As the map speaks of the average day, the unshifted
log-odds are such that the mean over shifts and events is what the map says.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

OFF = dict.fromkeys(
    ((shift, reach) for shift in (-2.0, -1.0, 1.0, 2.0) for reach in (0.2, 0.4, 0.6, 0.8, 1.0)), 1e-3
)
"""Prior probability of each shift, logits, of the slots nearest to the goal, as parts of the lot."""
EVENTS = dict.fromkeys((0.6, 0.65, 0.7, 0.75, 0.8, 0.9, 1.0), 0.08 / 7)
"""Prior probability, in a very large lot, of events that fill the slots nearest to the goal, as parts of the lot.

Were they thought likelier, fewer taken slots would make the car turn round where there is one, and more often where
there is none.
"""
AT_EVENTS = 0.998
"""How often a slot is taken at an event, unless the map says still more."""
LARGE = 40
"""Slots of a lot in which an event is half as likely as in a very large one: small ones fill up on ordinary days."""
KNOWS_NOTHING = {(level, slope): 3e-4 for level in (-2.0, 0.0, 2.0, 4.0) for slope in (0.0, 2.0, 4.0)}
"""Where the map knows nothing: log-odds of the slot in the middle, and how much higher they are at the goal, and
lower at the farthest slot; and the prior probability of each.
"""
_NEGLIGIBLE = 5e-4
"""Hypotheses below this are not followed: where the map is right, those that it knows nothing would only blur it."""


class MapDoubt:
    """Beliefs in how far a forecast is off.

    Args:
        p_occupied: (n_slots,) float64, the forecast.
        walk_s: (n_slots,) float64, s.
        trusting: whether the forecast is taken to be right.

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

    def __init__(self, p_occupied: FloatArray, walk_s: FloatArray, trusting: bool = False) -> None:
        p = np.clip(np.asarray(p_occupied, dtype=np.float64), 1e-6, 1.0 - 1e-6)
        if trusting:
            self._taken, self._log_weight = p[None, :], np.zeros(1)
        else:
            self._taken, self._log_weight = _hypotheses(p, walk_s)
        self._log_taken, self._log_free = np.log(self._taken), np.log1p(-self._taken)

    def look(self, slots: NDArray[np.int64], taken: NDArray[np.bool_]) -> None:
        """Take in first looks at slots, (k,) int64, that showed them taken or not, (k,) bool."""
        told = self._log_taken[:, slots[taken]].sum(axis=1) + self._log_free[:, slots[~taken]].sum(axis=1)
        self._log_weight += told

    def mixture(self) -> tuple[FloatArray, FloatArray]:
        """The hypotheses that are worth a thought: their probabilities, (k,), and P(free) under each, (k, n_slots)."""
        weight = np.exp(self._log_weight - self._log_weight.max())
        kept = weight >= _NEGLIGIBLE * weight.sum()
        return weight[kept] / weight[kept].sum(), 1.0 - self._taken[kept]

    def p_occupied(self) -> FloatArray:
        """Probability, (n_slots,), that a slot not yet seen is taken."""
        weight, free = self.mixture()
        return np.asarray(1.0 - weight @ free)


def _hypotheses(p: FloatArray, walk_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """P(taken), (k, n_slots), under each hypothesis, and the log of its prior probability, (k,)."""
    n = len(p)
    rank = np.argsort(np.argsort(walk_s, kind="stable"), kind="stable")
    large = n / (n + LARGE)
    doubts = sum(OFF.values()) + large * sum(EVENTS.values()) + sum(KNOWS_NOTHING.values())
    shift, prior = [np.zeros(n)], [1.0 - doubts]
    for (size, reach), chance in OFF.items():
        shift.append(np.where(rank < reach * n, size, 0.0))
        prior.append(chance)
    event = np.log(AT_EVENTS / (1.0 - AT_EVENTS))
    logits = np.log(p / (1.0 - p))
    for reach, chance in EVENTS.items():
        shift.append(np.where(rank < reach * n, np.maximum(event - logits, 0.0), 0.0))
        prior.append(large * chance)
    nearness = 1.0 - 2.0 * rank / max(n - 1, 1)
    blank = _logistic(np.stack([level + slope * nearness for level, slope in KNOWS_NOTHING]))
    shifts, weight = np.stack(shift), np.array(prior)[:, None] / sum(prior)
    most = np.abs(shifts).max()
    low, high = logits - most, logits + most
    for _ in range(30):
        middle = 0.5 * (low + high)
        too_full = (weight * _logistic(middle + shifts)).sum(axis=0) > p
        low, high = np.where(too_full, low, middle), np.where(too_full, middle, high)
    taken = np.concatenate([_logistic(low + shifts), blank])
    return np.clip(taken, 1e-9, 1.0 - 1e-9), np.log([*prior, *KNOWS_NOTHING.values()])


def _logistic(logits: FloatArray) -> FloatArray:
    return np.asarray(1.0 / (1.0 + np.exp(-logits)))
