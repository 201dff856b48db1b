"""Evaluation of a path for a car that may stop at any free slot it has observed: optimal stopping with recall.

A path says where to observe next while all observed slots are taken. At every stop the car knows the slots that it has
passed, and either takes the best free slot so far, which may mean driving back, or goes on. Backward induction along
the path gives the exact value; the state is the best slot so far, or none.

If a slot is gone on arrival, the car continues the search, for a time that is estimated once per decision, or drives to
the next slot that it knows to be free.
"""

from __future__ import annotations

import numpy as np

from parkenv.belief.slot_belief import OBSERVED_FREE
from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled
from planners.belief.path_rollout import p_free_when_first_observed
from planners.belief.planning_graph import (
    BeliefSnapshot,
    PathBuffer,
    PlanningGraph,
    decayed_part,
    leaf,
    reset_weights,
)

KEPT_IN_MIND = 32  # number of stops for which a passed free slot is remembered


@leaf
def expected_cost_to_slot(
    vertex: int,
    slot: int,
    p_free: float,
    age: float,
    fallback_s: float,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
) -> float:
    """Return the expected time, s, of driving to a slot observed `age` seconds ago.

    Args:
        vertex: where the drive starts.
        slot: where it ends.
        p_free: P(free) when it was observed.
        age: s since that observation.
        fallback_s: s, remaining time of the search if the slot is taken.
        graph: the lot.
        belief: the belief.
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
    """Return the best slots known to be free, at most `most`, best first.

    Args:
        vertex: where the car is.
        fallback_s: s, remaining time of the search if a slot is taken on arrival.
        most: maximum number of slots.
        graph: the lot.
        belief: the belief.
    """
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


@leaf
def evaluate_path(
    n_stops: int,
    left_s: float,
    options: IntArray,
    fallback_s: FloatArray,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
    path: PathBuffer,
) -> tuple[float, float]:
    """Return the least expected time, s, of following a path with the option to stop at any time.

    What an observation says about the day depends on the decision that follows. If the car would park in the slot were
    it free, then going on means that it was taken. If the car drives past in either case, the observation is no
    evidence on average. So the path is evaluated twice: without evidence, to find where the car would park, and then
    with the evidence of the observations there.

    Args:
        n_stops: number of stops of the path.
        left_s: s, expected time after its end if nothing was found.
        options: (k,) int64, slots that are known to be free now.
        fallback_s: (n_slots,) float64, s, remaining time of the search if the slot is gone on arrival.
        graph: the lot.
        belief: the belief.
        path: the path.

    Returns:
        The value, s, of driving on to the second stop, and the value from there of not parking there either; inf where
        there is none.
    """
    if n_stops < 2:
        return np.inf, np.inf
    _set_costs(n_stops, options, fallback_s, graph, belief, path)
    value, then_s = np.inf, np.inf
    for j in range(path.stops[n_stops].first):
        observation = path.observations[j]
        if observation.is_first:
            observation.p_free = belief.slots[observation.slot].p_free_usual
    value, then_s = _stop_optimally(n_stops, left_s, path)
    if len(belief.weights) > 1:
        _learn_on_the_way(n_stops, belief, path)
        value, then_s = _stop_optimally(n_stops, left_s, path)
    return value, then_s


@leaf
def _set_costs(
    n_stops: int,
    options: IntArray,
    fallback_s: FloatArray,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
    path: PathBuffer,
) -> None:
    """Set what does not depend on P(free) of the observations: the scratch fields of the path."""
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


@leaf
def _learn_on_the_way(n_stops: int, belief: BeliefSnapshot, path: PathBuffer) -> None:
    """Set P(free) of the first observations along a path, given that the car has not parked before."""
    reset_weights(belief, path)
    weights = path.weights[: len(belief.weights)]
    for j in range(path.stops[n_stops].first):
        observation = path.observations[j]
        if observation.is_first:
            observation.p_free = p_free_when_first_observed(
                weights, belief.p_free_if[observation.slot], observation.parks
            )


@leaf
def _stop_optimally(n_stops: int, left_s: float, path: PathBuffer) -> tuple[float, float]:
    """Evaluate a path, given its costs and P(free) of all its observations."""
    stops, observations, kept_s, value_s = path.stops, path.observations, path.kept_s, path.value_s
    nothing, onward, then_s = left_s, 0.0, left_s
    for k in range(n_stops - 1, 0, -1):
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
        in_mind_s, back_s = (
            value_s[oldest:newest],
            kept_s[stop.first_kept : stop.first_kept + newest - oldest],
        )
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


@leaf
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
