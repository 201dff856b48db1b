"""What a path through a lot is worth to a car that may stop at any free slot it has seen, compiled.

A path says where to look next as long as all that was seen is taken. At every vertex of it the car knows what it
has passed, and either settles for the best free slot so far, which may mean to drive back, or goes on. That is
optimal stopping with recall, and its value follows exactly by going through the path backwards: the state is
which slot is the best so far, or none.

Whoever comes too late to a slot goes on searching, for a time that is estimated once a decision, or tries the next of
those that it knows to be free.
"""

from __future__ import annotations

import numpy as np

from planners.belief.path_rollout import foreseen
from planners.belief.planning_graph import FloatArray, Ground, IntArray, Outlook, Path, decayed
from sim_sensors.compilation import compiled

KEPT_IN_MIND = 32
"""Vertices along which a free slot that was passed is kept in mind."""


@compiled
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


@compiled
def worth(
    n_path: int,
    left_s: float,
    options: IntArray,
    n_options: int,
    late_s: FloatArray,
    ground: Ground,
    outlook: Outlook,
    path: Path,
) -> tuple[float, float]:
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
        The value of driving on to its second vertex, and that of not stopping there either, counted from there; inf
        where it has none.
    """
    if n_path < 2:
        return np.inf, np.inf
    path.taken_up[: path.starts[n_path]] = False
    _foresee(n_path, outlook, path)
    value, then_s = _stop_at_best(n_path, left_s, options, n_options, late_s, ground, outlook, path)
    if len(outlook.weights) > 1:
        _foresee(n_path, outlook, path)
        value, then_s = _stop_at_best(n_path, left_s, options, n_options, late_s, ground, outlook, path)
    return value, then_s


@compiled
def _foresee(n_path: int, outlook: Outlook, path: Path) -> None:
    """Write down P(free) of the first looks along a path, each given that those before led to no parking."""
    weights = path.weights[: len(outlook.weights)]
    weights[:] = outlook.weights
    for j in range(path.starts[n_path]):
        if path.first_look[j]:
            path.chances[j] = foreseen(weights, outlook.free_if[path.slots[j]], path.taken_up[j])


@compiled
def _stop_at_best(
    n_path: int,
    left_s: float,
    options: IntArray,
    n_options: int,
    late_s: FloatArray,
    ground: Ground,
    outlook: Outlook,
    path: Path,
) -> tuple[float, float]:
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
    nothing, onward, then_s = left_s, 0.0, left_s
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
        then_s = onward + nothing
        nothing = min(stop, then_s)
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
    return onward + nothing, then_s


@compiled
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
