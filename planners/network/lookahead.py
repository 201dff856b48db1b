"""A quick look ahead: the expected time of one short path behind an action.

The path follows the thesis's planner at one failure cost while every slot that it observes is taken. Its value is the
expected time of a car that stops at the first slot that is better than going on. Unlike in `planners.belief`, no slot
is remembered along the path, the path is short, and no target is inserted: a path takes microseconds.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from parkenv.belief.slot_belief import OBSERVED_FREE, UNOBSERVED
from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled
from planners.belief.path import expected_cost_to_slot, p_free_again
from planners.belief.planning_graph import BeliefSnapshot, PlanningGraph, is_hidden

MOST_STOPS = 48  # maximum number of vertices of a path
MOST_OBSERVATIONS = 192
ENOUGH = 0.02  # P(nothing found) at which a path ends


class Scratch(NamedTuple):
    """Buffers for one path."""

    seen_at: FloatArray  # (n_slots,) s, when the path observed each slot last; -1 if it did not
    weights: FloatArray  # probabilities of the hypotheses about the day along the path
    time: FloatArray  # (MOST_STOPS + 1,) s
    first: IntArray  # (MOST_STOPS + 2,) index of each stop's first observation
    stop_s: FloatArray  # (MOST_STOPS + 1,) s, time from each stop to the best slot that is known to be free
    p_free: FloatArray  # (MOST_OBSERVATIONS,)
    cost_s: FloatArray  # (MOST_OBSERVATIONS,) s, drive back and arrival cost
    slots: IntArray  # (MOST_OBSERVATIONS,) slots to reset in `seen_at`

    @classmethod
    def of(cls, n_slots: int, n_hypotheses: int) -> Scratch:
        """Allocate the buffers for a lot."""
        return cls(
            np.full(n_slots, -1.0),
            np.zeros(n_hypotheses),
            np.zeros(MOST_STOPS + 1),
            np.zeros(MOST_STOPS + 2, np.int64),
            np.zeros(MOST_STOPS + 1),
            np.zeros(MOST_OBSERVATIONS),
            np.zeros(MOST_OBSERVATIONS),
            np.zeros(MOST_OBSERVATIONS, np.int64),
        )


@compiled(error_model="numpy")
def next_target(
    vertex: int,
    seconds: float,
    failure_s: float,
    by_cost: IntArray,
    seen_at: FloatArray,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
) -> tuple[int, float]:
    """Return the slot that the thesis's planner drives to, and its value, s; -1 and inf if there is none."""
    best, chosen = np.inf, -1
    for s in by_cost:
        cost_s = graph.cost_s[s]
        if cost_s >= best:
            break  # the others cost more, however near they are
        value = graph.drive_s[vertex, s] + cost_s
        if value >= best:
            continue
        at = belief.slots[s]
        if at.state == OBSERVED_FREE:
            continue
        if at.state == UNOBSERVED and seen_at[s] < 0.0:
            value += failure_s * at.odds
        else:
            p_free = p_free_again(s, seconds + graph.drive_s[vertex, s], seen_at[s], belief)
            if p_free == 0.0:
                continue
            value += failure_s * (1.0 - p_free) / p_free
        if value < best:
            best, chosen = value, s
    return chosen, best


@compiled(error_model="numpy")
def best_option(
    vertex: int,
    seconds: float,
    options: IntArray,
    fallback_s: float,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
) -> float:
    """Return the expected time, s, from a vertex to the best slot known to be free; inf if there is none."""
    best = np.inf
    for s in options:
        if graph.drive_s[vertex, s] + graph.cost_s[s] < best:
            value = expected_cost_to_slot(
                vertex, s, belief.slots[s].p_free, seconds, fallback_s, graph, belief
            )
            best = min(best, value)
    return best


@compiled(error_model="numpy")
def path_value(
    vertex: int,
    start_s: float,
    failure_s: float,
    by_cost: IntArray,
    options: IntArray,
    fallback_s: float,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
    scratch: Scratch,
) -> tuple[float, float, int]:
    """Evaluate the path of the thesis's planner from a vertex.

    Args:
        vertex: where the path begins; slots are observed there, too.
        start_s: s from now until the car is there.
        failure_s: s, failure cost of the thesis's planner.
        by_cost: (n_slots,) the slots, least arrival cost first.
        options: (k,) slots known to be free now.
        fallback_s: s, time of the search if such a slot is gone.
        graph: the lot.
        belief: the belief.
        scratch: buffers.

    Returns:
        The expected time from now, s; P(nothing found on the path); its first target, or -1.
    """
    weights = scratch.weights[: len(belief.weights)]
    for h in range(len(weights)):
        weights[h] = belief.weights[h]
    n_observed, k, seconds, p_none = 0, 0, start_s, 1.0
    found, found_cost = 0.0, 0.0
    # `value` is what the thesis's planner expects from the current vertex: better slots are taken on the way.
    target, value = next_target(vertex, seconds, failure_s, by_cost, scratch.seen_at, graph, belief)
    first_target = target
    scratch.first[0] = 0
    while True:
        scratch.time[k] = seconds
        scratch.stop_s[k] = best_option(vertex, seconds, options, fallback_s, graph, belief)
        retarget = target == vertex
        for i in range(graph.view_starts[vertex], graph.view_starts[vertex + 1]):
            view = graph.views[i]
            s = view.slot
            at = belief.slots[s]
            if (
                at.state == OBSERVED_FREE
                or n_observed == MOST_OBSERVATIONS
                or is_hidden(s, view.rate, belief)
            ):
                continue
            cost_s = graph.drive_s[vertex, s] + graph.cost_s[s]
            if at.state == UNOBSERVED and scratch.seen_at[s] < 0.0:
                p_free_if = belief.p_free_if[s]
                p_free = 0.0
                for h in range(len(weights)):
                    p_free += weights[h] * p_free_if[h]
                # Where the car would park, going on means that the slot was taken.
                if cost_s <= value:
                    rest = 1.0 / max(1.0 - p_free, 1e-9)
                    for h in range(len(weights)):
                        weights[h] *= (1.0 - p_free_if[h]) * rest
            else:
                p_free = p_free_again(s, seconds, scratch.seen_at[s], belief)
                if p_free == 0.0:
                    continue
            scratch.slots[n_observed] = s
            scratch.seen_at[s] = seconds
            # Insert in the order of cost among the observations of this stop.
            j = n_observed
            while j > scratch.first[k] and scratch.cost_s[j - 1] > cost_s:
                scratch.cost_s[j], scratch.p_free[j] = scratch.cost_s[j - 1], scratch.p_free[j - 1]
                j -= 1
            scratch.cost_s[j], scratch.p_free[j] = cost_s, p_free
            n_observed += 1
            if cost_s <= value:
                p_none *= 1.0 - p_free
            found += p_free
            found_cost += p_free * cost_s
            retarget = retarget or s == target
        scratch.first[k + 1] = n_observed
        if p_none < ENOUGH or k == MOST_STOPS - 1 or n_observed == MOST_OBSERVATIONS:
            break
        if retarget:
            target, value = next_target(vertex, seconds, failure_s, by_cost, scratch.seen_at, graph, belief)
        if target < 0:
            break
        if target == vertex:
            seconds += graph.wait_s
        else:
            following = int(graph.next_vertex[vertex, target])
            if following < 0:
                break
            step_s = graph.drive_s[vertex, following]
            seconds += step_s
            value -= step_s
            vertex = following
        k += 1
    last = k
    # After the end, slots are found at the same rate as before.
    rest_s = graph.give_up_s
    if found > 1e-6:
        rest_s = min(rest_s, (max(seconds - start_s, graph.wait_s) + found_cost) / found)
    ahead = min(rest_s, scratch.stop_s[last])
    for k in range(last, -1, -1):
        if k < last:
            ahead = min(ahead + scratch.time[k + 1] - scratch.time[k], scratch.stop_s[k])
        expected, p_rest = 0.0, 1.0
        for j in range(scratch.first[k], scratch.first[k + 1]):
            if scratch.cost_s[j] >= ahead:
                break
            expected += p_rest * scratch.p_free[j] * scratch.cost_s[j]
            p_rest *= 1.0 - scratch.p_free[j]
        ahead = expected + p_rest * ahead
    for j in range(n_observed):
        scratch.seen_at[scratch.slots[j]] = -1.0
    return start_s + ahead, p_none, first_target
