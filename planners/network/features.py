"""What the network observes: numbers about each action, and tokens for the slots that matter, seen through each action.

Nothing here depends on coordinates, on the number of slots or on the order of the moves, so turning the map changes
nothing, and the same weights serve every lot. Times are divided by the decision's own time scale, the least expected
time of the look-ahead, so the speed of the car and the size of the lot do not matter either.

An action is one of the four moves, parking, or waiting. A token is a slot seen through an action: its belief, the
drive to it if the car takes the action, and its arrival cost.
"""

import math
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import OBSERVED_FREE, OBSERVED_TAKEN, UNOBSERVED
from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled
from planners.belief.path import expected_cost_to_slot, options_at_hand
from planners.belief.planning_graph import BeliefSnapshot, PlanningGraph, is_hidden, needs_attempt
from planners.network.lookahead import Decision, best_option, next_target, path_value

ACTION_COUNT = 6  # four moves, parking, waiting
PARKING, WAITING = 4, 5
FAILURE_COSTS = (1.0, 4.0, 16.0)  # s, failure costs of the thesis's planner on the paths of the look-ahead
CANDIDATES = 8  # number of slots that are tokens
MOST_OPTIONS = 4  # number of slots known to be free that the look-ahead considers
LEAST_SCALE = 1e-3  # s, lower bound of the time scale
MOST_REGRET = 4.0  # largest difference between times, in time scales

# Times are in time scales, mapped to 0 to 1; regrets are differences from the best, at most MOST_REGRET.
# Columns of actions: the action itself,
IS_MOVE, IS_PARKING, IS_WAITING, DURATION, IS_RETURN, LAST_VISIT = range(6)
# what the look-ahead expects, and the way to the best slot that is known to be free,
LOOKAHEAD, KNOWN_FREE, KNOWN_FREE_REGRET = range(6, 9)
# the slot at its end, if there is one, and the slots in view from there,
END_P_FREE, END_UNOBSERVED, END_COST, VIEW_P_FREE, VIEW_SLOTS, DRIVE_BACK = range(9, 15)
# the look-ahead's path at each failure cost; from the first column of the path,
PATHS = 15
PATH_TIME, PATH_REGRET, PATH_P_NONE, TARGET_P_FREE, TARGET_DRIVE, TARGET_COST = range(6)
PATH_FEATURES = 6
# and the situation, which all actions share.
SITUATION = PATHS + PATH_FEATURES * len(FAILURE_COSTS)
ELAPSED, SHARE_OBSERVED, LOT_SIZE, DAY_SHIFT, DAY_SPREAD, MEAN_P_FREE = range(SITUATION, SITUATION + 6)
BEST_KNOWN_FREE, FAILURE_COST, GIVE_UP, DECAY_RATE, N_ACTIONS, N_OPTIONS = range(
    SITUATION + 6, SITUATION + 12
)
ACTION_FEATURES = SITUATION + 12

# Columns of tokens.
IS_SLOT, P_FREE, P_FREE_SPREAD, SLOT_SHIFT, IS_FREE, IS_TAKEN, LAST_OBSERVED = range(7)
COST, DRIVE, DRIVE_REGRET, TOTAL_REGRET, IS_END, DECAY, EXPECTED_REGRET = range(7, 14)
TOKEN_FEATURES = 14


class Situation(NamedTuple):
    here: int
    previous: int  # vertex before, or -1
    following: IntArray  # (4,) vertex after each move, or -1
    move_s: FloatArray  # (4,) s
    wait_s: float  # s, duration of waiting; inf if every move exists, so none can be used to wait
    failure_s: float  # s, cost of a failed attempt
    time: float  # s since the search began
    visited_at: FloatArray  # (n_vertices,) s since the search began, of the last visit; -1 without one
    forecast: FloatArray  # (n_slots,) P(taken)
    observed_at: FloatArray  # (n_slots,) s since the search began; -1 if the slot is unobserved


class Features(NamedTuple):
    actions: NDArray[np.float32]  # (6, ACTION_FEATURES), the four moves, parking, waiting
    tokens: NDArray[np.float32]  # (6, CANDIDATES, TOKEN_FEATURES)
    allowed: NDArray[np.bool_]  # (6,), the actions that there are
    lookahead_s: FloatArray  # (6,) s, expected time by the look-ahead; inf for actions that there are not

    @classmethod
    def empty(cls) -> Self:
        return cls(
            np.zeros((ACTION_COUNT, ACTION_FEATURES), np.float32),
            np.zeros((ACTION_COUNT, CANDIDATES, TOKEN_FEATURES), np.float32),
            np.zeros(ACTION_COUNT, np.bool_),
            np.full(ACTION_COUNT, np.inf),
        )


@compiled(error_model="numpy")
def _squashed(ratio: float) -> float:
    """Map times from 0 to infinity, in time scales, to 0 to 1."""
    return ratio / (1.0 + ratio) if ratio < np.inf else 1.0


@compiled(error_model="numpy")
def _regret(value: float, best: float, scale: float) -> float:
    return min((value - best) / scale, MOST_REGRET) if value < np.inf else MOST_REGRET


@compiled(error_model="numpy")
def _logit(p: float) -> float:
    p = min(max(p, 1e-4), 1.0 - 1e-4)
    return math.log(p / (1.0 - p))


@compiled(error_model="numpy")
def observe(now: Situation, failure_costs: FloatArray, decision: Decision, out: Features) -> None:
    """Write the network's observation of a decision without options, given `FAILURE_COSTS`."""
    graph, belief = decision.graph, decision.belief
    here, n, n_costs = now.here, len(belief.slots), len(failure_costs)
    ends, step_s = np.full(ACTION_COUNT, -1), np.full(ACTION_COUNT, np.inf)
    ends[:PARKING], step_s[:PARKING] = now.following, np.where(now.following >= 0, now.move_s, np.inf)
    # A slot that is seen taken from its own vertex is not worth an attempt.
    if here < n and (belief.slots[here].state == OBSERVED_FREE or needs_attempt(here, graph, belief)):
        ends[PARKING], step_s[PARKING] = here, 0.0
    if now.wait_s < np.inf:
        ends[WAITING], step_s[WAITING] = here, now.wait_s

    _, fallback_s = next_target(here, 0.0, failure_costs[n_costs // 2], decision)
    fallback_s = min(fallback_s, graph.give_up_s)
    options = options_at_hand(here, fallback_s, MOST_OPTIONS, graph, belief)
    decision = Decision(decision.by_cost, options, fallback_s, graph, belief, decision.scratch)
    path_s, p_none = np.full((ACTION_COUNT, n_costs), np.inf), np.ones((ACTION_COUNT, n_costs))
    first, option_s = np.full((ACTION_COUNT, n_costs), -1), np.full(ACTION_COUNT, np.inf)
    for a in range(ACTION_COUNT):
        out.allowed[a] = ends[a] >= 0
        if ends[a] < 0 or a == PARKING:
            continue
        option_s[a] = step_s[a] + best_option(ends[a], step_s[a], decision)
        for c in range(n_costs):
            path_s[a, c], p_none[a, c], first[a, c] = path_value(
                ends[a], step_s[a], failure_costs[c], decision
            )
    best_path_s = np.array([path_s[:, c].min() for c in range(n_costs)])
    least_s = min(best_path_s.min(), option_s.min(), graph.give_up_s)
    if ends[PARKING] >= 0:
        p_here = belief.slots[here].p_free
        path_s[PARKING, :] = p_here * graph.cost_s[here] + (1.0 - p_here) * (now.failure_s + least_s)
        least_s = min(least_s, path_s[PARKING, 0])
    scale = max(least_s, LEAST_SCALE)
    least_option_s = option_s.min()

    n_observed, n_actions, p_free_sum = (now.observed_at >= 0.0).sum(), out.allowed.sum(), 0.0
    for s in range(n):
        p_free_sum += belief.slots[s].p_free
    candidates = _candidates(here, failure_costs, decision)
    shift, spread = _day_of_slots(candidates, now, belief)
    nearest_rate = belief.slots[candidates[0]].decay_rate if candidates[0] >= 0 else 0.0

    for a in range(ACTION_COUNT):
        row = out.actions[a]
        row[:] = 0.0
        out.lookahead_s[a] = np.inf
        if not out.allowed[a]:
            continue
        end = ends[a]
        value = min(path_s[a].min(), option_s[a])
        out.lookahead_s[a] = min(value, step_s[a] + graph.give_up_s)
        row[IS_MOVE], row[IS_PARKING], row[IS_WAITING] = a < PARKING, a == PARKING, a == WAITING
        row[DURATION] = _squashed(step_s[a] / scale)
        row[IS_RETURN] = a < PARKING and end == now.previous
        if a < PARKING and now.visited_at[end] >= 0.0:
            row[LAST_VISIT] = 1.0 - _squashed((now.time - now.visited_at[end]) / scale)
        row[LOOKAHEAD] = _regret(out.lookahead_s[a], least_s, scale)
        row[KNOWN_FREE] = _squashed(option_s[a] / scale)
        if least_option_s < np.inf:
            row[KNOWN_FREE_REGRET] = _regret(option_s[a], least_option_s, scale)
        _write_end(row, end, a != PARKING, here, scale, graph, belief)
        for c in range(n_costs):
            at = PATHS + PATH_FEATURES * c
            row[at + PATH_TIME] = _squashed(path_s[a, c] / scale)
            row[at + PATH_REGRET] = _regret(path_s[a, c], best_path_s[c], scale)
            row[at + PATH_P_NONE] = p_none[a, c]
            target = first[a, c]
            if target >= 0:
                row[at + TARGET_P_FREE] = belief.slots[target].p_free
                row[at + TARGET_DRIVE] = _squashed(graph.drive_s[end, target] / scale)
                row[at + TARGET_COST] = _squashed(graph.cost_s[target] / scale)
        row[ELAPSED] = _squashed(now.time / scale)
        row[SHARE_OBSERVED] = n_observed / n
        row[LOT_SIZE] = _squashed(0.01 * n)
        row[DAY_SHIFT] = shift / 4.0
        row[DAY_SPREAD] = spread
        row[MEAN_P_FREE] = p_free_sum / n
        row[BEST_KNOWN_FREE] = _squashed(least_option_s / scale)
        row[FAILURE_COST] = _squashed(now.failure_s / scale)
        row[GIVE_UP] = _squashed(graph.give_up_s / scale / 10.0)
        row[DECAY_RATE] = _squashed(nearest_rate * scale)
        row[N_ACTIONS] = n_actions / ACTION_COUNT
        row[N_OPTIONS] = options.size / MOST_OPTIONS
    _write_tokens(now, candidates, ends, step_s, least_s, decision, out)


@compiled(error_model="numpy")
def _write_end(
    row: NDArray[np.float32],
    end: int,
    moves: bool,
    here: int,
    scale: float,
    graph: PlanningGraph,
    belief: BeliefSnapshot,
) -> None:
    """Write what an action leads to: the slot at its end, and what is unobserved in view from there."""
    if end < len(belief.slots):
        row[END_P_FREE] = belief.slots[end].p_free
        row[END_UNOBSERVED] = belief.slots[end].state == UNOBSERVED
        row[END_COST] = _squashed(graph.cost_s[end] / scale)
    if moves:
        new, n_new = 0.0, 0
        for i in range(graph.view_starts[end], graph.view_starts[end + 1]):
            s, rate = graph.views[i].slot, graph.views[i].rate
            if belief.slots[s].state == UNOBSERVED and not is_hidden(s, rate, belief):
                new += belief.slots[s].p_free
                n_new += 1
        row[VIEW_P_FREE], row[VIEW_SLOTS] = _squashed(new), _squashed(0.25 * n_new)
        row[DRIVE_BACK] = _squashed(graph.drive_s[end, here] / scale)


@compiled(error_model="numpy")
def _day_of_slots(candidates: IntArray, now: Situation, belief: BeliefSnapshot) -> tuple[float, float]:
    """Return by how much the unobserved candidates are fuller than forecast, and how uncertain that is.

    The first is a mean in logits; the second the standard deviation of their P(free) over days.
    """
    p_if, n_unobserved, shift = np.zeros(len(belief.weights)), 0, 0.0
    for s in candidates:
        if s >= 0 and belief.slots[s].state == UNOBSERVED:
            n_unobserved += 1
            shift += _logit(1.0 - belief.slots[s].p_free) - _logit(now.forecast[s])
            p_if += belief.p_free_if[s]
    if n_unobserved == 0:
        return 0.0, 0.0
    p_if /= n_unobserved
    mean = (belief.weights * p_if).sum()
    return shift / n_unobserved, math.sqrt(max((belief.weights * (p_if - mean) ** 2).sum(), 0.0))


@compiled(error_model="numpy")
def _write_tokens(
    now: Situation,
    candidates: IntArray,
    ends: IntArray,
    step_s: FloatArray,
    least_s: float,
    decision: Decision,
    out: Features,
) -> None:
    """Write the tokens: each candidate, -1 for none, seen through each action.

    `ends` and `step_s`, (6,), are the vertex after each action and its duration; `least_s` is that of the look-ahead.
    """
    graph, belief = decision.graph, decision.belief
    scale = max(least_s, LEAST_SCALE)
    for i in range(CANDIDATES):
        s = candidates[i]
        nearest_s = np.inf
        if s >= 0:
            for a in range(ACTION_COUNT):
                if out.allowed[a] and a != PARKING:
                    nearest_s = min(nearest_s, step_s[a] + graph.drive_s[ends[a], s])
        for a in range(ACTION_COUNT):
            token = out.tokens[a, i]
            token[:] = 0.0
            if s < 0 or not out.allowed[a]:
                continue
            slot = belief.slots[s]
            drive_s = step_s[a] + graph.drive_s[ends[a], s]
            if a == PARKING:
                drive_s = now.failure_s + graph.drive_s[now.here, s]
            p_free = slot.p_free + (slot.p_free_usual - slot.p_free) * (
                1.0 - math.exp(-slot.decay_rate * min(drive_s, 1e6))
            )
            deviation = 0.0
            if slot.state == UNOBSERVED:
                mean, square = 0.0, 0.0
                for h in range(len(belief.weights)):
                    p = belief.p_free_if[s, h]
                    mean += belief.weights[h] * p
                    square += belief.weights[h] * p * p
                deviation = math.sqrt(max(square - mean * mean, 0.0))
            token[IS_SLOT] = 1.0
            token[P_FREE] = p_free
            token[P_FREE_SPREAD] = deviation
            token[SLOT_SHIFT] = min(
                max((_logit(1.0 - slot.p_free) - _logit(now.forecast[s])) / 4.0, -1.0), 1.0
            )
            token[IS_FREE], token[IS_TAKEN] = slot.state == OBSERVED_FREE, slot.state == OBSERVED_TAKEN
            if now.observed_at[s] >= 0.0:
                token[LAST_OBSERVED] = 1.0 - _squashed((now.time - now.observed_at[s]) / scale)
            token[COST] = _squashed(graph.cost_s[s] / scale)
            token[DRIVE] = _squashed(drive_s / scale)
            token[DRIVE_REGRET] = _regret(drive_s, nearest_s, scale)
            token[TOTAL_REGRET] = _regret(drive_s + graph.cost_s[s], least_s, scale)
            token[IS_END] = s == ends[a]
            token[DECAY] = _squashed(slot.decay_rate * min(drive_s, 1e6))
            expected_s = expected_cost_to_slot(
                ends[a], s, slot.p_free, step_s[a], decision.fallback_s, graph, belief
            )
            token[EXPECTED_REGRET] = _regret(step_s[a] + expected_s, least_s, scale)


@compiled(error_model="numpy")
def _candidates(here: int, failure_costs: FloatArray, decision: Decision) -> IntArray:
    """Return `CANDIDATES` different slots, -1 for none: the best to drive to at failure costs taken in turn."""
    graph, belief = decision.graph, decision.belief
    chosen, n_chosen = np.full(CANDIDATES, -1), 0
    n_costs = len(failure_costs)
    values = np.empty((n_costs, CANDIDATES))
    slots = np.full((n_costs, CANDIDATES), -1)
    for c in range(n_costs):
        values[c, :] = np.inf
        for s in decision.by_cost:
            if graph.cost_s[s] >= values[c, CANDIDATES - 1]:
                break
            value = graph.drive_s[here, s] + graph.cost_s[s]
            if value >= values[c, CANDIDATES - 1]:
                continue
            p_free = belief.slots[s].p_free
            if belief.slots[s].state == UNOBSERVED:
                value += failure_costs[c] * belief.slots[s].odds
            else:
                value += failure_costs[c] * (1.0 - p_free) / max(p_free, 1e-6)
            place = CANDIDATES - 1
            if value >= values[c, place]:
                continue
            while place > 0 and values[c, place - 1] > value:
                values[c, place], slots[c, place] = values[c, place - 1], slots[c, place - 1]
                place -= 1
            values[c, place], slots[c, place] = value, s
    for i in range(CANDIDATES):
        for c in range(n_costs):
            s = slots[c, i]
            if s >= 0 and n_chosen < CANDIDATES and not (chosen[:n_chosen] == s).any():
                chosen[n_chosen] = s
                n_chosen += 1
    return chosen
