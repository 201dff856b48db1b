"""The belief about the day: how far the occupancy of a whole day differs from its forecast.

Forecast errors are correlated: on a fuller day every slot is more likely to be taken than forecast. The day is one of
several hypotheses; given the hypothesis, slots are independent. A usual day has a level L and a slope S toward the
goal, drawn from the forecast's own `DayError`. On the day of an event the slots nearest to the goal are taken. Each
observation updates the weights of the hypotheses by Bayes' rule and so changes the belief about the other slots. The
same update is applied to hypothetical observations while planning: if the car has not parked along a path, the slots
further on are also more likely to be taken.

Slots of one kerb fill and empty together: a coach, a building site, a closed street. So those of a kerb of many count
for less each (`independent_share`).

A forecast from few days is too sure of single slots, which the posterior over days cannot tell:
`UNINFORMATIVE_SLOT_PROBABILITY` allows for it.
"""

from __future__ import annotations

import math
from copy import copy

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import Observations, SlotBelief, decay_to_prior
from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.world.occupancy.centred_logits import centred_logits
from parkenv.world.occupancy.day_error import DayError

# Hypotheses with less weight are left out of a plan; they return if observations speak for them.
NEGLIGIBLE = 5e-4
# Numbers of levels and slopes. Searches take as long with 21 levels, within noise, and 1 % longer with five.
LEVELS, SLOPES = 9, 5
# Largest value and degrees of freedom of the t-distribution of levels and slopes, before it is scaled.
REACH, FREEDOM = 4.2, 4.0
# Fractions of the slots, those nearest to the goal, that an event may fill, equally likely.
EVENT_SHARES = np.array([0.6, 0.65, 0.7, 0.75, 0.8, 0.9, 1.0])
EVENT = 0.08
"""Probability of an event among very many slots.

With a higher probability the car turns round after fewer taken slots: sooner on the day of an event, and more often
without need on other days.
"""
MEAN_EXCESS, USUAL_EXCESS = 0.09, 0.15
"""Fractions of the slots: by how much occupancy is above its forecast in the mean, where it is; on one day in five.

The excess is exponential: fitted to the weekday mornings of 54 German car parks in 2023, with the mean of the last four
same weekdays as the forecast. An event that fills more slots that are forecast to be free is the less likely.
"""
HALF_EVENTS_AT = 40.0  # number of slots with half the events of very many: small lots fill up on usual days
P_TAKEN_AT_EVENT = 0.998  # P(taken) of the affected slots, unless the forecast is even higher
# Probability that the forecast says nothing about the day: then its level is one of `OTHER_LEVELS`, logits.
WORTHLESS = 0.004
OTHER_LEVELS, OTHER_SLOPES = np.array([-2.0, 0.0, 2.0, 4.0]), np.array([0.0, 2.0, 4.0])
UNINFORMATIVE_SLOT_PROBABILITY = 0.02
"""Probability that the forecast of a slot says nothing about it: then it is as likely free as taken, on a usual day.

It has the greatest likelihood, of 0 to 0.2, on nine recorded days of 164 slots (CNRPark-EXT), each forecast from the
days before it: slots that were to be free in 0.7 % of all cases were free in 1.4 %.
"""
KERB_CORRELATION = 0.1
"""Correlation of the states of two slots of a kerb, given the day and the kerb's own forecast.

It was 0.06 and 0.08 on weekdays at 25 kerbs of Melbourne and 12 of Seattle, each forecast from its other days, and 0.19
on a weekend. Rolling forecasts, which have fewer days, differ more.
"""
_LEAST, _MOST = 1e-6, 1.0 - 1e-6


def independent_share(facility_of_slot: NDArray[np.integer]) -> FloatArray:
    """Return the part of an observation of each slot, (n_slots,), that is evidence for the day: 1, less at a kerb.

    Of m slots with correlation ρ each counts 1 / (1 + (m - 1)·ρ), as in the variance of their mean.

    Args:
        facility_of_slot: (n_slots,) int, facility of each slot, -1: none, as in `ParkingLot`.

    Examples:
        >>> independent_share(np.array([-1, 0, 1, 1, 1])).round(3).tolist()
        [1.0, 1.0, 0.833, 0.833, 0.833]
    """
    n_together = np.bincount(facility_of_slot + 1)[facility_of_slot + 1]
    return np.where(facility_of_slot < 0, 1.0, 1.0 / (1.0 + (n_together - 1) * KERB_CORRELATION))


class DayBelief:
    """Belief about the day and the slots of (a part of) a lot: the exact posterior over hypotheses about the day.

    Under each hypothesis a slot's state is a two-state Markov chain with observations at single times: a second
    observation after a short time carries no information about the day.

    Args:
        belief: belief about these slots before any observation.
        nearness: (n_slots,) see `parkenv.world.occupancy.day_error.nearness`; over the whole lot.
        certain: whether the forecast is right on every day, whatever is observed.
        rival_rates: (n_slots,) 1/s, rates at which cars beside those of the forecast take each slot while it is free;
            None: there are no such cars.
        hypotheses: about the day: prior weights, (k,), and P(taken) under each, (n_slots, k); None: those above.
        doubt: probability that the forecast of a slot carries no information (`UNINFORMATIVE_SLOT_PROBABILITY`).
        event: probability that an event has filled the slots near the goal (`EVENT`). This and `doubt` are without
            effect where the forecast is certain, among rivals, and with hypotheses of the caller.
        evidence: (n_slots,) see `independent_share`; None: the slots of a day are independent.

    Examples:
        The forecast is 60 % for every slot. The first ten slots are all taken, so P(taken) of the others rises.

        >>> from parkenv.world.occupancy.day_error import nearness
        >>> belief = SlotBelief.of_forecast(np.full(40, 0.6), np.zeros(40))
        >>> belief.day_error = np.array([0.8, 0.0])
        >>> day = DayBelief(belief, nearness(np.arange(40.0)))
        >>> round(float(day.p_occupied(time=0.0)[20]), 2)
        0.6
        >>> seen = belief.update(np.arange(10), np.full(10, True))
        >>> day.update(seen.observations)
        >>> bool(day.p_occupied(time=0.0)[20] > 0.7)
        True
    """

    def __init__(
        self,
        belief: SlotBelief,
        nearness: FloatArray,
        certain: bool = False,
        rival_rates: FloatArray | None = None,
        hypotheses: tuple[FloatArray, FloatArray] | None = None,
        doubt: float = 0.0,
        event: float = EVENT,
        evidence: FloatArray | None = None,
    ) -> None:
        forecast = np.clip(belief.forecast.astype(np.float64), _LEAST, _MOST)
        crowded = rival_rates is not None and bool(rival_rates.any())
        # Rivals make slopes and events of their own: with them, days differ by their level only.
        self._n_events = 0 if certain or crowded or hypotheses is not None else len(EVENT_SHARES)
        if hypotheses is not None:
            weight, p_taken = hypotheses
        elif certain:
            weight, p_taken = np.ones(1), forecast[:, None]
        elif crowded:
            weight, p_taken = _hypotheses(forecast, nearness, np.array([belief.day_error[0], 0.0]), EVENT)
            weight, p_taken = weight[: -len(EVENT_SHARES)], p_taken[:, : -len(EVENT_SHARES)]
            weight = weight / weight.sum()
        else:
            doubted = forecast + doubt * (0.5 - forecast)
            weight, p_taken = _hypotheses(doubted, nearness, belief.day_error, event)
        if rival_rates is not None and crowded:
            # Free at the rate μ, taken at λ, and by rivals at r: P(free) = μ/(λ+μ+r)
            leaving = belief.decay_rate.astype(np.float64) * (1.0 - forecast)
            gone = np.divide(rival_rates, leaving, out=np.zeros(len(leaving)), where=leaving > 0.0)
            p_taken = 1.0 - 1.0 / (1.0 / (1.0 - p_taken) + gone[:, None])
        self._log_weight, self._p_taken = np.log(np.maximum(weight, 1e-300)), p_taken
        self._evidence = np.ones(len(forecast)) if evidence is None else evidence
        self._taken_if = (1.0 - (1.0 - p_taken)) ** self._evidence[:, None]  # rounded as 1 - P(free)
        self._forecast, self._decay_rate = (
            belief.forecast.astype(np.float64),
            belief.decay_rate.astype(np.float64),
        )
        # P(taken) right after each slot's last observation: under each hypothesis, and of the slot alone; when that was
        self._p_then = np.array(self._p_taken)
        self._p_alone = forecast.copy()
        self._observed_at = np.full(len(forecast), -1.0)

    def carry_over(self, other: DayBelief, ours: IntArray, theirs: IntArray) -> None:
        """Take over what is known about the day, and about the slots `theirs` of another part, here `ours`, (k,).

        An event is one of a part: in another part it is as likely as at first, and if there was one, what was observed
        there says nothing about the level.
        """
        usual = len(self._log_weight) - self._n_events
        prior, posterior = np.exp(self._log_weight), np.exp(other._log_weight - other._log_weight.max())
        posterior /= posterior.sum()
        event = posterior[usual:].sum()
        share = posterior[:usual] + event * prior[:usual] / prior[:usual].sum()
        self._log_weight[:usual] = np.log(np.maximum(share, 1e-300) * prior[:usual].sum())
        self._p_then[ours] = other._p_then[theirs]
        self._p_alone[ours] = other._p_alone[theirs]
        self._observed_at[ours] = other._observed_at[theirs]

    def update(self, observations: Observations) -> None:
        """Update from new observations, in the order of their times (Bayes' rule)."""
        _update(
            self._log_weight, self._p_taken, self._forecast, self._decay_rate, self._evidence,
            self._p_then, self._p_alone, self._observed_at, *observations,
        )  # fmt: skip

    def copy(self) -> DayBelief:
        """Return a copy, to which updates of this one do nothing."""
        other = copy(self)
        for name in ("_log_weight", "_p_then", "_p_alone", "_observed_at"):
            setattr(other, name, getattr(self, name).copy())
        return other

    def on_days(self, slots: IntArray, time: float) -> tuple[FloatArray, FloatArray]:
        """Return the probabilities of all hypotheses, (k,), and P(taken) under each of some slots, (n, k)."""
        elapsed = time - self._observed_at[slots]
        leaving = self._decay_rate[slots] * (1.0 - self._forecast[slots])
        p_taken = _decayed(self._p_taken[slots], leaving, self._p_then[slots], elapsed)
        return _weights(self._log_weight), p_taken

    def mixture(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the hypotheses that matter, and what the slots say of them.

        These are their weights, (k,); P(free) and the likelihood of "taken", (n_slots, k); `evidence`, (n_slots,).
        """
        weight, p_free, taken_if = _mixture(self._log_weight, self._p_taken, self._taken_if)
        return weight, p_free, taken_if, self._evidence

    def p_occupied(self, time: float) -> FloatArray:
        """P(taken) of each slot at a time, s since the search began, (n_slots,), observed or not."""
        return _p_occupied(  # type: ignore[no-any-return]
            self._log_weight,
            self._p_taken,
            self._forecast,
            self._decay_rate,
            self._p_then,
            self._observed_at,
            time,
        )


def _hypotheses(
    forecast: FloatArray, nearness: FloatArray, day_error: NDArray[np.floating], event: float
) -> tuple[FloatArray, FloatArray]:
    """Return prior weights, (k,), and P(taken), (n_slots, k), of the hypotheses about the day.

    A forecast describes the average day, so the usual days are chosen such that the mean over all days is the forecast.
    """
    error = DayError(*(float(e) for e in day_error))
    n = len(forecast)
    within = np.argsort(np.argsort(-nearness))[:, None] < n * EVENT_SHARES
    filled = (1.0 - forecast) @ within / n
    rarer = np.exp(-np.maximum(filled - USUAL_EXCESS, 0.0) / MEAN_EXCESS)
    event_weight = event / len(EVENT_SHARES) * n / (n + HALF_EVENTS_AT) * rarer
    at_event = np.maximum(forecast, P_TAKEN_AT_EVENT)
    share = within @ event_weight
    usual = np.maximum((forecast - share * at_event) / (1.0 - share), 0.5 * forecast)
    centre = centred_logits(usual, error.deviations(nearness))
    (levels, level_weight), (slopes, slope_weight) = (
        _nodes(deviation, count) for deviation, count in ((error.level, LEVELS), (error.slope, SLOPES))
    )
    usual_weight = np.outer(slope_weight, level_weight).ravel() * (1.0 - event_weight.sum() - WORTHLESS)
    usual_days = centre[:, None] + _shifts(levels, slopes, nearness)
    other_days = _shifts(OTHER_LEVELS, OTHER_SLOPES, nearness)
    days = 1.0 / (1.0 + np.exp(-np.concatenate([usual_days, other_days], axis=1)))
    events = np.where(within, at_event[:, None], usual[:, None])
    weight = np.concatenate(
        [usual_weight, np.full(other_days.shape[1], WORTHLESS / other_days.shape[1]), event_weight]
    )
    return weight, np.clip(np.concatenate([days, events], axis=1), 1e-9, 1.0 - 1e-9)


def _shifts(levels: FloatArray, slopes: FloatArray, nearness: FloatArray) -> FloatArray:
    return np.asarray((levels + nearness[:, None, None] * slopes[:, None]).reshape(len(nearness), -1))


def _nodes(deviation: float, count: int) -> tuple[FloatArray, FloatArray]:
    """Return values and weights, (k,) each, of a distribution around 0; a single value without deviation.

    Student's t-distribution instead of a normal one: its tails are for days that differ more than the forecast says.
    """
    if deviation == 0.0:
        return np.zeros(1), np.ones(1)
    values = np.linspace(-REACH, REACH, count)
    weight = (1.0 + values**2 / FREEDOM) ** (-0.5 * (FREEDOM + 1.0))
    weight /= weight.sum()
    return deviation / math.sqrt(weight @ values**2) * values, weight


@compiled
def _update(
    log_weight: FloatArray,
    p_taken: FloatArray,
    forecast: FloatArray,
    decay_rate: FloatArray,
    share: FloatArray,
    p_then: FloatArray,
    p_alone: FloatArray,
    observed_at: FloatArray,
    slots: IntArray,
    time: FloatArray,
    taken: BoolArray,
    hit_rate: FloatArray,
    false_alarm_rate: FloatArray,
) -> None:
    for i in range(len(slots)):
        s = slots[i]
        first, gap = observed_at[s] < 0.0, time[i] - observed_at[s]
        if_taken = hit_rate[i] if taken[i] else 1.0 - hit_rate[i]
        if_free = false_alarm_rate[i] if taken[i] else 1.0 - false_alarm_rate[i]
        # Relative to what is expected of the slot alone, so that what surprises no hypothesis leaves the weights.
        p = forecast[s] if first else decay_to_prior(forecast[s], decay_rate[s], p_alone[s], gap)
        p = min(max(p, _LEAST), _MOST)
        evidence = if_taken * p + if_free * (1.0 - p)
        p_alone[s] = if_taken * p / evidence
        if_taken, if_free = if_taken / evidence, if_free / evidence
        for h in range(len(log_weight)):
            p = p_taken[s, h]
            if not first:
                leaving = decay_rate[s] * (1.0 - forecast[s])
                p = decay_to_prior(p, leaving / (1.0 - p), p_then[s, h], gap)
            likelihood = if_taken * p + if_free * (1.0 - p)
            # Zero likelihood under this hypothesis: keep the observed state.
            p_then[s, h] = if_taken * p / likelihood if likelihood > 0.0 else np.float64(taken[i])
            log_weight[h] += share[s] * math.log(max(likelihood, 1e-300))
        observed_at[s] = time[i]


@compiled(inline="always")
def _weights(log_weight: FloatArray) -> FloatArray:
    weight: FloatArray = np.exp(log_weight - log_weight.max())
    return np.asarray(weight / weight.sum())


@compiled
def _decayed(p_taken: FloatArray, leaving: FloatArray, p_then: FloatArray, elapsed: FloatArray) -> FloatArray:
    p_now = np.empty_like(p_taken)
    for s in range(len(p_taken)):
        for h in range(p_taken.shape[1]):
            p = p_taken[s, h]
            p_now[s, h] = decay_to_prior(p, leaving[s] / (1.0 - p), p_then[s, h], elapsed[s])
    return p_now


@compiled
def _mixture(
    log_weight: FloatArray, p_taken: FloatArray, taken_if: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    weight = _weights(log_weight)
    likely = np.flatnonzero(weight >= NEGLIGIBLE)
    p_free = np.empty((len(p_taken), len(likely)))
    of_likely = np.empty_like(p_free)
    for s in range(len(p_taken)):
        for k in range(len(likely)):
            p_free[s, k] = 1.0 - p_taken[s, likely[k]]
            of_likely[s, k] = taken_if[s, likely[k]]
    weight = weight[likely]
    return weight / weight.sum(), p_free, of_likely


@compiled
def _p_occupied(
    log_weight: FloatArray,
    p_taken: FloatArray,
    forecast: FloatArray,
    decay_rate: FloatArray,
    p_then: FloatArray,
    observed_at: FloatArray,
    now: float,
) -> FloatArray:
    weight, p_occupied = _weights(log_weight), np.zeros(len(observed_at))
    for s in range(len(observed_at)):
        leaving, first = decay_rate[s] * (1.0 - forecast[s]), 0.0
        for h in range(len(weight)):
            p = p_taken[s, h]
            if observed_at[s] >= 0.0:
                p = decay_to_prior(p, leaving / (1.0 - p), p_then[s, h], now - observed_at[s])
            # Differences from the first one: where all agree, so does their mean, to the bit.
            first = first if h else p
            p_occupied[s] += weight[h] * (p - first)
        p_occupied[s] = min(max(p_occupied[s] + first, 0.0), 1.0)
    return p_occupied
