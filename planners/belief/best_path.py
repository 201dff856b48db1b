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

MOST_OPTIONS = 12  # maximum number of slots known to be free that are considered, best first
NOWHERE, ATTEMPT = -1, -2
"""Values of `next_vertex`: there is no path, or the path begins with a parking attempt at the current vertex."""


_ROUNDING_S = 1e-9
"""s by which one path must be better than another, so that rounding does not change the path."""
_IMPROVEMENT_S = 1e-6  # s by which a path must improve to get one more target


class PathChoice(NamedTuple):
    """Result of a search for a path."""

    onward_s: float  # s, expected time of the path
    # s, expected time left after its first step if the car goes on and that step leads to a vertex where nothing new
    # is observed; else inf
    remaining_s: float
    at_hand_s: float  # s, expected time of driving to the best slot that is known now
    slot: int  # that slot, or -1
    next_vertex: int  # the next vertex on the path, `ATTEMPT` or `NOWHERE`
    targets: IntArray  # (k,) int64, the vertices to pass before the path follows the thesis's planner
    failure_s: float  # s, failure cost of that planner on it
    work: int  # evaluation steps spent on inserting targets; exceeds the budget by one candidate at most


class Budget(NamedTuple):
    """Limits of a search for a path."""

    # (k,) float64, s, failure costs at which paths of the thesis's planner are rolled out
    failure_costs: FloatArray
    work: int  # maximum number of evaluation steps; it bounds the time of a decision
    depth: int  # maximum number of targets of a path


class Candidate(NamedTuple):
    """A path's value; fields as in `PathChoice`."""

    onward_s: float
    remaining_s: float
    next_vertex: int
    work: int


def best_path(
    vertex: int,
    targets: IntArray,
    failure_s: float,
    remaining_s: float,
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
        targets: (k,) int64, targets of the last decision's path.
        failure_s: s, failure cost of the last decision's path.
        remaining_s: s, time expected to remain on that path, or inf if something was observed since. The path is kept
            unless another is better than this: estimates depend on the position of the car, so it could turn round for
            ever.
        budget: limits of the search.
        graph: the lot.
        belief: the belief.
        path: buffer for one path.
    """
    return PathChoice(*_best_path(vertex, targets, failure_s, remaining_s, budget, graph, belief, path))


@compiled(error_model="numpy")
def _best_path(
    vertex: int,
    targets: IntArray,
    failure_s: float,
    remaining_s: float,
    budget: Budget,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
    path: PathBuffer,
) -> tuple[float, float, float, int, int, IntArray, float, int]:
    """Return the fields of `PathChoice`."""
    options, fallback_s = _options_at_hand(vertex, budget, graph, belief, path)
    at_hand_s, slot = np.inf, -1
    for s in options:
        value = expected_cost_to_slot(vertex, s, belief.slots[s].p_free, 0.0, fallback_s[s], graph, belief)
        if value < at_hand_s:
            at_hand_s, slot = value, s

    if len(targets) and targets[0] == vertex and not is_worth_an_attempt(vertex, 0.0, -1.0, graph, belief):
        targets = targets[1:]
    best = _evaluate(vertex, targets, failure_s, remaining_s, options, fallback_s, graph, belief, path)
    for cost in budget.failure_costs:
        none = targets[:0]
        found = _evaluate(vertex, none, cost, np.inf, options, fallback_s, graph, belief, path)
        if found.onward_s < best.onward_s - _ROUNDING_S:
            best, targets, failure_s = found, none, cost
    if best.onward_s == np.inf:
        return np.inf, np.inf, at_hand_s, slot, NOWHERE, targets[:0], failure_s, 0

    # Nearest vertices first: with a small budget they matter most for the next step.
    nearest_first = np.argsort(graph.drive_s[vertex])
    work = 0
    for _ in range(budget.depth - len(targets)):
        n_before = len(targets)
        best, targets, work = _insert_target(
            vertex,
            nearest_first,
            best,
            targets,
            failure_s,
            at_hand_s,
            work,
            budget.work,
            options,
            fallback_s,
            graph,
            belief,
            path,
        )
        if len(targets) == n_before:
            break
    return best.onward_s, best.remaining_s, at_hand_s, slot, best.next_vertex, targets, failure_s, work


@compiled(error_model="numpy")
def _insert_target(
    vertex: int,
    nearest_first: IntArray,
    best: Candidate,
    targets: IntArray,
    failure_s: float,
    at_hand_s: float,
    work: int,
    most_work: int,
    options: IntArray,
    fallback_s: FloatArray,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
    path: PathBuffer,
) -> tuple[Candidate, IntArray, int]:
    """Return the best path with one more target, its targets and the work so far; the given path if none is better."""
    n_stops, _ = rollout_path(vertex, targets, failure_s, graph, belief, path)
    on_route = _on_route(vertex, targets, n_stops, graph, path)
    kept, trial = targets, np.empty(len(targets) + 1, np.int64)
    for place in range(len(trial)):
        before = vertex if place == 0 else targets[place - 1]
        trial[:place], trial[place + 1 :] = targets[:place], targets[place:]
        for u in nearest_first:
            drive_s = graph.drive_s[vertex, u]
            if work > most_work or not drive_s < min(best.onward_s, at_hand_s):
                break
            if not is_worth_an_attempt(u, drive_s, -1.0, graph, belief) and (
                u == before or on_route[place, u] or not _shows_news(u, graph, belief)
            ):
                continue
            trial[place] = u
            found = _evaluate(vertex, trial, failure_s, np.inf, options, fallback_s, graph, belief, path)
            work += found.work
            if found.onward_s < best.onward_s - _IMPROVEMENT_S:
                best, kept = found, trial.copy()
    return best, kept, work


@compiled(error_model="numpy")
def _evaluate(
    vertex: int,
    targets: IntArray,
    failure_s: float,
    remaining_s: float,
    options: IntArray,
    fallback_s: FloatArray,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
    path: PathBuffer,
) -> Candidate:
    """Roll out and evaluate a path. If it was expected to take less, `remaining_s`, that is its value."""
    n_stops, left_s = rollout_path(vertex, targets, failure_s, graph, belief, path)
    value, onward_s = evaluate_path(n_stops, left_s, options, fallback_s, graph, belief, path)
    stops = path.stops
    work = 30 * (n_stops + stops[n_stops].first) + len(belief.slots)
    if n_stops < 2:
        return Candidate(np.inf, np.inf, NOWHERE, work)
    if remaining_s < value:
        value, onward_s = remaining_s, remaining_s - stops[1].time
    if stops[1].time == 0.0 and stops[2].first > 0:
        return Candidate(value, np.inf, ATTEMPT, work)  # only an attempt takes no time
    following = stops[1].vertex
    if stops[2].first > 0 or following == vertex:
        onward_s = np.inf
    return Candidate(value, onward_s, following, work)


@compiled(error_model="numpy")
def _options_at_hand(
    vertex: int, budget: Budget, graph: PlanningGraph, belief: BeliefSnapshot, path: PathBuffer
) -> tuple[IntArray, FloatArray]:
    """Return the best slots known to be free, and the remaining time if each slot is gone, s.

    If a slot is gone on arrival, the search continues as if no slot were known to be free, or goes to another slot.
    """
    n = len(belief.slots)
    options, n_options = np.empty(MOST_OPTIONS, np.int64), 0
    fallback_s = np.zeros(n)
    search_s = graph.give_up_s
    for cost in budget.failure_costs:
        found = _evaluate(vertex, options[:0], cost, np.inf, options[:0], fallback_s, graph, belief, path)
        search_s = min(search_s, found.onward_s)
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
    options = options[:n_options]
    for s in range(n):
        fallback_s[s] = search_s
        for o in options:
            if o != s:
                p_free, age = belief.slots[o].p_free, graph.drive_s[vertex, s]
                other_s = expected_cost_to_slot(s, o, p_free, age, search_s, graph, belief)
                fallback_s[s] = min(fallback_s[s], other_s)
    return options, fallback_s


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
def _on_route(
    vertex: int, targets: IntArray, n_stops: int, graph: PlanningGraph, path: PathBuffer
) -> NDArray[np.bool_]:
    """Mark vertices on a shortest route from the path's start or last target: inserting them changes nothing."""
    on_route = np.zeros((len(targets) + 1, len(graph.drive_s)), np.bool_)
    passed, since, origin = 0, 0.0, vertex
    for k in range(n_stops):
        v, time = path.stops[k].vertex, path.stops[k].time
        while passed < len(targets) and targets[passed] == v:
            passed += 1
            since, origin = time, v
        if time - since <= graph.drive_s[origin, v] + _ROUNDING_S:
            on_route[passed, v] = True
    return on_route
