"""Compiled search for the path with the least expected time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import OBSERVED_FREE, OBSERVED_TAKEN, UNOBSERVED
from planners.belief.path_evaluation import evaluate_path, expected_cost_to_slot
from planners.belief.path_rollout import is_worth_an_attempt, rollout_path
from planners.belief.planning_graph import (
    BeliefSnapshot,
    FloatArray,
    IntArray,
    PathBuffer,
    PlanningGraph,
    is_hidden,
)
from sim_sensors.compilation import compiled

MOST_OPTIONS = 12
"""Maximum number of slots known to be free that are considered, best first."""
NOWHERE, ATTEMPT = -1, -2
"""Values of `next_vertex`: there is no path, or the path begins with a parking attempt at the current vertex."""


class PathChoice(NamedTuple):
    """Result of a search for a path.

    Attributes:
        onward_s: s, expected time of the path.
        then_s: s, expected time left after its first step if the car goes on and that step leads to a vertex where
            nothing new is observed; else inf.
        at_hand_s: s, expected time of driving to the best slot that is known now.
        slot: that slot, or -1.
        next_vertex: the next vertex on the path, `ATTEMPT` or `NOWHERE`.
        n_targets: number of targets before the path follows the thesis's planner.
        failure_s: s, failure cost of that planner on it.
        work: evaluation steps spent on inserting targets; exceeds the budget by one candidate at most.
    """

    onward_s: float
    then_s: float
    at_hand_s: float
    slot: int
    next_vertex: int
    n_targets: int
    failure_s: float
    work: int


class Budget(NamedTuple):
    """Limits of a search for a path.

    Attributes:
        failure_costs: (k,) float64, s, failure costs at which paths of the thesis's planner are rolled out.
        work: maximum number of evaluation steps; it bounds the time of a decision.
        depth: maximum number of targets of a path.
    """

    failure_costs: FloatArray
    work: int
    depth: int


@compiled(error_model="numpy")
def best_path(
    vertex: int,
    targets: IntArray,
    n_targets: int,
    failure_s: float,
    promise_s: float,
    budget: Budget,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
    path: PathBuffer,
) -> PathChoice:
    """Search for the path with the least expected time, starting from the path of the last decision.

    Candidates are the paths of the thesis's planner at several failure costs, then the best path with one more target,
    which may be any vertex, inserted at any position. Of equal candidates the first is kept.

    Args:
        vertex: where the car is.
        targets: (depth,) int64, targets of the last decision's path; on return, those of the chosen path.
        n_targets: number of targets of the last decision's path.
        failure_s: s, failure cost of the last decision's path.
        promise_s: s, time expected to remain on that path, or inf if something was observed since. The path is kept
            unless another is better than this: estimates depend on the position of the car, so it could turn round for
            ever.
        budget: limits of the search.
        graph: the lot.
        belief: the belief.
        path: buffer for one path.
    """
    options, n_options, fallback_s = _options_at_hand(vertex, budget, graph, belief, path)
    at_hand_s, slot = np.inf, -1
    for i in range(n_options):
        s = options[i]
        value = expected_cost_to_slot(vertex, s, belief.slots[s].p_free, 0.0, fallback_s[s], graph, belief)
        if value < at_hand_s:
            at_hand_s, slot = value, s

    depth, work = budget.depth, 0
    trial, kept = np.empty(depth, np.int64), np.empty(depth, np.int64)
    best, then_s, next_vertex, n_kept, base = np.inf, np.inf, NOWHERE, 0, failure_s
    if n_targets > 0 and targets[0] == vertex and not is_worth_an_attempt(vertex, 0.0, -1.0, graph, belief):
        for i in range(1, n_targets):
            targets[i - 1] = targets[i]
        n_targets -= 1
    # The last decision's path, then the thesis's planner's at each failure cost.
    for i in range(-1, len(budget.failure_costs)):
        n_tried = n_targets if i < 0 else 0
        cost = failure_s if i < 0 else budget.failure_costs[i]
        n_stops, left_s = rollout_path(vertex, targets, n_tried, cost, graph, belief, path)
        value, onward_s = evaluate_path(n_stops, left_s, options, n_options, fallback_s, graph, belief, path)
        if i < 0 and promise_s < value:
            value, onward_s = promise_s, promise_s - path.stops[1].time
        if value < best - 1e-9:
            best, base, n_kept = value, cost, n_tried
            next_vertex, then_s = _first_step(onward_s, path)
            for j in range(n_tried):
                kept[j] = targets[j]
    if best == np.inf:
        return PathChoice(best, best, at_hand_s, slot, NOWHERE, 0, base, 0)

    # Nearest vertices first: with a small budget they matter most for the next step.
    nearest_first = np.argsort(graph.drive_s[vertex])
    on_route = np.empty((depth, len(graph.drive_s)), np.bool_)
    for _ in range(depth):
        improved = False
        n_before = n_kept
        for j in range(n_kept):
            targets[j] = kept[j]
        if n_before == depth:
            break
        n_stops, left_s = rollout_path(vertex, targets, n_before, base, graph, belief, path)
        _mark_route(on_route, vertex, targets, n_before, n_stops, graph, path)
        for place in range(n_before + 1):
            before = vertex if place == 0 else targets[place - 1]
            for u in nearest_first:
                if work > budget.work or not graph.drive_s[vertex, u] < min(best, at_hand_s):
                    break
                if not is_worth_an_attempt(u, graph.drive_s[vertex, u], -1.0, graph, belief) and (
                    u == before or on_route[place, u] or not _shows_news(u, graph, belief)
                ):
                    continue
                for j in range(place):
                    trial[j] = targets[j]
                trial[place] = u
                for j in range(place, n_before):
                    trial[j + 1] = targets[j]
                n_stops, left_s = rollout_path(vertex, trial, n_before + 1, base, graph, belief, path)
                value, onward_s = evaluate_path(
                    n_stops, left_s, options, n_options, fallback_s, graph, belief, path
                )
                work += 30 * (n_stops + path.stops[n_stops].first) + len(belief.slots)
                if value < best - 1e-6:
                    best, n_kept, improved = value, n_before + 1, True
                    next_vertex, then_s = _first_step(onward_s, path)
                    for j in range(n_kept):
                        kept[j] = trial[j]
        if not improved:
            break
    for j in range(n_kept):
        targets[j] = kept[j]
    return PathChoice(best, then_s, at_hand_s, slot, next_vertex, n_kept, base, work)


@compiled(error_model="numpy")
def _options_at_hand(
    vertex: int,
    budget: Budget,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
    path: PathBuffer,
) -> tuple[IntArray, int, FloatArray]:
    """Return the best slots known to be free, their number, and the remaining time if each slot is gone, s.

    If a slot is gone on arrival, the search continues as if no slot were known to be free, or goes to another slot.
    """
    n = len(belief.slots)
    options, n_options = np.empty(MOST_OPTIONS, np.int64), 0
    fallback_s = np.zeros(n)
    search_s = np.inf
    for i in range(len(budget.failure_costs)):
        cost = budget.failure_costs[i]
        n_stops, left_s = rollout_path(vertex, options, n_options, cost, graph, belief, path)
        value, _ = evaluate_path(n_stops, left_s, options, n_options, fallback_s, graph, belief, path)
        search_s = min(search_s, value)
    search_s = min(search_s, graph.give_up_s)
    expected_s = np.full(MOST_OPTIONS, np.inf)
    for s in range(n):
        if belief.slots[s].state != OBSERVED_FREE:
            continue
        value = expected_cost_to_slot(vertex, s, belief.slots[s].p_free, 0.0, search_s, graph, belief)
        if n_options < MOST_OPTIONS:
            place = n_options
            n_options += 1
        elif value < expected_s[MOST_OPTIONS - 1]:
            place = MOST_OPTIONS - 1
        else:
            continue
        while place > 0 and expected_s[place - 1] > value:
            expected_s[place], options[place] = expected_s[place - 1], options[place - 1]
            place -= 1
        expected_s[place], options[place] = value, s
    for s in range(n):
        fallback_s[s] = search_s
        for i in range(n_options):
            o = options[i]
            if o != s:
                p_free, age = belief.slots[o].p_free, graph.drive_s[vertex, s]
                other_s = expected_cost_to_slot(s, o, p_free, age, search_s, graph, belief)
                fallback_s[s] = min(fallback_s[s], other_s)
    return options, n_options, fallback_s


@compiled(error_model="numpy")
def _first_step(onward_s: float, path: PathBuffer) -> tuple[int, float]:
    """Return `next_vertex` and `then_s` of a path, given `onward_s` for the case that nothing is observed."""
    stops = path.stops
    if stops[1].time == 0.0 and stops[2].first > 0:
        return ATTEMPT, np.inf  # only an attempt takes no time
    following = stops[1].vertex
    if stops[2].first > 0 or following == stops[0].vertex:
        return following, np.inf
    return following, onward_s


@compiled(error_model="numpy")
def _shows_news(vertex: int, graph: PlanningGraph, belief: BeliefSnapshot) -> bool:
    """Return whether any slot in view of a vertex is unobserved or may have become free."""
    for i in range(graph.view_starts[vertex], graph.view_starts[vertex + 1]):
        view = graph.views[i]
        if is_hidden(view.slot, view.rate, belief):
            continue
        at = belief.slots[view.slot]
        if at.state == UNOBSERVED or (at.state == OBSERVED_TAKEN and at.decay_rate > 0.0):
            return True
    return False


@compiled(error_model="numpy")
def _mark_route(
    on_route: NDArray[np.bool_],
    vertex: int,
    targets: IntArray,
    n_targets: int,
    n_stops: int,
    graph: PlanningGraph,
    path: PathBuffer,
) -> None:
    """Mark vertices on a shortest route from the path's start or last target: inserting them changes nothing."""
    on_route[:] = False
    passed, since, origin = 0, 0.0, vertex
    for k in range(n_stops):
        v, time = path.stops[k].vertex, path.stops[k].time
        while passed < n_targets and targets[passed] == v:
            passed += 1
            since, origin = time, v
        if time - since <= graph.drive_s[origin, v] + 1e-9:
            on_route[passed, v] = True
