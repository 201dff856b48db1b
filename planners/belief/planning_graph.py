"""What a search for a path goes on, for compiled code: the lot, what is believed of its slots, and room for a path.

A slot may be taken while the car drives to it, and one seen taken may have come free: both by two-state
chains, p(t) = p∞ + (p(0) - p∞)·exp(-rt).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_sensors.compilation import compiled

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

UNSEEN, LOOKS_FREE, LOOKS_TAKEN = 0, 1, 2

MOST_HYPOTHESES = 64
"""How many ways of how a map may be off there is room for."""
MOST_STEPS = 400
"""Vertices at which a path ends in any case."""


class Ground(NamedTuple):
    """What stays the same in a search.

    Attributes:
        seconds: (n_vertices, n_vertices) float64, s, drive times.
        following: (n_vertices, n_vertices) int16, the next vertex of a shortest way.
        view_starts: (n_vertices + 1,) int64, rows of `view_slots`.
        view_slots: int64, slots in view of each vertex.
        view_rates: float64, P(each of them is made out at all).
        own_rates: (n_slots,) float64, the same of each slot from its own vertex.
        walk_s: (n_slots,) float64, s.
        wait_s: s, what it takes to look again where the car stands.
        give_up_s: s, from a lot that is proven full to the goal.
        failure_s: s, what it costs to find a slot taken on arrival: nothing if that shows before the try.
        whole: whether these are all slots that there are, so that the lot may be proven full.
    """

    seconds: FloatArray
    following: NDArray[np.int16]
    view_starts: IntArray
    view_slots: IntArray
    view_rates: FloatArray
    own_rates: FloatArray
    walk_s: FloatArray
    wait_s: float
    give_up_s: float
    failure_s: float
    whole: bool


class Outlook(NamedTuple):
    """What is believed of the slots at one decision.

    Attributes:
        kind: (n_slots,) int8, UNSEEN, LOOKS_FREE or LOOKS_TAKEN.
        free: (n_slots,) float64, P(free now).
        weights: (k,) float64, probabilities of the hypotheses of how the map is off.
        free_if: (n_slots, k) float64, P(free) of an unseen slot under each of them.
        usual: (n_slots,) float64, P(free) that it relaxes to.
        rate: (n_slots,) float64, 1/s, how fast.
        odds: (n_slots,) float64, P(taken)/P(free) about when the car could be there; inf where hopeless.
        least_odds: (n_slots,) float64, P(taken)/P(free) that it relaxes to: no slot seen taken has better ones.
        missed: (n_slots,) float64, the greatest rate of a view from which a slot was not made out.
        told: whether rates were seen at work, so that it is safe to count on cars to leave.
    """

    kind: NDArray[np.int8]
    free: FloatArray
    weights: FloatArray
    free_if: FloatArray
    usual: FloatArray
    rate: FloatArray
    odds: FloatArray
    least_odds: FloatArray
    missed: FloatArray
    told: bool


class Path(NamedTuple):
    """Room for one path, used again and again.

    Attributes:
        vertices: (most,) int64.
        times: (most,) float64, s from now.
        starts: (most + 1,) int64, which looks are made at each vertex: `starts[k]` to `starts[k + 1]`.
        slots: (most_looks,) int64, the slots looked at, in order.
        chances: (most_looks,) float64, P(free) at the look, if the search has come so far.
        found: (most_looks,) float64, s from now, when the look is made.
        first_look: (most_looks,) bool, whether the slot has not been seen before, really or along the path.
        taken_up: (most_looks,) bool, whether the car parks in the slot if the look shows it free.
        looked: (n_slots,) float64, s from now, when the path last looked at a slot; -1 where it has not yet, -inf
            where it need not: the slot is known to be free.
        again: (n_slots,) float64, scratch of going round.
        values: (most_looks,) float64, scratch of the way back.
        offers: (most_looks,) float64, scratch of the way back.
        until: (most_looks,) int64, scratch: the last vertex at which each slot is kept in mind.
        ahead: (most,) float64, scratch: s that any look after each vertex takes at least.
        weights: float64, scratch: the hypotheses' probabilities as they are along the path.
    """

    vertices: IntArray
    times: FloatArray
    starts: IntArray
    slots: IntArray
    chances: FloatArray
    found: FloatArray
    first_look: NDArray[np.bool_]
    taken_up: NDArray[np.bool_]
    looked: FloatArray
    again: FloatArray
    values: FloatArray
    offers: FloatArray
    until: IntArray
    ahead: FloatArray
    weights: FloatArray


def new_path(n_slots: int, n_vertices: int) -> Path:
    """Room for a path on a lot of that size."""
    most = min(4 * n_vertices + 16, MOST_STEPS)
    most_looks = n_slots + min(n_slots + 64, MOST_STEPS)
    return Path(
        np.zeros(most, np.int64),
        np.zeros(most),
        np.zeros(most + 1, np.int64),
        np.zeros(most_looks, np.int64),
        np.zeros(most_looks),
        np.zeros(most_looks),
        np.zeros(most_looks, np.bool_),
        np.zeros(most_looks, np.bool_),
        np.zeros(n_slots),
        np.zeros(n_slots),
        np.zeros(most_looks),
        np.zeros(most_looks),
        np.zeros(most_looks, np.int64),
        np.zeros(most),
        np.zeros(MOST_HYPOTHESES),
    )


@compiled
def decayed(rate: float, seconds: float) -> float:
    """1 - exp(-rate · seconds), quick where little happens."""
    x = rate * seconds
    if x < 1e-3:
        return x
    return 1.0 - math.exp(-x)


@compiled
def shows(rate: float, missed: float) -> bool:
    """Whether a view is likelier than not to show a slot that another one has missed.

    What hides a slot goes on hiding it: a view makes out all that one with a lower rate does (`SensorBand`).

    Args:
        rate: P(the slot is made out), of the view.
        missed: the same of the best view from which it was not made out; 0 if there was none.
    """
    return rate > missed and rate - missed >= 0.5 * (1.0 - missed)


@compiled
def hidden(slot: int, rate: float, outlook: Outlook) -> bool:
    """Whether a view that makes a slot out with some rate is thought not to show it."""
    if outlook.kind[slot] == UNSEEN:
        return not shows(rate, outlook.missed[slot])
    # Known from a better view, or from a try.
    return bool(rate <= outlook.missed[slot])


@compiled
def must_try(vertex: int, ground: Ground, outlook: Outlook) -> bool:
    """Whether a vertex lies before a slot that is not known to be free, and that does not show from there either.

    Who stands there finds out by trying to park.
    """
    if vertex >= len(outlook.kind) or outlook.kind[vertex] == LOOKS_FREE:
        return False
    stays_hidden: bool = hidden(vertex, ground.own_rates[vertex], outlook)
    return stays_hidden
