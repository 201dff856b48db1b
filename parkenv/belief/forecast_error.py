"""The forecast error model: how the occupancy of a whole day may differ from its forecast.

Forecast errors are correlated: on the day of an event every slot near the goal is more likely to be taken than
forecast, and a forecast may be entirely wrong. The model is a mixture of hypotheses. Each hypothesis gives every slot a
probability; given the hypothesis, slots are independent. Observations of the first slots update the weights of the
hypotheses by Bayes' rule and so change the belief about unobserved slots. The same update is applied to hypothetical
observations while planning: if the car has not parked along a path, the slots further on are also more likely to be
taken.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parkenv.errors import InputError

FloatArray = NDArray[np.float64]

NEGLIGIBLE = 5e-4
"""Hypotheses with less weight are dropped: if the forecast is right, the uninformative ones would only blur it."""


SHIFTS = {(logits, reach): 1e-3 for logits in (-2.0, -1.0, 1.0, 2.0) for reach in (0.2, 0.4, 0.6, 0.8, 1.0)}
EVENTS = dict.fromkeys((0.6, 0.65, 0.7, 0.75, 0.8, 0.9, 1.0), 0.08 / 7)
UNINFORMED = {(level, slope): 3e-4 for level in (-2.0, 0.0, 2.0, 4.0) for slope in (0.0, 2.0, 4.0)}


@dataclass(frozen=True)
class ForecastErrorModel:
    """Prior mixture over the ways in which a day may differ from its forecast.

    The remaining probability is that of a correct forecast. A forecast describes the average day, so the log-odds of
    the slots on a usual day are chosen such that the mean over usual days, shifts and events is the forecast.

    Args:
        shifts: (shift of the log-odds, fraction of the lot, nearest to the goal, that it affects) -> prior probability.
        events: fraction of the lot, nearest to the goal, that an event fills -> prior probability in a very large lot.
            With higher probabilities the car would turn round after fewer taken slots: sooner on the day of an event,
            and more often without need on other days.
        p_occupied_at_event: P(taken) of the affected slots, unless the forecast is even higher.
        half_events_at: number of slots of a lot in which events are half as likely as in a very large one, because
            small lots fill up on usual days.
        uninformed: (log-odds of the middle slot, increase at the goal and decrease at the far end) -> prior probability
            that the forecast says nothing about the day.

    Raises:
        InputError: a value out of its range, or probabilities that add up to more than 1.
    """

    shifts: Mapping[tuple[float, float], float] = field(default_factory=lambda: SHIFTS)
    events: Mapping[float, float] = field(default_factory=lambda: EVENTS)
    p_occupied_at_event: float = 0.998
    half_events_at: float = 40.0
    uninformed: Mapping[tuple[float, float], float] = field(default_factory=lambda: UNINFORMED)

    def __post_init__(self) -> None:
        probabilities = [*self.shifts.values(), *self.events.values(), *self.uninformed.values()]
        if not all(p >= 0.0 for p in probabilities) or not sum(probabilities) < 1.0:
            raise InputError(
                "forecast error model: want prior probabilities of at least 0 and below 1 in sum"
            )
        if not 0.0 < self.p_occupied_at_event < 1.0:
            raise InputError(f"p_occupied_at_event is {self.p_occupied_at_event}, want a number in (0, 1)")
        if not self.half_events_at >= 0.0:
            raise InputError(f"half_events_at is {self.half_events_at}, want at least 0 slots")

    @classmethod
    def none(cls) -> Self:
        """The model of a forecast without errors."""
        return cls(shifts={}, events={}, uninformed={})

    def prior(self, forecast: ArrayLike, walk_s: FloatArray) -> DayBelief:
        """Return the belief about the day before any observation.

        Args:
            forecast: (n_slots,) P(taken).
            walk_s: (n_slots,) s, walk from each slot to the goal; orders the slots from near to far.
        """
        p = np.clip(np.asarray(forecast, dtype=np.float64), 1e-6, 1.0 - 1e-6)
        n = len(p)
        rank = np.argsort(np.argsort(walk_s, kind="stable"), kind="stable")
        logits = np.log(p / (1.0 - p))
        event_logits = np.log(self.p_occupied_at_event / (1.0 - self.p_occupied_at_event))
        in_lot = n / (n + self.half_events_at)
        shift, weight = [np.zeros(n)], [0.0]
        for (size, reach), chance in self.shifts.items():
            shift.append(np.where(rank < reach * n, size, 0.0))
            weight.append(chance)
        for reach, chance in self.events.items():
            shift.append(np.where(rank < reach * n, np.maximum(event_logits - logits, 0.0), 0.0))
            weight.append(in_lot * chance)
        weight[0] = 1.0 - sum(weight) - sum(self.uninformed.values())
        shifts = np.stack(shift)
        days = _logistic(_usual_logits(p, shifts, np.array(weight) / sum(weight)) + shifts)
        if self.uninformed:
            nearness = 1.0 - 2.0 * rank / max(n - 1, 1)
            days = np.concatenate(
                [days, _logistic(np.stack([level + slope * nearness for level, slope in self.uninformed]))]
            )
        return DayBelief(np.clip(days, 1e-9, 1.0 - 1e-9), np.log([*weight, *self.uninformed.values()]))


class DayBelief:
    """Belief about how far today differs from its forecast: a posterior over hypotheses.

    Args:
        p_taken: (k, n_slots) float64, P(taken) of each slot under each hypothesis.
        log_weight: (k,) float64, logarithm of the prior probability of each hypothesis.

    Examples:
        The forecast is 60 % for every slot. The first ten slots are all taken, so P(taken) of the others rises.

        >>> day = ForecastErrorModel().prior(np.full(40, 0.6), np.arange(40.0))
        >>> round(float(day.p_occupied()[20]), 2)
        0.6
        >>> day.update(np.arange(10), np.full(10, True))
        >>> bool(day.p_occupied()[20] > 0.7)
        True
    """

    def __init__(self, p_taken: FloatArray, log_weight: FloatArray) -> None:
        self._p_taken, self._log_weight = p_taken, log_weight
        self._log_taken, self._log_free = np.log(p_taken), np.log1p(-p_taken)

    def update(self, slots: NDArray[np.int64], taken: NDArray[np.bool_]) -> None:
        """Update the weights from the first observations of slots, (k,) int64, taken or not, (k,) bool."""
        likelihood = self._log_taken[:, slots[taken]].sum(axis=1) + self._log_free[:, slots[~taken]].sum(
            axis=1
        )
        self._log_weight = self._log_weight + likelihood

    def mixture(self) -> tuple[FloatArray, FloatArray]:
        """Return the weights, (k,), of the hypotheses that matter, and P(free) under each, (k, n_slots)."""
        weight = np.exp(self._log_weight - self._log_weight.max())
        kept = weight >= NEGLIGIBLE * weight.sum()
        return weight[kept] / weight[kept].sum(), 1.0 - self._p_taken[kept]

    def p_occupied(self) -> FloatArray:
        """P(taken), (n_slots,), of slots not observed yet."""
        weight, free = self.mixture()
        return np.asarray(1.0 - weight @ free)


def _usual_logits(forecast: FloatArray, shifts: FloatArray, weight: FloatArray) -> FloatArray:
    """Log-odds, (n_slots,), whose mean probability over all shifts, (k, n_slots), is the forecast; by bisection."""
    logits = np.log(forecast / (1.0 - forecast))
    most = np.abs(shifts).max()
    low, high = logits - most, logits + most
    for _ in range(30):
        middle = 0.5 * (low + high)
        too_full = (weight[:, None] * _logistic(middle + shifts)).sum(axis=0) > forecast
        low, high = np.where(too_full, low, middle), np.where(too_full, middle, high)
    return np.asarray(low)


def _logistic(logits: FloatArray) -> FloatArray:
    return np.asarray(1.0 / (1.0 + np.exp(-logits)))
