"""A quick look ahead: the expected time of one short path behind an action.

The path follows the thesis's planner at one failure cost while every slot that it observes is taken. Its value is the
expected time of a car that stops at the first slot that is better than going on. Unlike in `planners.belief`, no slot
is remembered along the path, the path is short, and no target is inserted: a path takes microseconds.
"""

from typing import NamedTuple, Self

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
    seen_at: FloatArray  # (n_slots,) s, when the path observed each slot last; -1 if it did not
    weights: FloatArray  # probabilities of the hypotheses about the day along the path
    time: FloatArray  # (MOST_STOPS + 1,) s
    first: IntArray  # (MOST_STOPS + 2,) index of each stop's first observation
    stop_s: FloatArray  # (MOST_STOPS + 1,) s, time from each stop to the best slot that is known to be free
    p_free: FloatArray  # (MOST_OBSERVATIONS,)
    cost_s: FloatArray  # (MOST_OBSERVATIONS,) s, drive back and arrival cost
    slots: IntArray  # (MOST_OBSERVATIONS,) slots to reset in `seen_at`

    @classmethod
    def of(cls, n_slots: int, n_hypotheses: int) -> Self:
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


class Decision(NamedTuple):
    by_cost: IntArray  # (n_slots,) the slots, least arrival cost first
    options: IntArray  # (k,) slots known to be free now that are considered
    fallback_s: float  # s, time of the search if such a slot is gone
    graph: PlanningGraph
    belief: BeliefSnapshot
    scratch: Scratch


@compiled(error_model="numpy")
def next_target(vertex: int, seconds: float, failure_s: float, decision: Decision) -> tuple[int, float]:
    """Return the slot that the thesis's planner drives to, and its value, s; -1 and inf if there is none."""
    graph, belief, seen_at = decision.graph, decision.belief, decision.scratch.seen_at
    best, chosen = np.inf, -1
    for s in decision.by_cost:
        cost_s = graph.cost_s[s]
        if cost_s >= best:
            break  # the others cost more, however near they are
        value = graph.drive_s[vertex, s] + cost_s
        at = belief.slots[s]
        if value >= best or at.state == OBSERVED_FREE:
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
def best_option(vertex: int, seconds: float, decision: Decision) -> float:
    """Return the expected time, s, from a vertex to the best slot known to be free; inf if there is none."""
    graph, belief, best = decision.graph, decision.belief, np.inf
    for s in decision.options:
        if graph.drive_s[vertex, s] + graph.cost_s[s] < best:
            p_free = belief.slots[s].p_free
            value = expected_cost_to_slot(vertex, s, p_free, seconds, decision.fallback_s, graph, belief)
            best = min(best, value)
    return best


@compiled(error_model="numpy")
def path_value(vertex: int, start_s: float, failure_s: float, decision: Decision) -> tuple[float, float, int]:
    """Evaluate the path of the thesis's planner from a vertex, where the car is after `start_s` and observes, too.

    Return the expected time from now, s; P(nothing found on the path); its first target, or -1.
    """
    graph, scratch = decision.graph, decision.scratch
    scratch.weights[: len(decision.belief.weights)] = decision.belief.weights
    n_observed, k, seconds, sums = 0, 0, start_s, Sums(1.0, 0.0, 0.0)
    # `value` is what the thesis's planner expects from the current vertex: better slots are taken on the way.
    target, value = next_target(vertex, seconds, failure_s, decision)
    first_target = target
    scratch.first[0] = 0
    while True:
        scratch.time[k] = seconds
        scratch.stop_s[k] = best_option(vertex, seconds, decision)
        n_before = n_observed
        n_observed, sums = _observe_here(vertex, seconds, value, n_before, sums, decision)
        scratch.first[k + 1] = n_observed
        if sums.p_none < ENOUGH or k == MOST_STOPS - 1 or n_observed == MOST_OBSERVATIONS:
            break
        if target == vertex or (scratch.slots[n_before:n_observed] == target).any():
            target, value = next_target(vertex, seconds, failure_s, decision)
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
    # After the end, slots are found at the same rate as before.
    rest_s = graph.give_up_s
    if sums.p_free > 1e-6:
        rest_s = min(rest_s, (max(seconds - start_s, graph.wait_s) + sums.cost_s) / sums.p_free)
    for j in range(n_observed):
        scratch.seen_at[scratch.slots[j]] = -1.0
    return start_s + _stop_optimally(k, rest_s, scratch), sums.p_none, first_target


class Sums(NamedTuple):
    p_none: float  # P(no slot that is worth parking in is free)
    p_free: float
    cost_s: float  # weighted by P(free)


@compiled(error_model="numpy")
def _observe_here(
    vertex: int, seconds: float, value: float, n_observed: int, sums: Sums, decision: Decision
) -> tuple[int, Sums]:
    """Add the observations from a vertex, the cheapest first; return the number of all, and their sums."""
    graph, belief, scratch = decision.graph, decision.belief, decision.scratch
    weights, before = scratch.weights[: len(belief.weights)], n_observed
    p_none, p_sum, cost_sum = sums
    for i in range(graph.view_starts[vertex], graph.view_starts[vertex + 1]):
        s = graph.views[i].slot
        at = belief.slots[s]
        if (
            at.state == OBSERVED_FREE
            or n_observed == MOST_OBSERVATIONS
            or is_hidden(s, graph.views[i].rate, belief)
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
                taken_if, p_taken = belief.taken_if[s], 1.0 - p_free
                if belief.evidence[s] < 1.0:
                    p_taken = (weights * taken_if).sum()
                rest = 1.0 / max(p_taken, 1e-9)
                for h in range(len(weights)):
                    weights[h] *= taken_if[h] * rest
        else:
            p_free = p_free_again(s, seconds, scratch.seen_at[s], belief)
            if p_free == 0.0:
                continue
        scratch.slots[n_observed], scratch.seen_at[s] = s, seconds
        j = n_observed
        while j > before and scratch.cost_s[j - 1] > cost_s:
            scratch.cost_s[j], scratch.p_free[j] = scratch.cost_s[j - 1], scratch.p_free[j - 1]
            j -= 1
        scratch.cost_s[j], scratch.p_free[j] = cost_s, p_free
        n_observed += 1
        if cost_s <= value:
            p_none *= 1.0 - p_free
        p_sum += p_free
        cost_sum += p_free * cost_s
    return n_observed, Sums(p_none, p_sum, cost_sum)


@compiled(error_model="numpy")
def _stop_optimally(last: int, rest_s: float, scratch: Scratch) -> float:
    """Return the expected time, s, of a car that stops at the first slot that is better than going on."""
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
    return float(ahead)
