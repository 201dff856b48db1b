"""Where the cars stand that are parked when a world begins."""

from __future__ import annotations

import math

import numpy as np

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled

_TAKEN_BEFORE = 0.8
"""Chance that a free slot was taken when such a car came: it stands in the first one that was not. A counted facility
that has room had room."""
_MOST_PASSED = 30


@compiled
def park_at_first(
    place: IntArray,
    walks: FloatArray,
    u: FloatArray,
    zone_cost_s: FloatArray,
    walk_s: FloatArray,
    by_walk: IntArray,
    zone_of_slot: IntArray,
    left: IntArray,
    first_counted: int,
    slots: IntArray,
) -> None:
    """Choose slots for cars, one after another: the cheapest one by walk and price that is free and was so before.

    Args:
        place: (n,) place that people walk to from each car.
        walks: (n,) factor of the walk, 2 where the way back counts.
        u: (n,) uniform numbers in (0, 1).
        zone_cost_s: (n, n_zones) s, what parking costs each car; infinite where it may not park.
        walk_s: (n_places, n_slots) s.
        by_walk: (n_places, n_slots) slots by `walk_s`.
        zone_of_slot: (n_slots,)
        left: (n_slots,) cars that still fit; counted down.
        first_counted: index of the first counted facility; those are the last slots.
        slots: (n,) the result; -1 if no slot is left where the car may park.
    """
    cost_s, found = np.empty(_MOST_PASSED), np.empty(_MOST_PASSED, np.int64)
    for car in range(len(place)):
        wanted = 1 + min(int(math.log(u[car]) / math.log(_TAKEN_BEFORE)), _MOST_PASSED - 1)
        n = 0
        for slot in by_walk[place[car]]:
            walk = walks[car] * walk_s[place[car], slot]
            if n == wanted and walk >= cost_s[n - 1]:
                break
            cost = walk + zone_cost_s[car, zone_of_slot[slot]]
            if left[slot] == 0 or cost == np.inf or (n == wanted and cost >= cost_s[n - 1]):
                continue
            n = min(n + 1, wanted)
            at = n - 1
            while at > 0 and cost_s[at - 1] > cost:
                cost_s[at], found[at] = cost_s[at - 1], found[at - 1]
                at -= 1
            cost_s[at], found[at] = cost, slot
            if slot >= first_counted:
                n = wanted = at + 1
        slots[car] = found[n - 1] if n else -1
        if n:
            left[found[n - 1]] -= 1
