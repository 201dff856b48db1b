"""The belief state of the slots, from the forecast and the search's own observations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parkenv.belief.cue_belief import freed
from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.errors import InputError
from parkenv.world.occupancy.decay import decay_factor

_SURE, _NOTHING = np.zeros(2), np.zeros(0)
_SURE.flags.writeable = _NOTHING.flags.writeable = False

UNOBSERVED, OBSERVED_FREE, OBSERVED_TAKEN = 0, 1, 2  # result of a slot's last observation
_LEAST_P = 1e-6
_SURELY_LEFT = 8.0  # decay rate times age up to which something of an observation is left


class Observations(NamedTuple):
    """Observations of some slots, (k,) each."""

    slots: IntArray  # int64
    time: FloatArray  # float64, when each was observed, s since the search began
    taken: BoolArray  # bool, observed states
    hit_rate: FloatArray  # float64, P(observed taken | taken)
    false_alarm_rate: FloatArray  # float64, P(observed taken | free)

    def take(self, slots: NDArray[np.integer]) -> Observations:
        which, number = _places(self.slots, slots)
        _, time, taken, hit_rate, false_alarm_rate = self
        return Observations(number, time[which], taken[which], hit_rate[which], false_alarm_rate[which])


@dataclass(eq=False)
class SlotBelief:
    """Probability that each slot is taken at one moment of a search, with the data behind it.

    An unobserved slot keeps its forecast. An observation updates the probability by Bayes' rule; from then on it
    decays to the forecast like that of a two-state Markov chain:
    p(t) = p∞ + (p_observed - p∞)·exp(-(λ+μ)t), with the forecast p∞ and the rates of arrival λ and departure μ.

    Treat instances as immutable: `update` and `decay` return new ones. (The class is not frozen and keeps its parts in
    the layout of the observation because agents create one per decision, and some decisions take microseconds.)

    Args:
        p_occupied: (n_slots,) float, current P(taken).
        parts: (4 * n_slots,) float, four consecutive parts:
            `forecast`, P(taken) before any observation;
            `decay_rate`, 1/s, λ+μ: how fast an observation loses its value;
            `p_observed`, P(taken) right after the slot's last observation; the forecast if there was none;
            `observed_at`, time of that observation, s since the search began; -1 if there was none.
        time: current time, s since the search began.
        day_error: (2,) float, logits, how far whole days differ from the forecast: standard deviations over days of
            the level and of the slope to the goal; see `parkenv.world.occupancy.day_error`.
        step_observed: (4 * k,) float, what the last step observed, four consecutive parts: slot, or -1; whether it was
            observed taken; hit rate; false-alarm rate. See `observations`.
        cues: (3 * n_slots,) float, or empty without cues, three parts: the excess that each slot's last observation
            left; 1/s, the rate at which a car that is about to leave leaves; and what the last step observed of it, the
            logarithm of P(it | about to leave) / P(it | not), 0 of other slots. See `cue_belief`.

    Examples:
        Slot 1 is observed free and stays likely to be free for a while.

        >>> belief = SlotBelief.of_forecast(np.array([0.8, 0.8]), np.array([1e-3, 1e-3]))
        >>> later = belief.update([1], [False]).decay(100.0)
        >>> later.observed_free.tolist(), later.p_occupied.round(3).tolist()
        ([False, True], [0.8, 0.076])
    """

    p_occupied: NDArray[np.floating]
    parts: NDArray[np.floating]
    time: float
    day_error: NDArray[np.floating] = field(default_factory=lambda: _SURE)
    step_observed: NDArray[np.floating] = field(default_factory=lambda: _NOTHING)
    cues: NDArray[np.floating] = field(default_factory=lambda: _NOTHING)

    @classmethod
    def of_observation(cls, observation: Mapping[str, Any]) -> Self:
        """Return the belief in an observation of `parkenv/Search-v2`, sharing its arrays.

        Raises:
            InputError: the observation comes from another environment.
        """
        try:
            return cls(
                observation["p_occupied"],
                observation["belief"],
                float(observation["time"][1]),
                observation["day_error"],
                observation["step_observed"],
                observation.get("cues", _NOTHING),
            )
        except KeyError as error:
            raise InputError(
                f"observation has no {error.args[0]!r}; want one of parkenv/Search-v2, got {', '.join(observation)}"
            ) from None

    def to_observation(self) -> dict[str, NDArray[np.float32]]:
        """Return this belief as entries of an observation, float32: all of them but vertex, time and action mask."""
        return {
            "p_occupied": self.p_occupied.astype(np.float32),
            "belief": self.parts.astype(np.float32),
            "step_observed": self.step_observed.astype(np.float32),
            "day_error": self.day_error.astype(np.float32),
            **({"cues": self.cues.astype(np.float32)} if len(self.cues) else {}),
        }

    @classmethod
    def of_forecast(
        cls, p_occupied: ArrayLike, decay_rate: ArrayLike, day_error: ArrayLike = (0.0, 0.0)
    ) -> Self:
        """Return the belief before any observation.

        Args:
            p_occupied: (n_slots,) the forecast.
            decay_rate: (n_slots,) 1/s.
            day_error: (2,) logits.
        """
        forecast = np.array(p_occupied, dtype=np.float64)
        parts = np.concatenate([forecast, decay_rate, forecast, np.full(len(forecast), -1.0)])
        return cls(forecast, parts, 0.0, np.array(day_error, dtype=np.float64))

    @cached_property
    def _rows(self) -> NDArray[np.floating]:
        return self.parts.reshape(4, -1)

    @property
    def forecast(self) -> NDArray[np.floating]:
        """(n_slots,) float, P(taken) before any observation."""
        return self._rows[0]  # type: ignore[no-any-return]

    @property
    def decay_rate(self) -> NDArray[np.floating]:
        """(n_slots,) float, 1/s, how fast an observation loses its value."""
        return self._rows[1]  # type: ignore[no-any-return]

    @property
    def p_observed(self) -> NDArray[np.floating]:
        """(n_slots,) float, P(taken) right after the slot's last observation; the forecast if there was none."""
        return self._rows[2]  # type: ignore[no-any-return]

    @property
    def observed_at(self) -> NDArray[np.floating]:
        """(n_slots,) float, time of the slot's last observation, s since the search began; -1 if there was none."""
        return self._rows[3]  # type: ignore[no-any-return]

    @cached_property
    def observations(self) -> Observations:
        """The observations of the last step."""
        return Observations(*_read_observations(self.step_observed, self.parts))

    @cached_property
    def observed(self) -> BoolArray:
        """(n_slots,) bool, whether the slot was observed in this search."""
        return self.observed_at >= 0.0

    @cached_property
    def state(self) -> NDArray[np.int8]:
        """(n_slots,) int8, `UNOBSERVED`, `OBSERVED_FREE` or `OBSERVED_TAKEN`, from each slot's last observation.

        A slot counts as observed free if the observation left P(taken) below the forecast, and as observed taken if
        above. If the forecast is certain, an observation that confirms it counts, too.
        """
        return _states(self.parts)  # type: ignore[no-any-return]

    @cached_property
    def recent_state(self) -> NDArray[np.uint8]:
        """(n_slots,) uint8, as `state`, but `UNOBSERVED` where "taken" has decayed to the forecast by now."""
        return _recent_states(self.parts, self.p_occupied, self.time)  # type: ignore[no-any-return]

    @property
    def observed_free(self) -> BoolArray:
        """(n_slots,) bool, see `state`."""
        return np.asarray(self.state == OBSERVED_FREE)

    @property
    def observed_taken(self) -> BoolArray:
        """(n_slots,) bool, see `state`."""
        return np.asarray(self.state == OBSERVED_TAKEN)

    @cached_property
    def age(self) -> FloatArray:
        """(n_slots,) float64, s since each slot's last observation; inf if there was none."""
        return np.where(self.observed, self.time - self.observed_at.astype(np.float64), np.inf)

    @property
    def announced(self) -> FloatArray:
        """(n_slots,) float64, P(the car shows that it leaves) beyond the usual, by the last observation of the slot."""
        if not len(self.cues):
            return np.zeros(len(self.p_occupied))
        excess, rate, _ = self.cues.astype(np.float64).reshape(3, -1)
        return np.asarray(excess * np.exp(-rate * np.where(excess != 0.0, self.age, 0.0)))

    def take(self, slots: NDArray[np.integer]) -> Self:
        """Return the belief of some of the slots, (k,), in float64."""
        parts = self._rows[:, slots].astype(np.float64)
        p_occupied = self.p_occupied[slots].astype(np.float64)
        cues = self.cues.reshape(3, -1)[:, slots if len(self.cues) else []].astype(np.float64)
        observed = slot, _, *rest = self.observations.take(slots)
        taken = type(self)(
            p_occupied, parts.ravel(), self.time, self.day_error, np.concatenate([slot, *rest]), cues.ravel()
        )
        taken.observations = observed
        return taken

    def update(
        self,
        slots: ArrayLike,
        observed_taken: ArrayLike,
        hit_rate: ArrayLike = 1.0,
        false_alarm_rate: ArrayLike = 0.0,
        cue_evidence: ArrayLike = 0.0,
    ) -> Self:
        """Return the belief after observations of some slots (Bayes' rule).

        Args:
            slots: (k,) int, without repeats.
            observed_taken: (k,) bool, observed states.
            hit_rate: (k,) or scalar, P(observed taken | taken).
            false_alarm_rate: (k,) or scalar, P(observed taken | free).
            cue_evidence: (k,) or scalar, what shows that the car in it leaves, as in `cues`; 0: not observed.
        """
        observed = np.asarray(slots, dtype=np.int64)
        kinds = (observed_taken, np.bool_), (hit_rate, np.float64), (false_alarm_rate, np.float64)
        reports, hits, false_alarms = (
            np.broadcast_to(np.asarray(values, dtype=kind), observed.shape) for values, kind in kinds
        )
        before = self.step_observed.reshape(4, -1)
        before = before[:, : np.count_nonzero(before[0] >= 0.0)].astype(np.float64)
        step_observed = np.hstack([before, [observed, reports, hits, false_alarms]]).ravel()
        p_occupied, parts = self.p_occupied.astype(np.float64), self.parts.astype(np.float64)
        cues = self.cues.astype(np.float64)
        later = type(self)(p_occupied, parts, self.time, self.day_error, step_observed, cues)
        _update_slots(later.p_occupied, observed, reports, hits, false_alarms)
        if len(cues):
            of_cues = cues.reshape(3, -1)
            of_cues[2, observed] = np.where(reports, cue_evidence, 0.0)
            of_cues[0, observed] = self._excess_after(of_cues, observed, reports, p_occupied)
        later.p_observed[observed], later.observed_at[observed] = later.p_occupied[observed], self.time
        return later

    def _excess_after(
        self, cues: FloatArray, slots: IntArray, taken: BoolArray, p_after: FloatArray
    ) -> FloatArray:
        """Return the excess that observations of slots leave, (k,), given P(taken) after them, (n_slots,)."""
        _, rate, evidence = cues[:, slots]
        usual = self.decay_rate[slots] * (1.0 - self.forecast[slots]) / rate
        there = np.maximum(self.p_occupied[slots], _LEAST_P)
        before = self.announced[slots] * p_after[slots] / there
        about_to = np.clip(usual * p_after[slots] + before, 0.0, p_after[slots])
        odds = np.exp(evidence) * about_to
        return np.where(taken, odds / (odds + 1.0 - about_to) - usual * p_after[slots], 0.0)

    def with_reservation(self, reserved: NDArray[np.integer]) -> Self:
        """Return the belief of a car that takes no slot but the one reserved for it, (n_slots,): 1 there, 0 elsewhere.

        To it, all other slots are taken, until the reservation changes.
        """
        n, closed = len(reserved), 1.0 - reserved
        parts = np.concatenate([self.forecast, np.zeros(n), closed, np.full(n, self.time)])
        observed = np.concatenate([np.arange(n), closed, np.ones(n), np.zeros(n)])
        return type(self)(closed, parts, self.time, self.day_error, observed)

    def decay(self, seconds: float) -> Self:
        """Return the belief after some time without observations."""
        later = type(self)(
            self.p_occupied,
            self.parts.astype(np.float64),
            self.time + seconds,
            self.day_error,
            cues=self.cues,
        )
        later.p_occupied = _decay_slots(
            later.forecast, later.decay_rate, later.p_observed, later.age, self.cues
        )
        if len(self.cues):
            later.cues = np.concatenate(
                [self.cues[: 2 * len(self.p_occupied)], np.zeros(len(self.p_occupied))]
            )
        return later


@compiled(inline="always")
def decay_to_prior(prior: float, rate: float, p_observed: float, elapsed: float) -> float:
    """P(taken) of a slot `elapsed` s after an observation that left it at `p_observed`."""
    return float(prior + (p_observed - prior) * decay_factor(rate * elapsed))


@compiled(error_model="numpy", forceinline=True)
def bayes_update(p: float, observed_taken: bool, hit_rate: float, false_alarm_rate: float) -> float:
    if_taken = hit_rate if observed_taken else 1.0 - hit_rate
    if_free = false_alarm_rate if observed_taken else 1.0 - false_alarm_rate
    evidence = if_taken * p + if_free * (1.0 - p)
    # The observation has probability 0 under the belief: trust the sensor as if it were error-free.
    if evidence <= 0.0:
        return 1.0 if observed_taken else 0.0
    return if_taken * p / evidence


@compiled(forceinline=True)
def observed_state(forecast: float, p_observed: float) -> int:
    if p_observed < forecast or p_observed == 0.0:
        return OBSERVED_FREE
    if p_observed > forecast or p_observed == 1.0:
        return OBSERVED_TAKEN
    return UNOBSERVED


@compiled(forceinline=True)
def may_have_decayed(decay_rate: float, time: float, observed_at: float) -> bool:
    """Whether an observation is so old that P(taken) may be the forecast again; times in s, rate in 1/s."""
    return bool(np.float64(decay_rate) * (np.float64(time) - np.float64(observed_at)) > _SURELY_LEFT)


@compiled
def _read_observations(
    step_observed: NDArray[np.floating], parts: NDArray[np.floating]
) -> tuple[IntArray, FloatArray, BoolArray, FloatArray, FloatArray]:
    most, first = len(step_observed) // 4, 3 * len(parts) // 4
    k = 0
    while k < most and step_observed[k] >= 0.0:
        k += 1
    slots, taken = np.empty(k, np.int64), np.empty(k, np.bool_)
    time, hit_rate, false_alarm_rate = np.empty(k), np.empty(k), np.empty(k)
    for i in range(k):
        slots[i], taken[i] = step_observed[i], step_observed[most + i] == 1.0
        time[i] = parts[first + slots[i]]
        hit_rate[i], false_alarm_rate[i] = step_observed[2 * most + i], step_observed[3 * most + i]
    return slots, time, taken, hit_rate, false_alarm_rate


@compiled
def _places(values: IntArray, among: IntArray) -> tuple[IntArray, IntArray]:
    which, place = np.empty(len(values), np.int64), np.empty(len(values), np.int64)
    n = 0
    for i in range(len(values)):
        for k in range(len(among)):
            if among[k] == values[i]:
                which[n], place[n] = i, k
                n += 1
                break
    return which[:n], place[:n]


@compiled
def _states(parts: NDArray[np.floating]) -> NDArray[np.int8]:
    n = len(parts) // 4
    states = np.full(n, UNOBSERVED, np.int8)
    for s in range(n):
        if parts[3 * n + s] >= 0.0:
            states[s] = observed_state(parts[s], parts[2 * n + s])
    return states


@compiled
def _recent_states(
    parts: NDArray[np.floating], p_occupied: NDArray[np.floating], time: float
) -> NDArray[np.uint8]:
    n = len(parts) // 4
    states = np.full(n, UNOBSERVED, np.uint8)
    for s in range(n):
        if parts[3 * n + s] >= 0.0:
            state = observed_state(parts[s], parts[2 * n + s])
            is_old = may_have_decayed(parts[n + s], time, parts[3 * n + s]) and p_occupied[s] == parts[s]
            states[s] = UNOBSERVED if state == OBSERVED_TAKEN and is_old else state
    return states


@compiled
def _update_slots(
    p_occupied: FloatArray,
    slots: NDArray[np.int64],
    observed_taken: BoolArray,
    hit_rate: FloatArray,
    false_alarm_rate: FloatArray,
) -> None:
    for i in range(len(slots)):
        s = slots[i]
        p_occupied[s] = bayes_update(p_occupied[s], observed_taken[i], hit_rate[i], false_alarm_rate[i])


@compiled
def _decay_slots(
    forecast: FloatArray,
    decay_rate: FloatArray,
    p_observed: FloatArray,
    age: FloatArray,
    cues: NDArray[np.floating],
) -> FloatArray:
    p_occupied, n = forecast.copy(), len(forecast)
    for s in range(n):
        if age[s] < np.inf:
            p_occupied[s] = decay_to_prior(forecast[s], decay_rate[s], p_observed[s], age[s])
            if len(cues) and cues[s] != 0.0:
                freed_by_now = freed(cues[s], cues[n + s], decay_rate[s], age[s])
                p_occupied[s] = min(max(p_occupied[s] - freed_by_now, 0.0), 1.0)
    return p_occupied
