"""Compiled search for the path with the least expected time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import OBSERVED_TAKEN, UNOBSERVED
from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled
from planners.belief.path_evaluation import evaluate_path, expected_cost_to_slot, options_at_hand
from planners.belief.path_rollout import is_worth_an_attempt, rollout_path
from planners.belief.planning_graph import (
    BeliefSnapshot,
    PathBuffer,
    PathBuffers,
    PlanningGraph,
    Records,
    is_hidden,
    leaf,
)

MOST_OPTIONS = 12  # maximum number of slots known to be free that are considered, best first
NOWHERE, ATTEMPT = -1, -2
"""Values of `next_vertex`: there is no path, or the path begins with a parking attempt at the current vertex."""


_ROUNDING_S = 1e-9
"""s by which one path must be better than another, so that rounding does not change the path."""
_IMPROVEMENT_S = 1e-6  # s by which a path must improve to get one more target


class PathChoice(NamedTuple):
    """Result of a search for a path."""

    onward_s: float  # s, expected time of the path
    # s, expected time left after its first step if the car goes on and that step leads to a vertex where no slot is
    # observed for the first time; else inf
    remaining_s: float
    at_hand_s: float  # s, expected time of driving to the best slot that is known now
    slot: int  # that slot, or -1
    next_vertex: int  # the next vertex on the path, `ATTEMPT` or `NOWHERE`
    targets: IntArray  # (k,) int64, the vertices to pass before the path follows the thesis's planner
    heading: int  # without targets, the slot that the path drives to first; else -1
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


def best_path(
    vertex: int,
    targets: IntArray,
    heading: int,
    failure_s: float,
    remaining_s: float,
    budget: Budget,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
    paths: PathBuffers,
) -> PathChoice:
    """Search for the path with the least expected time, starting from the path of the last decision.

    Candidates are the paths of the thesis's planner at several failure costs, then the best path with one more target,
    which may be any vertex, inserted at any position. Of equal candidates the first is kept.

    Args:
        vertex: where the car is.
        targets: (k,) int64, targets of the last decision's path.
        heading: the slot that it was driving to, if it had none; -1: to one that was observed since.
        failure_s: s, failure cost of the last decision's path.
        remaining_s: s, time expected to remain on that path, or inf if something was observed since. The path is kept
            unless another is better than this: estimates depend on the position of the car, so it could turn round for
            ever.
        budget: limits of the search.
        graph: the lot.
        belief: the belief.
        paths: buffers, one more than there are failure costs.
    """
    # Nearest vertices first: with a small budget they matter most for the next step.
    order = np.argsort(graph.drive_s[vertex], kind="stable")
    return PathChoice(
        *_best_path(vertex, targets, heading, failure_s, remaining_s, budget, order, graph, belief, paths)
    )


def is_compiled() -> bool:
    """Return whether this process has the code of `best_path`."""
    return bool(getattr(_best_path, "signatures", True))


@compiled(error_model="numpy")
def _best_path(
    vertex: int,
    targets: IntArray,
    heading: int,
    failure_s: float,
    remaining_s: float,
    budget: Budget,
    nearest_first: IntArray,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
    paths: PathBuffers,
) -> tuple[float, float, float, int, int, IntArray, int, float, int]:
    """Return the fields of `PathChoice`."""
    costs = budget.failure_costs
    plans = _plans(vertex, failure_s, costs, graph, belief, paths)
    c = _least(plans.search_s)
    options, fallback_s = _options_and_fallbacks(vertex, plans.search_s[c], graph, belief)
    at_hand_s, slot = np.inf, -1
    for s in options:
        value = expected_cost_to_slot(vertex, s, belief.slots[s].p_free, 0.0, fallback_s[s], graph, belief)
        if value < at_hand_s:
            at_hand_s, slot = value, s

    if len(targets) and targets[0] == vertex and not is_worth_an_attempt(vertex, 0.0, -1.0, graph, belief):
        targets = targets[1:]
    path = _path_at(len(costs), paths)
    n_stops, left_s = rollout_path(vertex, targets, heading, failure_s, graph, belief, path)
    heading = path.stops[1].target
    best = _evaluate(vertex, n_stops, left_s, remaining_s, options, fallback_s, graph, belief, path)
    chosen = path
    # The known free slots make the others better, too, so from there on these cannot become the best.
    while plans.search_s[c] < best.onward_s:
        plan = _path_at(c, paths)
        found = _evaluate(
            vertex, plans.n_stops[c], plans.left_s[c], np.inf, options, fallback_s, graph, belief, plan
        )
        if found.onward_s < best.onward_s - _ROUNDING_S:
            best, targets, heading, failure_s, chosen, n_stops = (
                found,
                targets[:0],
                plan.stops[1].target,
                costs[c],
                plan,
                plans.n_stops[c],
            )
        plans.search_s[c] = np.inf
        c = _least(plans.search_s)
    if best.onward_s == np.inf:
        return np.inf, np.inf, at_hand_s, slot, NOWHERE, targets[:0], -1, failure_s, 0

    work = 0
    for _ in range(budget.depth - len(targets)):
        n_before = len(targets)
        on_route = _on_route(vertex, targets, n_stops, graph, chosen)
        best, targets, work = _insert_target(
            vertex,
            nearest_first,
            on_route,
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
        chosen = path
        n_stops, _ = rollout_path(vertex, targets, -1, failure_s, graph, belief, path)
    if len(targets):
        heading = -1
    return (
        best.onward_s,
        best.remaining_s,
        at_hand_s,
        slot,
        best.next_vertex,
        targets,
        heading,
        failure_s,
        work,
    )


class Plans(NamedTuple):
    """Paths of the thesis's planner at several failure costs, rolled out into buffers of their own."""

    n_stops: IntArray  # (k,) int64, number of stops
    left_s: FloatArray  # (k,) float64, s, expected time after the end if nothing was found
    # (k,) float64, s, expected time of the search if no slot is known to be free; inf for paths that were left out
    search_s: FloatArray


@compiled(error_model="numpy")
def _plans(
    vertex: int,
    failure_s: float,
    costs: FloatArray,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
    paths: PathBuffers,
) -> Plans:
    """Roll out and evaluate paths of the thesis's planner.

    From the failure cost of the last decision on, lower and higher costs are tried as long as they make the path
    better; all of them where there was none. A path that another cost leads to as well is left out.
    """
    n = len(costs)
    plans = Plans(np.zeros(n, np.int64), np.empty(n), np.full(n, np.inf))
    start = n
    for c in range(n):
        if costs[c] == failure_s:
            start = c
    least_s = np.inf
    for c in range(start, n):
        value = _plan(c, vertex, costs, graph, belief, paths, plans)
        if value > least_s:
            break
        least_s = min(least_s, value)
    least_s = plans.search_s[start] if start < n else np.inf
    for c in range(start - 1, -1, -1):
        value = _plan(c, vertex, costs, graph, belief, paths, plans)
        if value > least_s and start < n:
            break
        least_s = min(least_s, value)
    return plans


@compiled(error_model="numpy")
def _plan(
    c: int,
    vertex: int,
    costs: FloatArray,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
    paths: PathBuffers,
    plans: Plans,
) -> float:
    """Roll out and evaluate the path of one failure cost; return its expected time, s."""
    path = _path_at(c, paths)
    n_stops, left_s = rollout_path(vertex, np.empty(0, np.int64), -1, costs[c], graph, belief, path)
    plans.n_stops[c], plans.left_s[c] = n_stops, left_s
    for other in range(len(costs)):
        if (
            plans.search_s[other] < np.inf
            and plans.n_stops[other] == n_stops
            and plans.left_s[other] == left_s
            and _are_equal(paths.stops[c, : n_stops + 1], paths.stops[other, : n_stops + 1])
        ):
            return float(plans.search_s[other])
    no_options, no_fallback_s = np.empty(0, np.int64), np.zeros(len(belief.slots))
    found = _evaluate(vertex, n_stops, left_s, np.inf, no_options, no_fallback_s, graph, belief, path)
    plans.search_s[c] = found.onward_s
    return float(found.onward_s)


@leaf
def _least(values: FloatArray) -> int:
    """Return the index of the least value, the first of equal ones."""
    least = 0
    for i in range(1, len(values)):
        if values[i] < values[least]:
            least = i
    return least


@leaf
def _are_equal(stops: Records, others: Records) -> bool:
    """Return whether two paths observe the same slots at the same times, given equal numbers of stops."""
    for k in range(len(stops)):
        if stops[k].first != others[k].first:
            return False
        if k < len(stops) - 1 and (stops[k].vertex != others[k].vertex or stops[k].time != others[k].time):
            return False
    return True


@compiled(error_model="numpy")
def _insert_target(
    vertex: int,
    nearest_first: IntArray,
    on_route: NDArray[np.bool_],
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
    kept, trial = targets, np.empty(len(targets) + 1, np.int64)
    for place in range(len(trial)):
        before = vertex if place == 0 else targets[place - 1]
        for k in range(len(targets)):
            trial[k + (k >= place)] = targets[k]
        for u in nearest_first:
            drive_s = graph.drive_s[vertex, u]
            if work > most_work or not drive_s < min(best.onward_s, at_hand_s):
                break
            if not is_worth_an_attempt(u, drive_s, -1.0, graph, belief) and (
                u == before or on_route[place, u] or not _shows_news(u, graph, belief)
            ):
                continue
            trial[place] = u
            n_stops, left_s = rollout_path(vertex, trial, -1, failure_s, graph, belief, path)
            work += 30 * (n_stops + path.stops[n_stops].first) + len(belief.slots)
            found = _evaluate(vertex, n_stops, left_s, np.inf, options, fallback_s, graph, belief, path)
            if found.onward_s < best.onward_s - _IMPROVEMENT_S:
                best, kept = found, trial.copy()
    return best, kept, work


@leaf
def _evaluate(
    vertex: int,
    n_stops: int,
    left_s: float,
    remaining_s: float,
    options: IntArray,
    fallback_s: FloatArray,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
    path: PathBuffer,
) -> Candidate:
    """Evaluate a path. If it was expected to take less, `remaining_s`, that is its value."""
    if n_stops < 2:
        return Candidate(np.inf, np.inf, NOWHERE)
    value, onward_s = evaluate_path(n_stops, left_s, options, fallback_s, graph, belief, path)
    stops = path.stops
    if remaining_s < value:
        value, onward_s = remaining_s, remaining_s - stops[1].time
    if stops[1].time == 0.0 and stops[2].first > 0:
        return Candidate(value, np.inf, ATTEMPT)  # only an attempt takes no time
    following = stops[1].vertex
    if following == vertex:
        onward_s = np.inf
    for j in range(stops[2].first):
        if path.observations[j].is_first:
            onward_s = np.inf
    return Candidate(value, onward_s, following)


@compiled(error_model="numpy")
def _options_and_fallbacks(
    vertex: int, search_s: float, graph: PlanningGraph, belief: BeliefSnapshot
) -> tuple[IntArray, FloatArray]:
    """Return the best slots known to be free, and the remaining time if each slot is gone, s.

    If a slot is gone on arrival, the search continues as if no slot were known to be free, for `search_s`, or goes to
    another slot.
    """
    n = len(belief.slots)
    fallback_s, search_s = np.zeros(n), min(search_s, graph.give_up_s)
    options = options_at_hand(vertex, search_s, MOST_OPTIONS, graph, belief)
    for s in range(n):
        fallback_s[s] = search_s
        for o in options:
            if o != s:
                p_free, age = belief.slots[o].p_free, graph.drive_s[vertex, s]
                other_s = expected_cost_to_slot(s, o, p_free, age, search_s, graph, belief)
                fallback_s[s] = min(fallback_s[s], other_s)
    return options, fallback_s


@leaf
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


@compiled(error_model="numpy")
def _path_at(index: int, paths: PathBuffers) -> PathBuffer:
    """Return the buffer of one path. Paths share their scratch arrays."""
    return PathBuffer(
        paths.stops[index],
        paths.observations[index],
        paths.marks,
        paths.weights,
        paths.remembered,
        paths.kept_s,
        paths.value_s,
    )
