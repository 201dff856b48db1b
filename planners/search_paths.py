"""What a path through a lot is worth to a car that may stop at any free slot it has seen, compiled.

A path says where to look next as long as all that was seen is taken. At every vertex of it the car knows what it
has passed, and either settles for the best free slot so far, which may mean to drive back, or goes on. That is
optimal stopping with recall, and its value follows exactly by going through the path backwards: the state is
which slot is the best so far, or none.

A slot may be taken while the car drives to it, and one seen taken may have come free: both by two-state
chains, p(t) = p∞ + (p(0) - p∞)·exp(-rt). Whoever comes too late goes on searching, for a time that is
estimated once a decision, or tries the next of those that it knows to be free.

What is left where a path ends is the time that it takes to drive a part of it again and again until a slot has come
free, or to stand and wait for one. So long as slots change, this is what most of the time goes into in a lot that is
almost full.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

UNSEEN, LOOKS_FREE, LOOKS_TAKEN = 0, 1, 2

LOST = 0.002
"""Chance of having found nothing worth stopping for at which a path ends; what remains is estimated."""
MOST_HYPOTHESES = 64
"""How many ways of how a map may be off there is room for."""
WORTH_A_LOOK = 0.1
"""How far, of all the way, a slot seen taken must have come back to its usual chance to be worth another look."""
AGAIN_S = 10.0
"""s that must pass before a slot is looked at once more; a later look makes up for those left out."""
MOST_STEPS = 400
"""Vertices at which a path ends in any case."""
KEPT_IN_MIND = 32
"""Vertices along which a free slot that was passed is kept in mind."""
MOST_OPTIONS = 12
"""Slots known to be free that are kept in mind, best first."""


class Ground(NamedTuple):
    """What stays the same in a search.

    Attributes:
        seconds: (n_vertices, n_vertices) float64, s, drive times.
        following: (n_vertices, n_vertices) int16, the next vertex of a shortest way.
        view_starts: (n_vertices + 1,) int64, rows of `view_slots`.
        view_slots: int64, slots in view of each vertex.
        walk_s: (n_slots,) float64, s.
        wait_s: s, what it takes to look again where the car stands.
        give_up_s: s, from a lot that is proven full to the goal.
        failure_s: s, what it costs to find a slot taken on arrival: nothing if that shows before the try.
        whole: whether these are all slots that there are, so that the lot may be proven full.
    """

    seconds: FloatArray
    following: NDArray[np.int16]
    view_starts: IntArray
    view_slots: IntArray
    walk_s: FloatArray
    wait_s: float
    give_up_s: float
    failure_s: float
    whole: bool


class Outlook(NamedTuple):
    """What is believed of the slots at one decision.

    Attributes:
        kind: (n_slots,) int8, UNSEEN, LOOKS_FREE or LOOKS_TAKEN.
        free: (n_slots,) float64, P(free now).
        weights: (k,) float64, probabilities of the hypotheses of how the map is off.
        free_if: (n_slots, k) float64, P(free) of an unseen slot under each of them.
        usual: (n_slots,) float64, P(free) that it relaxes to.
        rate: (n_slots,) float64, 1/s, how fast.
        odds: (n_slots,) float64, P(taken)/P(free) about when the car could be there; inf where hopeless.
        least_odds: (n_slots,) float64, P(taken)/P(free) that it relaxes to: no slot seen taken has better ones.
        told: whether rates were seen at work, so that it is safe to count on cars to leave.
    """

    kind: NDArray[np.int8]
    free: FloatArray
    weights: FloatArray
    free_if: FloatArray
    usual: FloatArray
    rate: FloatArray
    odds: FloatArray
    least_odds: FloatArray
    told: bool


class Path(NamedTuple):
    """Room for one path, used again and again.

    Attributes:
        vertices: (most,) int64.
        times: (most,) float64, s from now.
        starts: (most + 1,) int64, which looks are made at each vertex: `starts[k]` to `starts[k + 1]`.
        slots: (most_looks,) int64, the slots looked at, in order.
        chances: (most_looks,) float64, P(free) at the look, if the search has come so far.
        found: (most_looks,) float64, s from now, when the look is made.
        first_look: (most_looks,) bool, whether the slot has not been seen before, really or along the path.
        taken_up: (most_looks,) bool, whether the car parks in the slot if the look shows it free.
        looked: (n_slots,) float64, s from now, when the path last looked at a slot; -1 where it has not yet, -inf
            where it need not since the slot is known to be free.
        again: (n_slots,) float64, scratch of going round.
        values: (most_looks,) float64, scratch of the way back.
        offers: (most_looks,) float64, scratch of the way back.
        until: (most_looks,) int64, scratch: the last vertex at which each slot is kept in mind.
        ahead: (most,) float64, scratch: s that any look after each vertex takes at least.
        weights: float64, scratch: the hypotheses' probabilities as they are along the path.
    """

    vertices: IntArray
    times: FloatArray
    starts: IntArray
    slots: IntArray
    chances: FloatArray
    found: FloatArray
    first_look: NDArray[np.bool_]
    taken_up: NDArray[np.bool_]
    looked: FloatArray
    again: FloatArray
    values: FloatArray
    offers: FloatArray
    until: IntArray
    ahead: FloatArray
    weights: FloatArray


def new_path(n_slots: int, n_vertices: int) -> Path:
    """Room for a path on a lot of that size."""
    most = min(4 * n_vertices + 16, MOST_STEPS)
    most_looks = n_slots + min(n_slots + 64, MOST_STEPS)
    return Path(
        np.zeros(most, np.int64),
        np.zeros(most),
        np.zeros(most + 1, np.int64),
        np.zeros(most_looks, np.int64),
        np.zeros(most_looks),
        np.zeros(most_looks),
        np.zeros(most_looks, np.bool_),
        np.zeros(most_looks, np.bool_),
        np.zeros(n_slots),
        np.zeros(n_slots),
        np.zeros(most_looks),
        np.zeros(most_looks),
        np.zeros(most_looks, np.int64),
        np.zeros(most),
        np.zeros(MOST_HYPOTHESES),
    )


@njit(cache=True)
def decayed(rate: float, seconds: float) -> float:
    """1 - exp(-rate · seconds), quick where little happens."""
    x = rate * seconds
    if x < 1e-3:
        return x
    return 1.0 - math.exp(-x)


@njit(cache=True)
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
        if outlook.kind[s] == UNSEEN and ground.seconds[vertex, s] < np.inf:
            unseen += 1
        path.looked[s] = -np.inf if outlook.kind[s] == LOOKS_FREE else -1.0
        if outlook.kind[s] != LOOKS_TAKEN:
            unproven += 1
    path.vertices[0], path.times[0] = vertex, 0.0
    path.starts[0] = path.starts[1] = 0
    k, looks, time, passed = 0, 0, 0.0, 0
    choose, target = True, -1
    weights = path.weights[: len(outlook.weights)]
    weights[:] = outlook.weights
    while k + 2 < len(path.vertices) and looks < len(path.slots):
        while passed < n_targets and (
            targets[passed] == vertex or ground.following[vertex, targets[passed]] < 0
        ):
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
            time += ground.wait_s
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
            path.first_look[looks] = outlook.kind[s] == UNSEEN and path.looked[s] < 0.0
            if path.first_look[looks]:
                chance = _foreseen(weights, outlook.free_if[s], True)
                unproven -= 1
                unseen -= 1
            else:
                chance = _free_again(s, time, outlook, path)
                if chance == 0.0:
                    continue
            path.slots[looks], path.chances[looks], path.found[looks] = s, chance, time
            path.looked[s] = time
            looks += 1
            # What was promised on setting out stays the best until it was seen: all else has but grown worse.
            choose = choose or s == target
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


@njit(cache=True)
def _go_round(last: int, looks: int, outlook: Outlook, ground: Ground, path: Path) -> float:
    """Expected s from a vertex of a path on where nothing new is looked at: a part of it is driven again and again."""
    best, leaving, walk = np.inf, 0.0, 0.0
    v = path.vertices[last]
    for i in range(ground.view_starts[v], ground.view_starts[v + 1]):
        s = ground.view_slots[i]
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


@njit(cache=True)
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


@njit(cache=True)
def _as_before(last: int, looks: int, ground: Ground, path: Path) -> float:
    """Expected s of going on where slots are left to see, if they show up as often as on the path's second half."""
    first = last // 2
    found, walk = 0.0, 0.0
    for j in range(path.starts[first], looks):
        found += path.chances[j]
        walk += path.chances[j] * ground.walk_s[path.slots[j]]
    return (path.times[last] - path.times[first]) / found + walk / found if found > 0.0 else np.inf


@njit(cache=True)
def _free_again(slot: int, time: float, outlook: Outlook, path: Path) -> float:
    """P(free) some time later of a slot seen taken, really or along the path; 0 where it is not worth a look."""
    usual = outlook.usual[slot]
    if path.looked[slot] >= 0.0:
        if time - path.looked[slot] < AGAIN_S:
            return 0.0
        chance = usual * decayed(outlook.rate[slot], time - path.looked[slot])
    else:
        chance = outlook.free[slot]
        chance += (usual - chance) * decayed(outlook.rate[slot], time)
    return chance if chance >= WORTH_A_LOOK * usual else 0.0


@njit(cache=True)
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
            chance = _free_again(s, time + row[s], outlook, path)
            value += cost * (1.0 - chance) / chance if chance > 0.0 else np.inf
        if value < best:
            best, chosen = value, s
    return chosen, best


@njit(cache=True)
def _foreseen(weights: FloatArray, free_if: FloatArray, telling: bool) -> float:
    """P(free) of a slot at its first look; where it tells, the hypotheses are left as a taken slot makes them."""
    free, taken = 0.0, 0.0
    for h in range(len(weights)):
        free += weights[h] * free_if[h]
        taken += weights[h] * (1.0 - free_if[h])
    if telling:
        for h in range(len(weights)):
            weights[h] *= (1.0 - free_if[h]) / taken
    return free / (free + taken)


@njit(cache=True)
def _unsatisfied(vertex: int, promise_s: float, looks: int, ground: Ground, path: Path) -> float:
    """Chance that none of the slots looked at is free and as good as what driving on promises."""
    chance = 1.0
    for j in range(looks):
        s = path.slots[j]
        if ground.seconds[vertex, s] + ground.walk_s[s] <= promise_s:
            chance *= 1.0 - path.chances[j]
    return chance


@njit(cache=True)
def offer(
    vertex: int,
    slot: int,
    free: float,
    age: float,
    late_s: float,
    ground: Ground,
    outlook: Outlook,
) -> float:
    """Expected time, s, of driving to a slot that was free with some probability a while ago.

    Args:
        vertex: where from.
        slot: where to.
        free: P(free) when last seen.
        age: s since then.
        late_s: s that the search takes on if it is taken.
        ground: the lot.
        outlook: the belief.
    """
    drive = ground.seconds[vertex, slot]
    if drive == np.inf:
        return np.inf
    p = free + (outlook.usual[slot] - free) * decayed(outlook.rate[slot], age + drive)
    expected: float = drive + p * ground.walk_s[slot] + (1.0 - p) * (late_s + ground.failure_s)
    return expected


@njit(cache=True)
def worth(
    n_path: int,
    left_s: float,
    options: IntArray,
    n_options: int,
    late_s: FloatArray,
    ground: Ground,
    outlook: Outlook,
    path: Path,
) -> float:
    """Least expected time, s, of going on along a laid path and stopping at will.

    What a look tells of the map depends on what it leads to. Where the car would park in a slot if it is free, going
    on means that it was taken; where it drives past in any case, the look may show either, and tells nothing on
    average. So the path is valued twice: as if no look told anything, which shows where the car would park, and with
    what the looks there tell.

    Args:
        n_path: its vertices.
        left_s: s, left at its end if nothing was found.
        options: slots that are known to be free now.
        n_options: how many.
        late_s: (n_slots,) float64, s that the search takes on where each slot is gone on arrival.
        ground: the lot.
        outlook: the belief.
        path: the path.

    Returns:
        The value of driving on to its second vertex; inf where it has none.
    """
    if n_path < 2:
        return np.inf
    path.taken_up[: path.starts[n_path]] = False
    _foresee(n_path, outlook, path)
    value: float = _stop_at_best(n_path, left_s, options, n_options, late_s, ground, outlook, path)
    if len(outlook.weights) > 1:
        _foresee(n_path, outlook, path)
        value = _stop_at_best(n_path, left_s, options, n_options, late_s, ground, outlook, path)
    return value


@njit(cache=True)
def _foresee(n_path: int, outlook: Outlook, path: Path) -> None:
    """Write down P(free) of the first looks along a path, each given that those before led to no parking."""
    weights = path.weights[: len(outlook.weights)]
    weights[:] = outlook.weights
    for j in range(path.starts[n_path]):
        if path.first_look[j]:
            path.chances[j] = _foreseen(weights, outlook.free_if[path.slots[j]], path.taken_up[j])


@njit(cache=True)
def _stop_at_best(
    n_path: int,
    left_s: float,
    options: IntArray,
    n_options: int,
    late_s: FloatArray,
    ground: Ground,
    outlook: Outlook,
    path: Path,
) -> float:
    """`worth` of a path on which the chances of all looks are known."""
    values, offers, slots, times, until = path.values, path.offers, path.slots, path.times, path.until
    # What any look still to come can offer, at each vertex, is bounded from below. A slot that is better than that
    # is taken at once; others are kept in mind for a while, in which they grow no better.
    ahead = np.inf
    for k in range(n_path - 1, 0, -1):
        path.ahead[k] = ahead
        for j in range(path.starts[k], path.starts[k + 1]):
            ahead = min(ahead, ground.seconds[path.vertices[k], slots[j]] + ground.walk_s[slots[j]])
        ahead += times[k] - times[k - 1]
    for k in range(1, n_path):
        for j in range(path.starts[k], path.starts[k + 1]):
            at_once = offer(path.vertices[k], slots[j], 1.0, 0.0, late_s[slots[j]], ground, outlook)
            until[j] = k if at_once <= path.ahead[k] else min(k + KEPT_IN_MIND, n_path - 1)
    nothing, onward = left_s, 0.0
    for k in range(n_path - 1, 0, -1):
        # `values` and `nothing` hold what follows at the next vertex, and `onward` is the drive there.
        vertex, first, last = path.vertices[k], path.starts[k], path.starts[k + 1]
        oldest = path.starts[max(k - KEPT_IN_MIND, 1)]
        stop = np.inf
        for i in range(n_options):
            s = options[i]
            stop = min(stop, offer(vertex, s, outlook.free[s], times[k], late_s[s], ground, outlook))
        for j in range(oldest, last):
            if until[j] < k:
                continue
            since = times[k] - path.found[j]
            offers[j] = min(stop, offer(vertex, slots[j], 1.0, since, late_s[slots[j]], ground, outlook))
            later = onward + (nothing if until[j] == k else values[j])
            # The vertex where the slot is seen comes last, and has the last word.
            path.taken_up[j] = offers[j] <= max(path.ahead[k], later)
            values[j] = offers[j] if path.taken_up[j] else later
        nothing = min(stop, onward + nothing)
        # Now back to before the looks at this vertex: the best slot that they show replaces a worse one.
        _best_first(first, last, path)
        for j in range(oldest, first):
            if until[j] < k:
                continue
            rest, expected = 1.0, 0.0
            for i in range(first, last):
                if offers[i] >= offers[j]:
                    break
                expected += rest * path.chances[i] * values[i]
                rest *= 1.0 - path.chances[i]
            values[j] = expected + rest * values[j]
        rest, expected = 1.0, 0.0
        for i in range(first, last):
            expected += rest * path.chances[i] * values[i]
            rest *= 1.0 - path.chances[i]
        nothing = expected + rest * nothing
        onward = times[k] - times[k - 1]
    return onward + nothing


@njit(cache=True)
def _best_first(first: int, last: int, path: Path) -> None:
    """Order the looks made at one vertex by what they offer."""
    for i in range(first + 1, last):
        j = i
        while j > first and path.offers[j] < path.offers[j - 1]:
            for values in (path.offers, path.values, path.chances):
                values[j], values[j - 1] = values[j - 1], values[j]
            for flags in (path.first_look, path.taken_up):
                flags[j], flags[j - 1] = flags[j - 1], flags[j]
            path.slots[j], path.slots[j - 1] = path.slots[j - 1], path.slots[j]
            j -= 1


@njit(cache=True)
def _shows_news(vertex: int, ground: Ground, outlook: Outlook) -> bool:
    """Whether a slot is in view of a vertex that has not been seen yet, or may have come free."""
    for i in range(ground.view_starts[vertex], ground.view_starts[vertex + 1]):
        s = ground.view_slots[i]
        if outlook.kind[s] == UNSEEN or (outlook.kind[s] == LOOKS_TAKEN and outlook.rate[s] > 0.0):
            return True
    return False


@njit(cache=True)
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


@njit(cache=True)
def best_path(
    vertex: int,
    targets: IntArray,
    n_targets: int,
    cost: float,
    budget: Budget,
    ground: Ground,
    outlook: Outlook,
    path: Path,
) -> tuple[float, float, int, int, int, float]:
    """Search for the path of the least expected time, from the last decision's on.

    Candidates are the paths of the thesis's planner at several failure costs, then those past one target
    more, which may be any vertex, put in at any place. Ties go to what was found first.

    Args:
        vertex: where the car is.
        targets: (depth,) int64, of the last decision's path; written to.
        n_targets: how many.
        cost: s, failure cost of the last decision's path.
        budget: how far to search.
        ground: the lot.
        outlook: the belief.
        path: room for one.

    Returns:
        Expected s of the path; expected s of going to the best slot known now; that slot or -1; the vertex that
        comes next on the path or -1; the number of targets; the failure cost.
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
        value = worth(n_path, left, options, 0, late, ground, outlook, path)
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

    best, following, n_kept = np.inf, -1, 0
    if n_targets > 0 and targets[0] == vertex:
        for i in range(1, n_targets):
            targets[i - 1] = targets[i]
        n_targets -= 1
    for i in range(-1, len(budget.costs)):
        tried = n_targets if i < 0 else 0
        if i >= 0:
            cost = budget.costs[i]
        n_path, left = lay(vertex, targets, tried, cost, ground, outlook, path)
        value = worth(n_path, left, options, n_options, late, ground, outlook, path)
        if value < best - 1e-9:
            best, base, n_kept, following = value, cost, tried, path.vertices[1]
            for j in range(tried):
                kept[j] = targets[j]
    if best == np.inf:
        return best, at_hand, slot, -1, 0, base

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
                if u == before or on_way[place, u] or not _shows_news(u, ground, outlook):
                    continue
                for j in range(place):
                    trial[j] = targets[j]
                trial[place] = u
                for j in range(place, n_before):
                    trial[j + 1] = targets[j]
                n_path, left = lay(vertex, trial, n_before + 1, base, ground, outlook, path)
                value = worth(n_path, left, options, n_options, late, ground, outlook, path)
                looks = path.starts[n_path]
                work += 30 * (n_path + looks) + n
                if value < best - 1e-6:
                    best, n_kept, following, improved = value, n_before + 1, path.vertices[1], True
                    for j in range(n_kept):
                        kept[j] = trial[j]
        if not improved:
            break
    for j in range(n_kept):
        targets[j] = kept[j]
    return best, at_hand, slot, following, n_kept, base
