"""Rollout of a path: where the car would observe next while all slots that it observes are taken.

The time that remains at the end of a path is that of driving a part of it repeatedly until a slot becomes free, or of
standing and waiting for one. In an almost full lot this is most of the total time.
"""

from __future__ import annotations

import numpy as np

from parkenv.belief.slot_belief import OBSERVED_FREE, OBSERVED_TAKEN, UNOBSERVED
from parkenv.compiled.arrays import FloatArray, IntArray
from planners.belief.planning_graph import (
    BeliefSnapshot,
    PathBuffer,
    PlanningGraph,
    decayed_part,
    is_hidden,
    leaf,
    mean_over_days,
    needs_attempt,
    reset_weights,
)

NEGLIGIBLE = 0.002
"""P(no slot worth stopping for was found) at which a path ends; the remaining time is estimated."""
WORTH_OBSERVING = 0.1
"""Fraction of its usual P(free) from which a slot observed taken is worth another observation."""
OBSERVE_AGAIN_S = 10.0
"""s between observations of the same slot; a later observation makes up for those left out."""


@leaf
def rollout_path(
    vertex: int,
    targets: IntArray,
    heading: int,
    failure_s: float,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
    path: PathBuffer,
) -> tuple[int, float]:
    """Roll out a path: past the targets, then along the thesis's plan while all observed slots are taken.

    It may return to slots observed taken once they are likely enough to be free again.

    Args:
        vertex: where the car is.
        targets: (k,) int64, vertices to pass first, in order.
        heading: without targets, the slot that the plan drives to first; -1: it has to choose one.
        failure_s: s, failure cost of the thesis's planner.
        graph: the lot.
        belief: the belief.
        path: output buffer.

    Returns:
        The number of stops, and the expected time, s, after its end if nothing was found.
    """
    stops, observations, marks = path.stops, path.observations, path.marks
    n = len(belief.slots)
    # A part of a lot can never be proven full: count one more unobserved slot.
    n_unproven = 0 if graph.whole else 1
    n_unobserved = 0 if graph.whole else n
    for s in range(n):
        state = belief.slots[s].state
        marks[s].observed_at = -np.inf if state == OBSERVED_FREE else -1.0
        if state == UNOBSERVED and graph.drive_s[vertex, s] < np.inf:
            n_unobserved += 1
        if state != OBSERVED_TAKEN:
            n_unproven += 1
    stops[0].vertex, stops[0].time, stops[0].first, stops[1].first = vertex, 0.0, 0, 0
    k, n_observations, time, n_passed = 0, 0, 0.0, 0
    choose, target = heading < 0, heading
    reset_weights(belief, path)
    weights = path.weights[: len(belief.weights)]
    while k + 3 < len(stops) and n_observations < len(observations):
        while n_passed < len(targets) and _is_settled(targets[n_passed], vertex, time, graph, belief, path):
            n_passed += 1
            choose = True
        if n_passed < len(targets):
            target = targets[n_passed]
        elif choose or target == vertex:
            target, value = _next_target(vertex, time, failure_s, graph, belief, path)
            if target < 0:
                break
            choose = False
            if _p_nothing_found(vertex, value, n_observations, graph, path) <= NEGLIGIBLE:
                break
        if target == vertex:
            time += 0.0 if _is_attempt_due(vertex, time, graph, belief, path) else graph.wait_s
        else:
            following = int(graph.next_vertex[vertex, target])
            time += graph.drive_s[vertex, following]
            vertex = following
        k += 1
        stops[k].vertex, stops[k].time, stops[k].target = vertex, time, target
        # Observations from here, and the result of an attempt if they do not show the target.
        n_views = graph.view_starts[vertex + 1] - graph.view_starts[vertex]
        for i in range(n_views + 1):
            if n_observations == len(observations):
                break
            attempts = i == n_views
            if attempts:
                s = vertex
                if vertex != target or not _is_attempt_due(vertex, time, graph, belief, path):
                    continue
            else:
                view = graph.views[graph.view_starts[vertex] + i]
                s = view.slot
                observed_at = marks[s].observed_at
                if observed_at == -np.inf or (observed_at >= 0.0 and time - observed_at < OBSERVE_AGAIN_S):
                    continue
                if is_hidden(s, view.rate, belief):
                    continue
            is_first = belief.slots[s].state == UNOBSERVED and marks[s].observed_at < 0.0
            if is_first:
                p_free = p_free_when_first_observed(weights, belief.p_free_if[s], True)
                n_unproven -= 1
                n_unobserved -= 1
            else:
                p_free = p_free_again(s, time, marks[s].observed_at, belief)
                if p_free == 0.0 and not attempts:
                    continue
            observation = observations[n_observations]
            observation.slot, observation.p_free, observation.time, observation.is_first = (
                s,
                p_free,
                time,
                is_first,
            )
            marks[s].observed_at = time
            n_observations += 1
            # The target stays the best choice until it is observed: the others only get worse.
            choose = choose or s == target
            if attempts:
                # The path continues only if the attempt failed.
                time += graph.failure_s
        stops[k + 1].first = n_observations
        if n_unproven == 0:
            # The last observation proves the lot full if it shows no free slot; it may be better to avoid it.
            p_none, cost_s = 1.0, np.inf
            for j in range(stops[k].first, n_observations):
                p_none *= 1.0 - observations[j].p_free
                cost_s = min(cost_s, graph.cost_s[observations[j].slot])
            proof_s = time - stops[k - 1].time + p_none * graph.give_up_s + (1.0 - p_none) * cost_s
            spared_s = _repeat_path(k - 1, stops[k].first, graph, belief, path)
            if spared_s >= proof_s:
                return k + 1, graph.give_up_s
            if k == 1:
                stops[1].vertex, stops[1].time, stops[2].first = stops[0].vertex, graph.wait_s, 0
                stops[1].target = -1
                return 2, spared_s
            return k, spared_s
    # Half of the path is representative of what follows if at least as many slots are still unobserved.
    left_s = np.inf
    if n_unobserved >= n_observations - stops[k // 2].first:
        left_s = _extrapolate(k, n_observations, graph, path)
    return k + 1, min(left_s, _repeat_path(k, n_observations, graph, belief, path), graph.give_up_s)


@leaf
def _is_settled(
    target: int, vertex: int, time: float, graph: PlanningGraph, belief: BeliefSnapshot, path: PathBuffer
) -> bool:
    """Return whether a target is unreachable from a vertex or has nothing left to observe or attempt."""
    if target != vertex:
        return bool(graph.next_vertex[vertex, target] < 0)
    return not _is_attempt_due(vertex, time, graph, belief, path)


@leaf
def is_worth_an_attempt(
    vertex: int, time: float, observed_at: float, graph: PlanningGraph, belief: BeliefSnapshot
) -> bool:
    """Return whether to attempt to park at a vertex at a given time from now; `observed_at` as in `MARK`."""
    if not needs_attempt(vertex, graph, belief):
        return False
    if belief.slots[vertex].state == UNOBSERVED and observed_at < 0.0:
        return True
    return bool(p_free_again(vertex, time, observed_at, belief) > 0.0)


@leaf
def _is_attempt_due(
    vertex: int, time: float, graph: PlanningGraph, belief: BeliefSnapshot, path: PathBuffer
) -> bool:
    """Return whether to attempt to park at a vertex that a path has reached."""
    if vertex >= len(path.marks):
        return False
    return bool(is_worth_an_attempt(vertex, time, path.marks[vertex].observed_at, graph, belief))


@leaf
def _repeat_path(
    last: int, n_observations: int, graph: PlanningGraph, belief: BeliefSnapshot, path: PathBuffer
) -> float:
    """Return the expected time, s, from a stop on if a part of the path is driven repeatedly."""
    best, leaving, cost_s = np.inf, 0.0, 0.0
    vertex = path.stops[last].vertex
    for i in range(graph.view_starts[vertex], graph.view_starts[vertex + 1]):
        s = graph.views[i].slot
        if is_hidden(s, graph.views[i].rate, belief):
            continue
        if path.marks[s].observed_at >= 0.0 or belief.slots[s].state == OBSERVED_TAKEN:
            leaves = belief.slots[s].leaving
            leaving += leaves
            cost_s += leaves * graph.cost_s[s]
    if leaving > 0.0:
        # Alternatively the car stands and waits for a slot in view.
        best = (1.0 + cost_s) / leaving
    weights = path.weights[: len(belief.weights)]
    for j in range(n_observations):
        observation = path.observations[j]
        observation.value = mean_over_days(weights, belief.p_free_if[observation.slot])
    for quarter in range(4):
        best = min(best, _repeat_part(quarter * last // 4, last, n_observations, graph, belief, path))
    return best


@leaf
def _repeat_part(
    first: int, last: int, n_observations: int, graph: PlanningGraph, belief: BeliefSnapshot, path: PathBuffer
) -> float:
    """Return the expected time, s, of driving a part of a path repeatedly until a slot on it becomes free.

    All its slots were just observed taken. The probability that an observation finds its slot free follows from the
    time since the previous observation of that slot, so frequent observations of few slots are not overrated.
    """
    stops, observations, marks = path.stops, path.observations, path.marks
    start, end = stops[first].vertex, stops[last].vertex
    period = stops[last].time - stops[first].time + graph.drive_s[end, start]
    if end == start:
        period = max(period, graph.wait_s)
    for j in range(stops[first].first, n_observations):
        marks[observations[j].slot].scratch = -1.0
    found, cost_s = 0.0, 0.0
    for j in range(stops[first].first, n_observations):
        s = observations[j].slot
        before = marks[s].scratch
        gap = (
            observations[j].time - before
            if before >= 0.0
            else period - (marks[s].observed_at - observations[j].time)
        )
        marks[s].scratch = observations[j].time
        at, usual = belief.slots[s], observations[j].value
        p_free = usual * decayed_part(at.decay_rate * at.p_free_usual / usual, gap)
        found += p_free
        cost_s += p_free * graph.cost_s[s]
    return period / found + cost_s / found if found > 0.0 else np.inf


@leaf
def _extrapolate(last: int, n_observations: int, graph: PlanningGraph, path: PathBuffer) -> float:
    """Return the expected time, s, of going on to unobserved slots like those on the second half of the path."""
    stops, observations = path.stops, path.observations
    first = last // 2
    found, cost_s = 0.0, 0.0
    for j in range(stops[first].first, n_observations):
        found += observations[j].p_free
        cost_s += observations[j].p_free * graph.cost_s[observations[j].slot]
    return (stops[last].time - stops[first].time) / found + cost_s / found if found > 0.0 else np.inf


@leaf
def p_free_again(slot: int, time: float, observed_at: float, belief: BeliefSnapshot) -> float:
    """Return P(free) at a given time of a slot observed taken, in fact or along a path; 0 if too low or too soon.

    Args:
        slot: the slot.
        time: s from now.
        observed_at: s from now, when the path observed the slot last; negative if it did not.
        belief: the belief.
    """
    at = belief.slots[slot]
    if observed_at >= 0.0:
        if time - observed_at < OBSERVE_AGAIN_S:
            return 0.0
        p_free = at.p_free_usual * decayed_part(at.decay_rate, time - observed_at)
    else:
        p_free = at.p_free + (at.p_free_usual - at.p_free) * decayed_part(at.decay_rate, time)
    return float(p_free) if p_free >= WORTH_OBSERVING * at.p_free_usual else 0.0


@leaf
def _next_target(
    vertex: int, time: float, failure_s: float, graph: PlanningGraph, belief: BeliefSnapshot, path: PathBuffer
) -> tuple[int, float]:
    """Return the slot that the thesis's planner would drive to at a given time of a path, and its expected time, s.

    With γ = 1 its plan is to drive to one slot and to attempt it until it is free: drive + cost + failure_s·(1 - p)/p.
    """
    best, chosen = np.inf, -1
    drive_s = graph.drive_s[vertex]
    for s in range(len(belief.slots)):
        value = drive_s[s] + graph.cost_s[s]
        if value >= best:
            continue
        at, observed_at = belief.slots[s], path.marks[s].observed_at
        if observed_at == -np.inf:
            continue
        if at.state == UNOBSERVED and observed_at < 0.0:
            value += failure_s * at.odds
        else:
            if value + failure_s * at.least_odds >= best:
                continue
            p_free = p_free_again(s, time + drive_s[s], observed_at, belief)
            value += failure_s * (1.0 - p_free) / p_free if p_free > 0.0 else np.inf
        if value < best:
            best, chosen = value, s
    return chosen, best


@leaf
def p_free_when_first_observed(weights: FloatArray, p_free_if: FloatArray, taken_follows: bool) -> float:
    """Return P(free) of a slot at its first observation, averaged over the hypotheses.

    Args:
        weights: (k,) probabilities of the hypotheses; with `taken_follows`, updated for a taken slot.
        p_free_if: (k,) P(free) under each.
        taken_follows: whether the path continues only if the slot is taken.
    """
    p_free: float = mean_over_days(weights, p_free_if)
    if taken_follows:
        scale = 1.0 / (1.0 - p_free)
        for h in range(len(weights)):
            weights[h] *= (1.0 - p_free_if[h]) * scale
    return p_free


@leaf
def _p_nothing_found(
    vertex: int, value_s: float, n_observations: int, graph: PlanningGraph, path: PathBuffer
) -> float:
    """Return P(no slot observed along the path is free and at least as good as driving on)."""
    p_none = 1.0
    for j in range(n_observations):
        s = path.observations[j].slot
        if graph.drive_s[vertex, s] + graph.cost_s[s] <= value_s:
            p_none *= 1.0 - path.observations[j].p_free
    return p_none
