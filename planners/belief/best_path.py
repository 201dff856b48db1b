"""The search for the path of the least expected time, compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planners.belief.path_evaluation import offer, worth
from planners.belief.path_rollout import lay, worth_a_try
from planners.belief.planning_graph import (
    LOOKS_FREE,
    LOOKS_TAKEN,
    UNSEEN,
    FloatArray,
    Ground,
    IntArray,
    Outlook,
    Path,
    hidden,
)
from sim_sensors.compilation import compiled

MOST_OPTIONS = 12
"""Slots known to be free that are kept in mind, best first."""
NOWHERE, TRY = -1, -2
"""What comes next on a path that goes nowhere, or begins with a try to park where the car is."""


class Choice(NamedTuple):
    """What a search for a path has come to.

    Attributes:
        onward_s: expected s of the path.
        then_s: expected s that are left after its first step for who goes on, if that step is a drive to where nothing
            is looked at; or inf.
        at_hand_s: expected s of going to the best slot known now.
        slot: that slot, or -1.
        following: the vertex that comes next on the path, `TRY` or `NOWHERE`.
        n_targets: how many targets the path has before the thesis's planner goes on.
        cost: s, failure cost with which that one does.
        work: steps of the way back that were made to put targets in, at most one candidate's more than the budget.
    """

    onward_s: float
    then_s: float
    at_hand_s: float
    slot: int
    following: int
    n_targets: int
    cost: float
    work: int


class Budget(NamedTuple):
    """How far to search.

    Attributes:
        costs: (k,) float64, s, failure costs with which the thesis's planner lays paths.
        work: how many steps of the way back may be made; it bounds the time of a decision.
        depth: how many targets a path may have before the thesis's planner goes on.
    """

    costs: FloatArray
    work: int
    depth: int


@compiled
def best_path(
    vertex: int,
    targets: IntArray,
    n_targets: int,
    cost: float,
    promise_s: float,
    budget: Budget,
    ground: Ground,
    outlook: Outlook,
    path: Path,
) -> Choice:
    """Search for the path of the least expected time, from the last decision's on.

    Candidates are the paths of the thesis's planner at several failure costs, then those past one target
    more, which may be any vertex, put in at any place. Ties go to what was found first.

    Args:
        vertex: where the car is.
        targets: (depth,) int64, of the last decision's path; those of the chosen one when this returns.
        n_targets: how many.
        cost: s, failure cost of the last decision's path.
        promise_s: expected s that are left on that path, where nothing was looked at since, to keep to it unless
            another is better: estimates differ by where the car is, and it could turn round for ever. Or inf.
        budget: how far to search.
        ground: the lot.
        outlook: the belief.
        path: room for one.
    """
    n = len(outlook.kind)
    options, n_options = np.empty(MOST_OPTIONS, np.int64), 0
    depth, work = budget.depth, 0
    trial, kept = np.empty(depth, np.int64), np.empty(depth, np.int64)

    # What a failure on arrival costs: the search as it would be if nothing were known to be free.
    late_s, base = np.inf, cost
    late = np.zeros(n)
    for i in range(len(budget.costs)):
        n_path, left = lay(vertex, trial, 0, budget.costs[i], ground, outlook, path)
        value, _ = worth(n_path, left, options, 0, late, ground, outlook, path)
        if value < late_s:
            late_s, base = value, budget.costs[i]
    late_s = min(late_s, ground.give_up_s)
    at_hand, slot = np.inf, -1
    offers = np.full(MOST_OPTIONS, np.inf)
    for s in range(n):
        if outlook.kind[s] != LOOKS_FREE:
            continue
        value = offer(vertex, s, outlook.free[s], 0.0, late_s, ground, outlook)
        if value < at_hand:
            at_hand, slot = value, s
        if n_options < MOST_OPTIONS:
            place = n_options
            n_options += 1
        elif value < offers[MOST_OPTIONS - 1]:
            place = MOST_OPTIONS - 1
        else:
            continue
        while place > 0 and offers[place - 1] > value:
            offers[place], options[place] = offers[place - 1], options[place - 1]
            place -= 1
        offers[place], options[place] = value, s
    # Whoever finds a slot gone may have another one to fall back on.
    for s in range(n):
        late[s] = late_s
        for i in range(n_options):
            o = options[i]
            if o != s:
                fall_back = offer(s, o, outlook.free[o], ground.seconds[vertex, s], late_s, ground, outlook)
                late[s] = min(late[s], fall_back)
    at_hand, slot = np.inf, -1
    for i in range(n_options):
        s = options[i]
        value = offer(vertex, s, outlook.free[s], 0.0, late[s], ground, outlook)
        if value < at_hand:
            at_hand, slot = value, s

    best, then_s, following, n_kept = np.inf, np.inf, NOWHERE, 0
    if n_targets > 0 and targets[0] == vertex and not worth_a_try(vertex, 0.0, -1.0, ground, outlook):
        for i in range(1, n_targets):
            targets[i - 1] = targets[i]
        n_targets -= 1
    for i in range(-1, len(budget.costs)):
        tried = n_targets if i < 0 else 0
        if i >= 0:
            cost = budget.costs[i]
        n_path, left = lay(vertex, targets, tried, cost, ground, outlook, path)
        value, onward_s = worth(n_path, left, options, n_options, late, ground, outlook, path)
        if i < 0 and promise_s < value:
            value, onward_s = promise_s, promise_s - path.times[1]
        if value < best - 1e-9:
            best, base, n_kept = value, cost, tried
            following, then_s = _first_step(onward_s, path)
            for j in range(tried):
                kept[j] = targets[j]
    if best == np.inf:
        return Choice(best, best, at_hand, slot, NOWHERE, 0, base, 0)

    # The near ones matter for the step to be taken now, and come first where the budget is small.
    nearest_first = np.argsort(ground.seconds[vertex])
    on_way = np.empty((depth, len(ground.seconds)), np.bool_)
    for _ in range(depth):
        improved = False
        n_before = n_kept
        for j in range(n_kept):
            targets[j] = kept[j]
        if n_before == depth:
            break
        n_path, left = lay(vertex, targets, n_before, base, ground, outlook, path)
        _mark(on_way, vertex, targets, n_before, n_path, ground, path)
        for place in range(n_before + 1):
            before = vertex if place == 0 else targets[place - 1]
            for u in nearest_first:
                if work > budget.work or not ground.seconds[vertex, u] < min(best, at_hand):
                    break
                if not worth_a_try(u, ground.seconds[vertex, u], -1.0, ground, outlook) and (
                    u == before or on_way[place, u] or not _shows_news(u, ground, outlook)
                ):
                    continue
                for j in range(place):
                    trial[j] = targets[j]
                trial[place] = u
                for j in range(place, n_before):
                    trial[j + 1] = targets[j]
                n_path, left = lay(vertex, trial, n_before + 1, base, ground, outlook, path)
                value, onward_s = worth(n_path, left, options, n_options, late, ground, outlook, path)
                looks = path.starts[n_path]
                work += 30 * (n_path + looks) + n
                if value < best - 1e-6:
                    best, n_kept, improved = value, n_before + 1, True
                    following, then_s = _first_step(onward_s, path)
                    for j in range(n_kept):
                        kept[j] = trial[j]
        if not improved:
            break
    for j in range(n_kept):
        targets[j] = kept[j]
    return Choice(best, then_s, at_hand, slot, following, n_kept, base, work)


@compiled
def _first_step(onward_s: float, path: Path) -> tuple[int, float]:
    """`following` and `then_s` of a laid path; `onward_s` as it would be if nothing were looked at."""
    if path.times[1] == 0.0 and path.starts[2] > 0:
        return TRY, np.inf  # nothing but a try takes no time
    following = int(path.vertices[1])
    if path.starts[2] > 0 or following == path.vertices[0]:
        return following, np.inf
    return following, onward_s


@compiled
def _shows_news(vertex: int, ground: Ground, outlook: Outlook) -> bool:
    """Whether a slot is in view of a vertex that has not been seen yet, or may have come free."""
    for i in range(ground.view_starts[vertex], ground.view_starts[vertex + 1]):
        s = ground.view_slots[i]
        if hidden(s, ground.view_rates[i], outlook):
            continue
        if outlook.kind[s] == UNSEEN or (outlook.kind[s] == LOOKS_TAKEN and outlook.rate[s] > 0.0):
            return True
    return False


@compiled
def _mark(
    on_way: NDArray[np.bool_],
    vertex: int,
    targets: IntArray,
    n_targets: int,
    n_path: int,
    ground: Ground,
    path: Path,
) -> None:
    """Find the vertices that a path reaches by a shortest way from its start or last target: no use to put them in."""
    on_way[:] = False
    passed, since, origin = 0, 0.0, vertex
    for k in range(n_path):
        v = path.vertices[k]
        while passed < n_targets and targets[passed] == v:
            passed += 1
            since, origin = path.times[k], v
        if path.times[k] - since <= ground.seconds[origin, v] + 1e-9:
            on_way[passed, v] = True
