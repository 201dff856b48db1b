"""Laying a path: where the car would look next as long as all that it sees is taken; compiled.

What is left where a path ends is the time that it takes to drive a part of it again and again until a slot has come
free, or to stand and wait for one. So long as slots change, this is what most of the time goes into in a lot that is
almost full.
"""

from __future__ import annotations

import numpy as np

from planners.belief.planning_graph import (
    LOOKS_FREE,
    LOOKS_TAKEN,
    UNSEEN,
    FloatArray,
    Ground,
    IntArray,
    Outlook,
    Path,
    decayed,
    hidden,
    must_try,
)
from sim_sensors.compilation import compiled

LOST = 0.002
"""Chance of having found nothing worth stopping for at which a path ends; what remains is estimated."""
WORTH_A_LOOK = 0.1
"""How far, of all the way, a slot seen taken must have come back to its usual chance to be worth another look."""
AGAIN_S = 10.0
"""s that must pass before a slot is looked at once more; a later look makes up for those left out."""


@compiled
def lay(
    vertex: int,
    targets: IntArray,
    n_targets: int,
    cost: float,
    ground: Ground,
    outlook: Outlook,
    path: Path,
) -> tuple[int, float]:
    """Lay a path: past the targets, then as the thesis's planner drives while all that it sees is taken.

    It may come back to slots that it saw taken, once they are likely enough to have come free.

    Returns:
        The number of vertices, and the time, s, that is left at its end if nothing was found.
    """
    n = len(outlook.kind)
    # In a part of a lot there is always a slot more that has not been seen.
    unproven = 0 if ground.whole else 1
    unseen = 0 if ground.whole else n
    for s in range(n):
        path.looked[s] = -np.inf if outlook.kind[s] == LOOKS_FREE else -1.0
        if outlook.kind[s] == UNSEEN and ground.seconds[vertex, s] < np.inf:
            unseen += 1
        if outlook.kind[s] != LOOKS_TAKEN:
            unproven += 1
    path.vertices[0], path.times[0] = vertex, 0.0
    path.starts[0] = path.starts[1] = 0
    k, looks, time, passed = 0, 0, 0.0, 0
    choose, target = True, -1
    weights = path.weights[: len(outlook.weights)]
    weights[:] = outlook.weights
    while k + 2 < len(path.vertices) and looks < len(path.slots):
        while passed < n_targets and _settled(targets[passed], vertex, time, ground, outlook, path):
            passed += 1
            choose = True
        if passed < n_targets:
            target = targets[passed]
        elif choose or target == vertex:
            target, value = _next_target(vertex, time, cost, ground, outlook, path)
            if target < 0:
                break
            choose = False
            if _unsatisfied(vertex, value, looks, ground, path) <= LOST:
                break
        if target == vertex:
            time += 0.0 if _worth_a_try_now(vertex, time, ground, outlook, path) else ground.wait_s
        else:
            following = int(ground.following[vertex, target])
            time += ground.seconds[vertex, following]
            vertex = following
        k += 1
        path.vertices[k], path.times[k] = vertex, time
        for i in range(ground.view_starts[vertex], ground.view_starts[vertex + 1]):
            s = ground.view_slots[i]
            if path.looked[s] == -np.inf or looks == len(path.slots):
                continue
            if hidden(s, ground.view_rates[i], outlook):
                continue
            path.first_look[looks] = outlook.kind[s] == UNSEEN and path.looked[s] < 0.0
            if path.first_look[looks]:
                chance = foreseen(weights, outlook.free_if[s], True)
                unproven -= 1
                unseen -= 1
            else:
                chance = _free_again(s, time, path.looked[s], outlook)
                if chance == 0.0:
                    continue
            path.slots[looks], path.chances[looks], path.found[looks] = s, chance, time
            path.looked[s] = time
            looks += 1
            # What was promised on setting out stays the best until it was seen: all else has but grown worse.
            choose = choose or s == target
        tries = vertex == target and looks < len(path.slots)
        if tries and _worth_a_try_now(vertex, time, ground, outlook, path):
            first = outlook.kind[vertex] == UNSEEN and path.looked[vertex] < 0.0
            if first:
                chance = foreseen(weights, outlook.free_if[vertex], True)
                unproven -= 1
                unseen -= 1
            else:
                chance = _free_again(vertex, time, path.looked[vertex], outlook)
            path.slots[looks], path.chances[looks], path.found[looks] = vertex, chance, time
            path.first_look[looks], path.looked[vertex] = first, time
            looks += 1
            choose = True
            # Whoever finds it free has parked.
            time += ground.failure_s
        path.starts[k + 1] = looks
        if unproven == 0:
            # The last look proves the lot full if it shows no free slot. It may be better not to make it.
            none, walk = 1.0, np.inf
            for j in range(path.starts[k], looks):
                none *= 1.0 - path.chances[j]
                walk = min(walk, ground.walk_s[path.slots[j]])
            proof = time - path.times[k - 1] + none * ground.give_up_s + (1.0 - none) * walk
            spared = _go_round(k - 1, path.starts[k], outlook, ground, path)
            if spared >= proof or not outlook.told:
                return k + 1, ground.give_up_s
            if k == 1:
                path.vertices[1], path.times[1], path.starts[2] = path.vertices[0], ground.wait_s, 0
                return 2, spared
            return k, spared
    # A half of the path tells of what follows if as many slots are left that have not been seen.
    left = _as_before(k, looks, ground, path) if unseen >= looks - path.starts[k // 2] else np.inf
    return k + 1, min(left, _go_round(k, looks, outlook, ground, path), ground.give_up_s)


@compiled
def _settled(target: int, vertex: int, time: float, ground: Ground, outlook: Outlook, path: Path) -> bool:
    """Whether a target cannot be driven to from a vertex, or nothing is left to do where the car has come to it."""
    if target != vertex:
        return bool(ground.following[vertex, target] < 0)
    return not _worth_a_try_now(vertex, time, ground, outlook, path)


@compiled
def worth_a_try(vertex: int, time: float, looked: float, ground: Ground, outlook: Outlook) -> bool:
    """Whether to find out by a try, some time from now, if the slot before a vertex is free; `looked` as in `Path`."""
    if not must_try(vertex, ground, outlook):
        return False
    if outlook.kind[vertex] == UNSEEN and looked < 0.0:
        return True
    return bool(_free_again(vertex, time, looked, outlook) > 0.0)


@compiled
def _worth_a_try_now(vertex: int, time: float, ground: Ground, outlook: Outlook, path: Path) -> bool:
    """The same of a path that has come to the vertex."""
    # Vertices past the slots have not been looked at.
    if vertex >= len(path.looked):
        return False
    return bool(worth_a_try(vertex, time, path.looked[vertex], ground, outlook))


@compiled
def _go_round(last: int, looks: int, outlook: Outlook, ground: Ground, path: Path) -> float:
    """Expected s from a vertex of a path on where nothing new is looked at: a part of it is driven again and again."""
    best, leaving, walk = np.inf, 0.0, 0.0
    v = path.vertices[last]
    for i in range(ground.view_starts[v], ground.view_starts[v + 1]):
        s = ground.view_slots[i]
        if hidden(s, ground.view_rates[i], outlook):
            continue
        if path.looked[s] >= 0.0 or outlook.kind[s] == LOOKS_TAKEN:
            leaves = outlook.usual[s] * outlook.rate[s]
            leaving += leaves
            walk += leaves * ground.walk_s[s]
    if leaving > 0.0:
        # Or the car stands and waits for what is in view.
        best = (1.0 + walk) / leaving
    for quarter in range(4):
        best = min(best, _round_again(quarter * last // 4, last, looks, outlook, ground, path))
    return best


@compiled
def _round_again(first: int, last: int, looks: int, outlook: Outlook, ground: Ground, path: Path) -> float:
    """Expected s of driving a part of a path again and again until a slot on it has come free.

    All its slots were just seen taken. Each look finds a car gone with the chance that the time since the look before
    gives, so that many looks at few slots count for no more than they are worth.
    """
    start, end = path.vertices[first], path.vertices[last]
    period = path.times[last] - path.times[first] + ground.seconds[end, start]
    if end == start:
        period = max(period, ground.wait_s)
    for j in range(path.starts[first], looks):
        path.again[path.slots[j]] = -1.0
    found, walk = 0.0, 0.0
    for j in range(path.starts[first], looks):
        s, since = path.slots[j], path.again[path.slots[j]]
        gap = path.found[j] - since if since >= 0.0 else period - (path.looked[s] - path.found[j])
        path.again[s] = path.found[j]
        usual = 0.0
        for h in range(len(outlook.weights)):
            usual += path.weights[h] * outlook.free_if[s, h]
        chance = usual * decayed(outlook.rate[s] * outlook.usual[s] / usual, gap)
        found += chance
        walk += chance * ground.walk_s[s]
    return period / found + walk / found if found > 0.0 else np.inf


@compiled
def _as_before(last: int, looks: int, ground: Ground, path: Path) -> float:
    """Expected s of going on where slots are left to see, if they show up as often as on the path's second half."""
    first = last // 2
    found, walk = 0.0, 0.0
    for j in range(path.starts[first], looks):
        found += path.chances[j]
        walk += path.chances[j] * ground.walk_s[path.slots[j]]
    return (path.times[last] - path.times[first]) / found + walk / found if found > 0.0 else np.inf


@compiled
def _free_again(slot: int, time: float, looked: float, outlook: Outlook) -> float:
    """P(free) some time later of a slot seen taken, really or along the path; 0 where it is not worth a look."""
    usual = outlook.usual[slot]
    if looked >= 0.0:
        if time - looked < AGAIN_S:
            return 0.0
        chance = usual * decayed(outlook.rate[slot], time - looked)
    else:
        chance = outlook.free[slot]
        chance += (usual - chance) * decayed(outlook.rate[slot], time)
    return chance if chance >= WORTH_A_LOOK * usual else 0.0


@compiled
def _next_target(
    vertex: int, time: float, cost: float, ground: Ground, outlook: Outlook, path: Path
) -> tuple[int, float]:
    """The slot that the thesis's planner would drive to at some time of a path, and its expected time, s.

    With γ = 1 its plan is to drive to one slot and to try until it is free: drive + walk + cost·(1 - p)/p.
    """
    best, chosen = np.inf, -1
    row = ground.seconds[vertex]
    for s in range(len(outlook.kind)):
        value = row[s] + ground.walk_s[s]
        if value >= best or path.looked[s] == -np.inf:
            continue
        if outlook.kind[s] == UNSEEN and path.looked[s] < 0.0:
            value += cost * outlook.odds[s]
        else:
            if value + cost * outlook.least_odds[s] >= best:
                continue
            chance = _free_again(s, time + row[s], path.looked[s], outlook)
            value += cost * (1.0 - chance) / chance if chance > 0.0 else np.inf
        if value < best:
            best, chosen = value, s
    return chosen, best


@compiled
def foreseen(weights: FloatArray, free_if: FloatArray, telling: bool) -> float:
    """P(free) of a slot at its first look; where it tells, the hypotheses are left as a taken slot makes them."""
    free, taken = 0.0, 0.0
    for h in range(len(weights)):
        free += weights[h] * free_if[h]
        taken += weights[h] * (1.0 - free_if[h])
    if telling:
        for h in range(len(weights)):
            weights[h] *= (1.0 - free_if[h]) / taken
    return free / (free + taken)


@compiled
def _unsatisfied(vertex: int, promise_s: float, looks: int, ground: Ground, path: Path) -> float:
    """Chance that none of the slots looked at is free and as good as what driving on promises."""
    chance = 1.0
    for j in range(looks):
        s = path.slots[j]
        if ground.seconds[vertex, s] + ground.walk_s[s] <= promise_s:
            chance *= 1.0 - path.chances[j]
    return chance
