"""Paths: where the car would observe next while all slots that it observes are taken, and what such a path is worth.

**Rollout.** The car chooses a target: those given first, then the slot of the thesis's plan. It drives to the next
vertex on the way there, and observes: the slots in view, and the target by an attempt where no view shows it. The path
ends where hardly any better slot is left, or before the observation that would prove the lot full. The time that
remains then is that of driving a part of the path repeatedly until a slot becomes free, or of standing and waiting for
one. In an almost full lot this is most of the total time.

**Evaluation** by optimal stopping with recall. At every stop the car knows the slots that it has passed, and either
takes the best free slot so far, which may mean driving back, or goes on. Backward induction along the path gives the
exact value; the state is the best slot so far, or none. If a slot is gone on arrival, the car continues the search, for
a time that is estimated once per decision, or drives to the next slot that it knows to be free.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from parkenv.belief.slot_belief import OBSERVED_FREE, OBSERVED_TAKEN, UNOBSERVED
from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled, inlined, kernel
from planners.belief.planning_graph import (
    BeliefSnapshot,
    PathBuffer,
    PlanningGraph,
    decayed_part,
    is_hidden,
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
KEPT_IN_MIND = 32  # number of stops for which a passed free slot is remembered


class Budget(NamedTuple):
    """Limits of a search for a path."""

    # (k,) float64, s, failure costs at which paths of the thesis's planner are rolled out
    failure_costs: FloatArray
    work: int  # maximum number of evaluation steps; it bounds the time of a decision
    depth: int  # maximum number of targets of a path


class Search(NamedTuple):
    """A search for a path, as all its parts read it."""

    vertex: int  # where the car is
    nearest_first: IntArray  # (n_vertices,) int64, all vertices, the nearest to the car first
    graph: PlanningGraph
    belief: BeliefSnapshot
    options: IntArray  # (k,) int64, the best slots that are known to be free now, best first
    fallback_s: FloatArray  # (n_slots,) float64, s, remaining time of the search if a slot is gone on arrival
    budget: Budget


class Course(NamedTuple):
    """Rule by which a path goes on while all slots that it observes are taken."""

    targets: IntArray  # (k,) int64, the vertices to pass before it follows the thesis's planner
    heading: int  # without targets, the slot that it drives to first; -1: it has to choose one
    failure_s: float  # s, failure cost of that planner


@kernel
def rollout_path(course: Course, search: Search, path: PathBuffer) -> None:
    """Roll out a path from the car on. It may return to slots observed taken once they may well be free again.

    Output: `path.state`: the number of stops, and the expected time after the last one if nothing was found.
    """
    state = path.state[0]
    _start(course.heading, search, path)
    while state.n_stops + 2 < len(path.stops) and state.n_observations < len(path.observations):
        if not _choose_target(course, search, path):
            break
        _drive(search, path)
        _observe_here(search, path)
        if state.n_unproven == 0:
            _avoid_proof(search.graph, search.belief, path)
            return
    last, n_observations = state.n_stops - 1, state.n_observations
    state.left_s = min(
        _repeat_path(last, n_observations, search.graph, search.belief, path), search.graph.give_up_s
    )
    # Half of the path is representative of what follows if at least as many slots are still unobserved.
    if state.n_unobserved >= n_observations - path.stops[last // 2].first:
        state.left_s = min(_extrapolate(last, n_observations, search.graph, path), state.left_s)


@inlined
def _start(heading: int, search: Search, path: PathBuffer) -> None:
    graph, belief, state, stops = search.graph, search.belief, path.state[0], path.stops
    # A part of a lot can never be proven full: count one more unobserved slot.
    n_unproven, n_unobserved = (0, 0) if graph.whole else (1, len(belief.slots))
    drive_s = graph.drive_s[search.vertex]
    for s in range(len(belief.slots)):
        observed = belief.slots[s].state
        path.marks[s].observed_at = -np.inf if observed == OBSERVED_FREE else -1.0
        n_unobserved += observed == UNOBSERVED and drive_s[s] < np.inf
        n_unproven += observed != OBSERVED_TAKEN
    state.n_unproven, state.n_unobserved = n_unproven, n_unobserved
    stops[0].vertex, stops[0].time, stops[0].first, stops[1].first = search.vertex, 0.0, 0, 0
    state.vertex, state.time = search.vertex, 0.0
    state.n_stops, state.n_observations, state.n_passed = 1, 0, 0
    state.target, state.chooses = heading, heading < 0
    reset_weights(belief, path)


@inlined
def _choose_target(course: Course, search: Search, path: PathBuffer) -> bool:
    """Set the vertex to drive to; return whether the path goes on.

    The slot of the thesis's plan stays the best choice until it is observed: the others only get worse.
    """
    state, targets = path.state[0], course.targets
    while state.n_passed < len(targets):
        target = targets[state.n_passed]
        if target != state.vertex:
            if search.graph.next_vertex[state.vertex, target] >= 0:
                state.target = target
                return True
        elif _is_attempt_due(search.graph, search.belief, path):
            state.target = target
            return True
        state.n_passed += 1
        state.chooses = True
    if not (state.chooses or state.target == state.vertex):
        return True
    target, value_s = _next_target(course.failure_s, search.graph, search.belief, path)
    if target < 0:
        return False
    state.target, state.chooses = target, False
    # P(no slot observed along the path is free and at least as good as driving on)
    p_none, drive_s = 1.0, search.graph.drive_s[state.vertex]
    for j in range(state.n_observations):
        s = path.observations[j].slot
        if drive_s[s] + search.graph.cost_s[s] <= value_s:
            p_none *= 1.0 - path.observations[j].p_free
    return p_none > NEGLIGIBLE


@kernel
def _next_target(
    failure_s: float, graph: PlanningGraph, belief: BeliefSnapshot, path: PathBuffer
) -> tuple[int, float]:
    """Return the slot that the thesis's planner would drive to next on a path, and its expected time, s.

    With γ = 1 its plan is to drive to one slot and to attempt it until it is free: drive + cost + failure_s·(1 - p)/p.
    """
    best, chosen, time = np.inf, -1, path.state[0].time
    drive_s = graph.drive_s[path.state[0].vertex]
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


@inlined
def _drive(search: Search, path: PathBuffer) -> None:
    """Go on to the next vertex on the way to the target, or wait there for an observation."""
    state, graph = path.state[0], search.graph
    if state.target != state.vertex:
        following = int(graph.next_vertex[state.vertex, state.target])
        state.time += graph.drive_s[state.vertex, following]
        state.vertex = following
    elif not _is_attempt_due(graph, search.belief, path):
        state.time += graph.wait_s
    stop = path.stops[state.n_stops]
    stop.vertex, stop.time, stop.target = state.vertex, state.time, state.target
    state.n_stops += 1


@inlined
def _observe_here(search: Search, path: PathBuffer) -> None:
    """Add the observations from the last stop, and the result of an attempt if they do not show the target."""
    state, graph, belief = path.state[0], search.graph, search.belief
    vertex, time, target = state.vertex, state.time, state.target
    n_observations, n_first = state.n_observations, 0
    weights = path.weights[: len(belief.weights)]
    n_views = graph.view_starts[vertex + 1] - graph.view_starts[vertex]
    for i in range(n_views + 1):
        if n_observations == len(path.observations):
            break
        attempts = i == n_views
        if attempts:
            s = vertex
            if vertex != target or not _is_attempt_due(graph, belief, path):
                continue
        else:
            view = graph.views[graph.view_starts[vertex] + i]
            s = view.slot
            observed_at = path.marks[s].observed_at
            if observed_at == -np.inf or (observed_at >= 0.0 and time - observed_at < OBSERVE_AGAIN_S):
                continue
            if is_hidden(s, view.rate, belief):
                continue
        is_first = belief.slots[s].state == UNOBSERVED and path.marks[s].observed_at < 0.0
        if is_first:
            p_free = p_free_when_first_observed(s, weights, belief, True)
            n_first += 1
        else:
            p_free = p_free_again(s, time, path.marks[s].observed_at, belief)
            if p_free == 0.0 and not attempts:
                continue
        observation = path.observations[n_observations]
        observation.slot, observation.p_free = s, p_free
        observation.time, observation.is_first = time, is_first
        path.marks[s].observed_at = time
        n_observations += 1
        if s == target:
            state.chooses = True
        if attempts:
            # The path continues only if the attempt failed.
            state.time += graph.failure_s
    state.n_observations, path.stops[state.n_stops].first = n_observations, n_observations
    state.n_unproven -= n_first
    state.n_unobserved -= n_first


@inlined
def _avoid_proof(graph: PlanningGraph, belief: BeliefSnapshot, path: PathBuffer) -> None:
    """End a path whose last observation proves the lot full if it shows no free slot: there, or before if better."""
    state, stops, last = path.state[0], path.stops, path.state[0].n_stops - 1
    p_none, cost_s = 1.0, np.inf
    for j in range(stops[last].first, state.n_observations):
        p_none *= 1.0 - path.observations[j].p_free
        cost_s = min(cost_s, graph.cost_s[path.observations[j].slot])
    proof_s = state.time - stops[last - 1].time + p_none * graph.give_up_s + (1.0 - p_none) * cost_s
    state.left_s = _repeat_path(last - 1, stops[last].first, graph, belief, path)
    if state.left_s >= proof_s:
        state.left_s = graph.give_up_s
    elif last > 1:
        state.n_stops = last
    else:
        stops[1].vertex, stops[1].time, stops[2].first = stops[0].vertex, graph.wait_s, 0
        stops[1].target = -1


@kernel
def is_worth_an_attempt(
    vertex: int, time: float, observed_at: float, graph: PlanningGraph, belief: BeliefSnapshot
) -> bool:
    """Return whether to attempt to park at a vertex at a given time from now; `observed_at` as in `MARK`."""
    if not needs_attempt(vertex, graph, belief):
        return False
    if belief.slots[vertex].state == UNOBSERVED and observed_at < 0.0:
        return True
    return bool(p_free_again(vertex, time, observed_at, belief) > 0.0)


@inlined
def _is_attempt_due(graph: PlanningGraph, belief: BeliefSnapshot, path: PathBuffer) -> bool:
    vertex = path.state[0].vertex
    if vertex >= len(path.marks):
        return False
    observed_at = path.marks[vertex].observed_at
    return bool(is_worth_an_attempt(vertex, path.state[0].time, observed_at, graph, belief))


@kernel
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


@kernel
def _repeat_part(
    first: int, last: int, n_observations: int, graph: PlanningGraph, belief: BeliefSnapshot, path: PathBuffer
) -> float:
    """Return the expected time, s, of driving a part of a path repeatedly until a slot on it becomes free.

    P(free) at an observation follows from the time since the slot's previous one, so frequent observations of few slots
    are not overrated.
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
        gap = observations[j].time - before
        if before < 0.0:
            gap = period - (marks[s].observed_at - observations[j].time)
        marks[s].scratch = observations[j].time
        at, usual = belief.slots[s], observations[j].value
        p_free = usual * decayed_part(at.decay_rate * at.p_free_usual / usual, gap)
        found += p_free
        cost_s += p_free * graph.cost_s[s]
    return period / found + cost_s / found if found > 0.0 else np.inf


@kernel
def _extrapolate(last: int, n_observations: int, graph: PlanningGraph, path: PathBuffer) -> float:
    """Return the expected time, s, of going on to unobserved slots like those on the second half of the path."""
    stops, observations = path.stops, path.observations
    first = last // 2
    found, cost_s = 0.0, 0.0
    for j in range(stops[first].first, n_observations):
        found += observations[j].p_free
        cost_s += observations[j].p_free * graph.cost_s[observations[j].slot]
    return (stops[last].time - stops[first].time) / found + cost_s / found if found > 0.0 else np.inf


@kernel
def p_free_again(slot: int, time: float, observed_at: float, belief: BeliefSnapshot) -> float:
    """Return P(free) at a time, s from now, of a slot observed taken; 0 if too low or too soon.

    `observed_at` is when the path observed it last, negative if it did not.
    """
    at = belief.slots[slot]
    if observed_at >= 0.0:
        if time - observed_at < OBSERVE_AGAIN_S:
            return 0.0
        p_free = at.p_free_usual * decayed_part(at.decay_rate, time - observed_at)
    else:
        p_free = at.p_free + (at.p_free_usual - at.p_free) * decayed_part(at.decay_rate, time)
    return float(p_free) if p_free >= WORTH_OBSERVING * at.p_free_usual else 0.0


@kernel
def p_free_when_first_observed(
    slot: int, weights: FloatArray, belief: BeliefSnapshot, taken_follows: bool
) -> float:
    """Return the mean P(free) of a slot; the weights, (k,), change in place if the path goes on only if it is taken."""
    p_free: float = mean_over_days(weights, belief.p_free_if[slot])
    if taken_follows:
        taken_if = belief.taken_if[slot]
        # Where a slot stands alone the mean is 1 - P(free), which takes no second sum.
        scale = 1.0 / (1.0 - p_free if belief.evidence[slot] == 1.0 else mean_over_days(weights, taken_if))
        for h in range(len(weights)):
            weights[h] *= taken_if[h] * scale
    return p_free


@kernel
def expected_cost_to_slot(
    vertex: int,
    slot: int,
    p_free: float,
    age: float,
    fallback_s: float,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
) -> float:
    """Return the expected time, s, from a vertex to a slot that was free with `p_free` `age` s ago.

    If it is taken, the search goes on for `fallback_s`.
    """
    drive = graph.drive_s[vertex, slot]
    if drive == np.inf:
        return np.inf
    at = belief.slots[slot]
    p = p_free + (at.p_free_usual - p_free) * decayed_part(at.decay_rate, age + drive)
    expected: float = drive + p * graph.cost_s[slot] + (1.0 - p) * (fallback_s + graph.failure_s)
    return expected


@compiled(error_model="numpy")
def options_at_hand(
    vertex: int, fallback_s: float, most: int, graph: PlanningGraph, belief: BeliefSnapshot
) -> IntArray:
    """Return the best slots known to be free, at most `most`, best first, as in `expected_cost_to_slot`."""
    options, n_options = np.empty(most, np.int64), 0
    expected_s = np.full(most, np.inf)
    for s in range(len(belief.slots)):
        if belief.slots[s].state != OBSERVED_FREE:
            continue
        value = expected_cost_to_slot(vertex, s, belief.slots[s].p_free, 0.0, fallback_s, graph, belief)
        if n_options < most:
            place = n_options
            n_options += 1
        elif value < expected_s[most - 1]:
            place = most - 1
        else:
            continue
        while place > 0 and expected_s[place - 1] > value:
            expected_s[place], options[place] = expected_s[place - 1], options[place - 1]
            place -= 1
        expected_s[place], options[place] = value, s
    best: IntArray = options[:n_options]
    return best


@kernel
def evaluate_path(search: Search, path: PathBuffer) -> tuple[float, float]:
    """Return the least expected time, s, of following a path with the option to stop at any time.

    Going on is evidence that a slot was taken only where the car would park in it. So the path is evaluated twice:
    without evidence, to find where the car would park, and then with the evidence of the observations there.

    Return the value, s, of driving on to the second stop, and that from there of not parking there either, or inf.
    """
    belief, n_stops = search.belief, path.state[0].n_stops
    if n_stops < 2:
        return np.inf, np.inf
    _set_costs(search, path)
    for j in range(path.stops[n_stops].first):
        observation = path.observations[j]
        if observation.is_first:
            observation.p_free = belief.slots[observation.slot].p_free_usual
    value, then_s = _stop_optimally(path)
    if len(belief.weights) > 1:
        _learn_on_the_way(belief, path)
        value, then_s = _stop_optimally(path)
    return value, then_s


@kernel
def _set_costs(search: Search, path: PathBuffer) -> None:
    """Set what does not depend on P(free) of the observations: the scratch fields of the path."""
    graph, belief, options, fallback_s = search.graph, search.belief, search.options, search.fallback_s
    n_stops = path.state[0].n_stops
    stops, observations, remembered, kept_s = path.stops, path.observations, path.remembered, path.kept_s
    # Lower bound on the time after any later observation. A slot that is better than the bound is taken at once. Others
    # are remembered for some stops; their value cannot improve in the meantime.
    ahead = np.inf
    for k in range(n_stops - 1, 0, -1):
        stops[k].ahead_s = ahead
        for j in range(stops[k].first, stops[k + 1].first):
            slot = observations[j].slot
            ahead = min(ahead, graph.drive_s[stops[k].vertex, slot] + graph.cost_s[slot])
        ahead += stops[k].time - stops[k - 1].time
    n_kept, oldest, newest = 0, 0, 0
    for k in range(1, n_stops):
        stop = stops[k]
        vertex, time, first, last = stop.vertex, stop.time, stop.first, stops[k + 1].first
        drive_s, stop_s = graph.drive_s[vertex], np.inf
        for s in options:
            # Most are farther than the best so far, whatever becomes of them in the meantime.
            if drive_s[s] + min(graph.cost_s[s], fallback_s[s] + graph.failure_s) < stop_s:
                p_free = belief.slots[s].p_free
                option_s = expected_cost_to_slot(vertex, s, p_free, time, fallback_s[s], graph, belief)
                stop_s = min(stop_s, option_s)
        while oldest < newest and remembered[oldest].until < k:
            oldest += 1
        stop.stop_s, stop.first_kept, stop.oldest, stop.newest = stop_s, n_kept, oldest, newest
        in_mind, back_s = remembered[oldest:newest], kept_s[n_kept : n_kept + newest - oldest]
        for i in range(len(in_mind)):
            seen = in_mind[i]
            drive = drive_s[seen.slot]
            decayed = decayed_part(seen.decay_rate, time - seen.time + drive)
            then_s = drive + seen.cost_s + seen.loss_s * decayed if drive < np.inf else np.inf
            back_s[i] = min(stop_s, then_s)
        n_kept += newest - oldest
        for j in range(first, last):
            observation = observations[j]
            slot = observation.slot
            at, cost_s, drive = belief.slots[slot], graph.cost_s[slot], drive_s[slot]
            # As in `expected_cost_to_slot` for P(free) = 1
            loss_s = (1.0 - at.p_free_usual) * (fallback_s[slot] + graph.failure_s - cost_s)
            observation.expected_s = drive + cost_s + loss_s * decayed_part(at.decay_rate, drive)
            observation.loss_s = loss_s
        _sort_observations(first, last, path)
        for j in range(first, last):
            observation = observations[j]
            observation.memory = -1
            if observation.expected_s > stop.ahead_s:
                seen, slot = remembered[newest], observation.slot
                seen.slot, seen.time, seen.until = slot, time, min(k + KEPT_IN_MIND, n_stops - 1)
                seen.cost_s, seen.loss_s = graph.cost_s[slot], observation.loss_s
                seen.decay_rate = belief.slots[slot].decay_rate
                observation.memory = newest
                newest += 1
            observation.expected_s = min(stop_s, observation.expected_s)
    stops[n_stops].oldest = newest


@kernel
def _learn_on_the_way(belief: BeliefSnapshot, path: PathBuffer) -> None:
    """Set P(free) of the first observations along a path, given that the car has not parked before."""
    reset_weights(belief, path)
    weights = path.weights[: len(belief.weights)]
    for j in range(path.stops[path.state[0].n_stops].first):
        observation = path.observations[j]
        if observation.is_first:
            observation.p_free = p_free_when_first_observed(
                observation.slot, weights, belief, observation.parks
            )


@kernel
def _stop_optimally(path: PathBuffer) -> tuple[float, float]:
    """Evaluate a path, given its costs and P(free) of all its observations."""
    stops, observations, kept_s, value_s = path.stops, path.observations, path.kept_s, path.value_s
    nothing = then_s = path.state[0].left_s
    onward = 0.0
    for k in range(path.state[0].n_stops - 1, 0, -1):
        # `value_s` and `nothing` hold the values at the next stop; `onward` is the drive there.
        stop = stops[k]
        first, last, ahead_s = stop.first, stops[k + 1].first, stop.ahead_s
        oldest, newest = stop.oldest, stop.newest
        # From here on these are forgotten.
        for r in range(oldest, stops[k + 1].oldest):
            value_s[r] = nothing
        then_s = onward + nothing
        # Up to each of the slots observed here, best first: P(none is free), and what the others add to the value.
        rest, expected = 1.0, 0.0
        for j in range(first, last):
            observation = observations[j]
            later = then_s if observation.memory < 0 else onward + value_s[observation.memory]
            observation.parks = observation.expected_s <= max(ahead_s, later)
            expected += rest * observation.p_free * (observation.expected_s if observation.parks else later)
            rest *= 1.0 - observation.p_free
            observation.rest, observation.value = rest, expected
        nothing = expected + rest * min(stop.stop_s, then_s)
        in_mind_s = value_s[oldest:newest]
        back_s = kept_s[stop.first_kept : stop.first_kept + newest - oldest]
        for i in range(len(in_mind_s)):
            later = onward + in_mind_s[i]
            in_mind_s[i] = back_s[i] if back_s[i] <= max(ahead_s, later) else later
        if first < last:
            # The best slot that they show replaces a worse one.
            for i in range(len(in_mind_s)):
                for j in range(last - 1, first - 1, -1):
                    if observations[j].expected_s < back_s[i]:
                        in_mind_s[i] = observations[j].value + observations[j].rest * in_mind_s[i]
                        break
        onward = stop.time - stops[k - 1].time
    return onward + nothing, then_s


@kernel
def _sort_observations(first: int, last: int, path: PathBuffer) -> None:
    """Sort the observations made at one stop by the expected time of driving to their slots."""
    observations = path.observations
    for i in range(first + 1, last):
        j = i
        while j > first and observations[j].expected_s < observations[j - 1].expected_s:
            # Records are views, so swap them field by field. Times at one stop are equal; the rest is not set yet.
            a, b = observations[j - 1], observations[j]
            a.slot, b.slot = b.slot, a.slot
            a.p_free, b.p_free = b.p_free, a.p_free
            a.expected_s, b.expected_s = b.expected_s, a.expected_s
            a.loss_s, b.loss_s = b.loss_s, a.loss_s
            a.is_first, b.is_first = b.is_first, a.is_first
            j -= 1
