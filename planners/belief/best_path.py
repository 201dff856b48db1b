"""Search for the path with the least expected time.

Candidates are the paths of the thesis's planner at several failure costs, then the best path with one more target,
which may be any vertex, inserted at any position. Of equal candidates the first is kept.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import OBSERVED_TAKEN, UNOBSERVED
from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled, kernel
from planners.belief.path import (
    Budget,
    Course,
    Search,
    evaluate_path,
    expected_cost_to_slot,
    is_worth_an_attempt,
    options_at_hand,
    rollout_path,
)
from planners.belief.planning_graph import BeliefSnapshot, PathBuffer, PlanningGraph, Records, is_hidden

MOST_OPTIONS = 12  # maximum number of slots known to be free that are considered, best first
NOWHERE, ATTEMPT = -1, -2
"""Values of `next_vertex`: there is no path, or the path begins with a parking attempt at the current vertex."""

_ROUNDING_S = 1e-9
"""s by which one path must be better than another, so that rounding does not change the path."""
_IMPROVEMENT_S = 1e-6  # s by which a path must improve to get one more target


class Value(NamedTuple):
    """Value of a path: expected time to its end, and what is left of it after the first step."""

    expected_s: float
    # s, expected time left after its first step if the car goes on and that step leads to a vertex where no slot is
    # observed for the first time; else inf
    remaining_s: float
    next_vertex: int  # the next vertex, `ATTEMPT` or `NOWHERE`


class PathChoice(NamedTuple):
    """Result of a search for a path."""

    value: Value
    at_hand_s: float  # s, expected time of driving to the best slot that is known now
    slot: int  # that slot, or -1
    work: int  # evaluation steps spent on inserting targets; exceeds the budget by one candidate at most
    course: Course


def best_path(
    vertex: int,
    course: Course,
    remaining_s: float,
    budget: Budget,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
    paths: PathBuffer,
) -> PathChoice:
    """Search for the path with the least expected time, starting from the path of the last decision.

    It is kept unless another one is better than `remaining_s`, the time expected to remain on it, or inf if something
    was observed since: estimates depend on the position of the car, so it could turn round for ever. `paths` are
    buffers, one more than there are failure costs.
    """
    # Nearest vertices first: with a small budget they matter most for the next step.
    order = np.argsort(graph.drive_s[vertex], kind="stable")
    search = Search(vertex, order, graph, belief, np.empty(0, np.int64), np.zeros(len(belief.slots)), budget)
    choice: PathChoice = _best_path(course, remaining_s, search, paths)
    return choice


def is_compiled() -> bool:
    return bool(getattr(_best_path, "signatures", True))


@compiled(error_model="numpy")
def _best_path(course: Course, remaining_s: float, search: Search, paths: PathBuffer) -> PathChoice:
    """Choose, for a search that has no options yet."""
    vertex, graph, belief, costs = search.vertex, search.graph, search.belief, search.budget.failure_costs
    search_s = _plans(course.failure_s, search, paths)
    c = np.argmin(search_s)
    options, fallback_s = _options_and_fallbacks(vertex, search_s[c], graph, belief)
    search = Search(vertex, search.nearest_first, graph, belief, options, fallback_s, search.budget)
    at_hand_s, slot = np.inf, -1
    for s in options:
        value = expected_cost_to_slot(vertex, s, belief.slots[s].p_free, 0.0, fallback_s[s], graph, belief)
        if value < at_hand_s:
            at_hand_s, slot = value, s

    targets = course.targets
    if len(targets) and targets[0] == vertex and not is_worth_an_attempt(vertex, 0.0, -1.0, graph, belief):
        targets = targets[1:]
    path = chosen = _path_at(len(costs), paths)
    course = Course(targets, course.heading, course.failure_s)
    rollout_path(course, search, path)
    best = _evaluate(remaining_s, search, path)
    # The known free slots make the others better, too, so from there on these cannot become the best.
    while search_s[c] < best.expected_s:
        plan = _path_at(c, paths)
        plan_value = _evaluate(np.inf, search, plan)
        if plan_value.expected_s < best.expected_s - _ROUNDING_S:
            best, chosen, course = plan_value, plan, Course(targets[:0], -1, costs[c])
        search_s[c] = np.inf
        c = np.argmin(search_s)
    if best.expected_s == np.inf:
        return PathChoice(best, at_hand_s, slot, 0, Course(targets[:0], -1, course.failure_s))

    work, heading = 0, chosen.stops[1].target
    for _ in range(search.budget.depth - len(course.targets)):
        n_before = len(course.targets)
        on_route = _on_route(course.targets, search, chosen)
        best, course, work = _insert_target(best, course, on_route, at_hand_s, work, search, path)
        if len(course.targets) == n_before:
            break
        chosen = path
        rollout_path(course, search, path)
    if len(course.targets):
        heading = -1
    return PathChoice(best, at_hand_s, slot, work, Course(course.targets, heading, course.failure_s))


@compiled(error_model="numpy")
def _plans(failure_s: float, search: Search, paths: PathBuffer) -> FloatArray:
    """Roll out and evaluate paths of the thesis's planner, each into its own buffer.

    From the failure cost of the last decision on, lower and higher costs are tried as long as they make the path
    better; all of them where there was none. Return their expected times, (k,) s; inf for those left out.
    """
    costs = search.budget.failure_costs
    n = len(costs)
    start, search_s = n, np.full(n, np.inf)
    for c in range(n):
        if costs[c] == failure_s:
            start = c
    least_s = np.inf
    for c in range(start, n):
        value = _plan(c, search_s, search, paths)
        if value > least_s:
            break
        least_s = min(least_s, value)
    least_s = search_s[start] if start < n else np.inf
    for c in range(start - 1, -1, -1):
        value = _plan(c, search_s, search, paths)
        if value > least_s and start < n:
            break
        least_s = min(least_s, value)
    return search_s


@compiled(error_model="numpy")
def _plan(c: int, search_s: FloatArray, search: Search, paths: PathBuffer) -> float:
    """Roll out the path of one failure cost; return its expected time, s. One that is there already is left out."""
    path = _path_at(c, paths)
    rollout_path(Course(np.empty(0, np.int64), -1, search.budget.failure_costs[c]), search, path)
    state = path.state[0]
    for other in range(len(search_s)):
        before = paths.state[other, 0]
        if (
            search_s[other] < np.inf
            and before.n_stops == state.n_stops
            and before.left_s == state.left_s
            and _are_equal(path.stops[: state.n_stops + 1], paths.stops[other, : state.n_stops + 1])
        ):
            return float(search_s[other])
    search_s[c] = _evaluate(np.inf, search, path).expected_s
    return float(search_s[c])


@kernel
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
    best: Value,
    course: Course,
    on_route: NDArray[np.bool_],
    at_hand_s: float,
    work: int,
    search: Search,
    path: PathBuffer,
) -> tuple[Value, Course, int]:
    """Return the best path with one more target, its course and the work so far; the given path if none is better."""
    vertex, graph, belief, targets = search.vertex, search.graph, search.belief, course.targets
    best_targets, trial = targets, np.empty(len(targets) + 1, np.int64)
    for place in range(len(trial)):
        before = vertex if place == 0 else targets[place - 1]
        for k in range(len(targets)):
            trial[k + (k >= place)] = targets[k]
        for u in search.nearest_first:
            drive_s = graph.drive_s[vertex, u]
            if work > search.budget.work or not drive_s < min(best.expected_s, at_hand_s):
                break
            if not is_worth_an_attempt(u, drive_s, -1.0, graph, belief) and (
                u == before or on_route[place, u] or not _shows_news(u, graph, belief)
            ):
                continue
            trial[place] = u
            rollout_path(Course(trial, -1, course.failure_s), search, path)
            n_stops = path.state[0].n_stops
            work += 30 * (n_stops + path.stops[n_stops].first) + len(belief.slots)
            value = _evaluate(np.inf, search, path)
            if value.expected_s < best.expected_s - _IMPROVEMENT_S:
                best, best_targets = value, trial.copy()
    return best, Course(best_targets, -1, course.failure_s), work


@kernel
def _evaluate(planned_s: float, search: Search, path: PathBuffer) -> Value:
    """Evaluate a path. If it was expected to take less, `planned_s`, that is its value."""
    if path.state[0].n_stops < 2:
        return Value(np.inf, np.inf, NOWHERE)
    expected_s, remaining_s = evaluate_path(search, path)
    stops = path.stops
    if planned_s < expected_s:
        expected_s, remaining_s = planned_s, planned_s - stops[1].time
    if stops[1].time == 0.0 and stops[2].first > 0:
        return Value(expected_s, np.inf, ATTEMPT)  # only an attempt takes no time
    following = stops[1].vertex
    if following == search.vertex:
        remaining_s = np.inf
    for j in range(stops[2].first):
        if path.observations[j].is_first:
            remaining_s = np.inf
    return Value(expected_s, remaining_s, following)


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


@kernel
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
def _on_route(targets: IntArray, search: Search, path: PathBuffer) -> NDArray[np.bool_]:
    """Mark vertices on a shortest route from the path's start or last target: inserting them changes nothing."""
    drive_s = search.graph.drive_s
    on_route = np.zeros((len(targets) + 1, len(drive_s)), np.bool_)
    passed, since, origin = 0, 0.0, search.vertex
    for k in range(path.state[0].n_stops):
        v, time = path.stops[k].vertex, path.stops[k].time
        while passed < len(targets) and targets[passed] == v:
            passed += 1
            since, origin = time, v
        if time - since <= drive_s[origin, v] + _ROUNDING_S:
            on_route[passed, v] = True
    return on_route


@compiled(error_model="numpy")
def _path_at(index: int, paths: PathBuffer) -> PathBuffer:
    return PathBuffer(
        paths.state[index], paths.stops[index], paths.observations[index], paths.marks, paths.weights,
        paths.remembered, paths.kept_s, paths.value_s,
    )  # fmt: skip
