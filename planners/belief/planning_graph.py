"""Data of the path search for compiled code: the drive graph, the belief about its slots, and a path buffer.

All times are in seconds. "Now" is the time of the decision; times along a path count from now. P(free) of a slot
follows a two-state Markov chain, p(t) = p∞ + (p(0) - p∞)·exp(-rt): a free slot may be taken while the car drives to it,
and a taken one may become free.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.cue_belief import freed
from parkenv.belief.slot_belief import OBSERVED_FREE, OBSERVED_TAKEN, UNOBSERVED
from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import kernel

Records = NDArray[Any]
"""A structured array. One array of records compiles several times faster than one array per field."""

MOST_HYPOTHESES = 64  # maximum number of hypotheses about the day
MOST_STOPS = 400  # maximum number of vertices of a path
AGAIN_S = 30.0  # s after which a path typically observes a taken slot again

VIEW = np.dtype(
    [
        ("slot", np.int64),
        ("rate", np.float64),  # P(the slot can be detected from there)
        ("hit", np.float64),  # P(observed taken | taken, detected)
        ("false_alarm", np.float64),  # P(observed taken | free, detected)
    ]
)
"""A slot in view of a vertex."""

SLOT = np.dtype(
    [
        ("p_free", np.float64),  # now
        ("p_free_usual", np.float64),  # the value to which it decays
        ("decay_rate", np.float64),  # 1/s, rate of that decay
        ("leaving", np.float64),  # 1/s, rate at which a taken slot is left
        ("odds", np.float64),  # P(taken)/P(free) at about the earliest arrival of the car; inf where hopeless
        ("least_odds", np.float64),  # the value to which those decay
        ("missed_rate", np.float64),  # highest detection rate among the views from which it was not detected
        ("state", np.int64),  # `SlotBelief.state`
    ]
)
"""The belief about a slot at a decision."""

STOP = np.dtype(
    [
        ("vertex", np.int64),
        ("time", np.float64),
        ("target", np.int64),  # the vertex that the car was driving to
        ("first", np.int64),  # index of its first observation; the last precedes the next stop's first
        ("ahead_s", np.float64),  # scratch: least time to the goal after any later observation
        ("stop_s", np.float64),  # scratch: expected time of driving to the best slot that is known now
        # scratch: `PathBuffer.remembered` from `oldest` on, before `newest`, are in mind on arrival here; the expected
        # times of driving back to them begin at `first_kept`
        ("oldest", np.int64),
        ("newest", np.int64),
        ("first_kept", np.int64),
    ]
)
"""A stop of a path."""

OBSERVATION = np.dtype(
    [
        ("slot", np.int64),
        ("p_free", np.float64),  # given that the search has reached this stop
        ("time", np.float64),
        ("expected_s", np.float64),  # scratch: expected time of driving to the slot
        # scratch: s, how much longer the search is expected to take once the slot has decayed
        ("loss_s", np.float64),
        (
            "rest",
            np.float64,
        ),  # scratch: P(none is free) of the slots observed at the same stop, up to this one
        ("value", np.float64),  # scratch: s, the share of the expected time that these slots have
        ("memory", np.int64),  # scratch: index in `PathBuffer.remembered`; -1 if it is not remembered
        ("is_first", np.bool_),  # whether the slot was not observed before, in fact or along the path
        ("parks", np.bool_),  # whether the car parks in the slot if it is free
    ]
)
"""An observation of a slot along a path."""

STATE = np.dtype(
    [
        ("n_stops", np.int64),
        ("left_s", np.float64),  # expected time after the last stop if nothing was found
        # of the rollout so far: where the car is, and when; the vertex that it drives to
        ("vertex", np.int64),
        ("time", np.float64),
        ("target", np.int64),
        ("chooses", np.bool_),  # whether the thesis's planner chooses another target
        ("n_passed", np.int64),  # number of the given targets that it has passed
        ("n_observations", np.int64),
        ("n_unproven", np.int64),  # number of slots to observe taken before the lot is proven full
        ("n_unobserved", np.int64),  # number of slots within reach that were never observed
    ]
)
"""A path as a whole."""

REMEMBERED = np.dtype(
    [
        ("slot", np.int64),
        ("time", np.float64),  # of the observation
        ("cost_s", np.float64),  # the slot's arrival cost
        ("loss_s", np.float64),  # as in `OBSERVATION`
        ("decay_rate", np.float64),  # the slot's
        ("until", np.int64),  # the last stop at which the slot is remembered
    ]
)
"""A slot observed along a path that is remembered at later stops."""

MARK = np.dtype([("observed_at", np.float64), ("scratch", np.float64)])
"""Time at which a path last observed a slot; -1: not yet; -inf: not needed, the slot is known to be free."""


class PlanningGraph(NamedTuple):
    """The part of the planning problem that does not change during a search."""

    drive_s: FloatArray  # (n_vertices, n_vertices) float64, s, drive times
    next_vertex: NDArray[np.int16]  # (n_vertices, n_vertices) int16, the next vertex of a shortest route
    view_starts: IntArray  # (n_vertices + 1,) int64, rows of `views`
    views: Records  # `VIEW` records, the slots in view of each vertex
    own_rate: FloatArray  # (n_slots,) float64, P(the slot is detected from its own vertex)
    cost_s: FloatArray  # (n_slots,) float64, s, arrival cost (`SearchProblem.arrival_cost_s`)
    wait_s: float  # s, time of an observation without moving
    give_up_s: float  # s, cost of giving up a lot that is proven full
    # s, expected cost of finding a slot taken on arrival; 0 if that is observed before the attempt
    failure_s: float
    whole: bool  # whether these are all slots of the lot; only then can it be proven full


class BeliefSnapshot(NamedTuple):
    """The belief about the slots at one decision."""

    slots: Records  # (n_slots,) `SLOT` records
    weights: FloatArray  # (k,) float64, probabilities of the hypotheses of the forecast error model
    p_free_if: FloatArray  # (n_slots, k) float64, P(free) of an unobserved slot under each of them
    # (n_slots, k) float64, likelihood of each of them if the slot is observed taken: 1 - P(free), or nearer to 1 at a
    # kerb, whose slots fill together
    taken_if: FloatArray
    evidence: FloatArray  # (n_slots,) float64, 1, or less at a kerb


@kernel
def set_slots(
    belief: BeliefSnapshot,
    parts: FloatArray,
    cues: FloatArray,
    time: float,
    p_occupied: FloatArray,
    drive_s: FloatArray,
) -> None:
    """Fill in all but what was observed, from `SlotBelief`, P(taken) now but for cues, and drives from the car, s."""
    n = len(belief.slots)
    for s in range(n):
        forecast, decay_rate, at = parts[s], parts[n + s], belief.slots[s]
        p_free, usual = 1.0 - p_occupied[s], max(mean_over_days(belief.weights, belief.p_free_if[s]), 1e-6)
        # Cars leave as often as forecast; on a fuller day free slots are taken faster.
        leaving = decay_rate * (1.0 - forecast)
        rate = leaving / usual
        if at.state == OBSERVED_TAKEN and len(belief.weights) > 1:
            rate = _rate_of_return(leaving, usual, belief.weights, belief.p_free_if[s])
        if len(cues) and cues[s] > 0.0 and at.state == OBSERVED_TAKEN:
            gap, arriving = time - parts[3 * n + s], leaving / usual - leaving
            p_free += freed(cues[s], cues[n + s], leaving / usual, gap)
            # Until it is known what becomes of it, the slot is one whose car leaves at the rate of now.
            announced = cues[s] * math.exp(-cues[n + s] * gap)
            leaving += cues[n + s] * announced / max(1.0 - p_free, announced)
            usual, rate = leaving / (leaving + arriving), leaving + arriving
        on_arrival = usual + (p_free - usual) * math.exp(-rate * drive_s[s] if drive_s[s] < np.inf else 0.0)
        at.p_free, at.p_free_usual, at.decay_rate, at.leaving = p_free, usual, rate, leaving
        at.odds = (1.0 - on_arrival) / on_arrival if on_arrival > 0.0 else np.inf
        at.least_odds = 1.0 / usual - 1.0


@kernel
def _rate_of_return(leaving: float, usual: float, weights: FloatArray, p_free_if: FloatArray) -> float:
    """Return the rate, 1/s, at which a slot observed taken returns to its usual P(free), averaged over hypotheses.

    The average is right after `AGAIN_S`. Where an event may have filled the lot, a slot that is left is taken again
    before the car is back: with the rate at which it is left, another round would seem worth its time for ever.
    """
    p_free = 0.0
    for h in range(len(weights)):
        p_free += weights[h] * p_free_if[h] * decayed_part(leaving / p_free_if[h], AGAIN_S)
    return -math.log(max(1.0 - p_free / usual, 1e-9)) / AGAIN_S


class PathBuffer(NamedTuple):
    """Buffer for one path; with a further leading axis of the first three arrays, for several that share the rest."""

    state: Records  # (1,) `STATE` record
    stops: Records  # `STOP` records, one more than there are stops
    observations: Records  # `OBSERVATION` records in order
    marks: Records  # (n_slots,) `MARK` records
    weights: FloatArray  # float64, scratch: probabilities of the hypotheses along the path
    remembered: Records  # `REMEMBERED` records, scratch, in the order of the observations
    # float64, s, scratch: expected times from each stop to the slots in mind, or to the best of those known before
    kept_s: FloatArray
    # float64, s, scratch: value at a stop of what follows with each of `remembered` in mind
    value_s: FloatArray


def path_buffers(n_paths: int, n_slots: int, n_vertices: int) -> PathBuffer:
    most_stops = min(4 * n_vertices + 16, MOST_STOPS)
    most_observations = n_slots + min(n_slots + 64, MOST_STOPS)
    return PathBuffer(
        np.zeros((n_paths, 1), STATE),
        np.zeros((n_paths, most_stops + 1), STOP),
        np.zeros((n_paths, most_observations), OBSERVATION),
        np.zeros(n_slots, MARK),
        np.zeros(MOST_HYPOTHESES),
        np.zeros(most_observations, REMEMBERED),
        np.zeros(most_stops * most_observations),
        np.zeros(most_observations),
    )


@kernel
def reset_weights(belief: BeliefSnapshot, path: PathBuffer) -> None:
    for h in range(len(belief.weights)):
        path.weights[h] = belief.weights[h]


@kernel
def mean_over_days(weights: FloatArray, values: FloatArray) -> float:
    """Return the mean of values, (k,), over the hypotheses with weights (k,)."""
    # Four sums at once take a fraction of the time of one, and unlike those that a compiler splits up, are the same on
    # every machine.
    n = len(weights)
    first, second, third, fourth = 0.0, 0.0, 0.0, 0.0
    for h in range(0, n - 3, 4):
        first += weights[h] * values[h]
        second += weights[h + 1] * values[h + 1]
        third += weights[h + 2] * values[h + 2]
        fourth += weights[h + 3] * values[h + 3]
    for h in range(n - n % 4, n):
        first += weights[h] * values[h]
    return (first + second) + (third + fourth)


@kernel
def decayed_part(rate: float, seconds: float) -> float:
    """Return 1 - exp(-rate · seconds); a series up to 0.05, where its relative error stays below 1e-7."""
    x = rate * seconds
    if x < 0.05:
        return x * (1.0 - x / 2.0 * (1.0 - x / 3.0 * (1.0 - x / 4.0)))
    return 1.0 - math.exp(-x)


@kernel
def detects_missed(rate: float, missed_rate: float) -> bool:
    """Return whether a view is more likely than not to detect a slot that others have missed.

    Whatever hides a slot keeps hiding it: a view detects every slot that a view with a lower rate detects
    (`SensorBand`). `missed_rate` is the highest rate, P(the view detects the slot), among those that missed it, or 0.
    """
    return rate > missed_rate and rate - missed_rate >= 0.5 * (1.0 - missed_rate)


@kernel
def is_hidden(slot: int, rate: float, belief: BeliefSnapshot) -> bool:
    """Return whether a slot is expected to stay hidden in a view with the given detection rate."""
    if belief.slots[slot].state == UNOBSERVED:
        return not detects_missed(rate, belief.slots[slot].missed_rate)
    # The slot's state is known from a better view or from an attempt.
    return bool(rate <= belief.slots[slot].missed_rate)


@kernel
def needs_attempt(vertex: int, graph: PlanningGraph, belief: BeliefSnapshot) -> bool:
    """Return whether only a parking attempt can show if the slot at a vertex is free: it is hidden even from there."""
    if vertex >= len(belief.slots) or belief.slots[vertex].state == OBSERVED_FREE:
        return False
    hidden: bool = is_hidden(vertex, graph.own_rate[vertex], belief)
    return hidden
