"""Compiled drivers: heuristics that drive the cars of a fleet without Python.

A driver decides by a compiled function `(address of the FLEET record, index of the car) -> action`. Actions are those
of `parkenv/Search-v2`, and `LEAVE` and `TAKE_SLOT + slot` of the fleet's kernel. `greedy-drive`, `first-free` and
`random` are the heuristic baselines of the same names.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from parkenv.compiled.keyed_random import RULE_STREAM, keyed_uniform
from parkenv.compiled.memory import call_address, float64s, int32s, int64s, uint8s
from parkenv.engine.events import LEAVE, TAKE_SLOT
from parkenv.engine.kernel import belief_now, is_slot_open
from parkenv.engine.records import (
    N_ACTIONS,
    SENTINEL,
    car_at,
    edge_at,
    fleet_at,
    scenario_at,
    search_at,
    slot_at,
)
from parkenv.world.lot import MOVES, PARK
from parkenv.world.occupancy.kernel import inlined, kernel

N_MOVES = len(MOVES)
_NONE = -1
_CANDIDATE, _GOOD_FREE, _GIVEN = range(3)  # which slots a route may lead to


@dataclass(frozen=True, eq=False)
class Rule:
    """A compiled driver.

    Args:
        name: for tables.
        decide: compiled function (int64 address of the FLEET record, int64 index of the car) -> int64 action.
    """

    name: str
    decide: Callable[[int, int], int]

    @cached_property
    def address(self) -> int:
        """Address of the compiled function; it is compiled when first asked for."""
        return call_address(self.decide)


@kernel
def decide_random(address: int, number: int) -> int:
    """Choose one of the actions that the graph has, all with equal probability."""
    fleet = fleet_at(address, 0)
    search = search_at(car_at(fleet.cars, number).search, 0)
    masks = uint8s(scenario_at(search.scenario, 0).action_masks)
    first, count = search.vertex * N_ACTIONS, 0
    for action in range(N_ACTIONS):
        count += masks[first + action]
    left = int(keyed_uniform(search.key, RULE_STREAM, 0, search.n_steps) * count)
    for action in range(N_ACTIONS):
        if masks[first + action]:
            if left == 0:
                return action
            left -= 1
    return 0


@kernel
def decide_greedy_drive(address: int, number: int) -> int:
    """Drive to the nearest slot not observed taken, and park there if it is free."""
    fleet = fleet_at(address, 0)
    car = car_at(fleet.cars, number)
    search = search_at(car.search, 0)
    lost = car.target == _NONE or _was_observed_taken(search, car.target)
    if lost and not _plan_route(fleet, car, search, _CANDIDATE, _NONE):
        _plan_to_likeliest(fleet, car, search)
    return int(_follow_route(car, search))


@kernel
def decide_first_free(address: int, number: int) -> int:
    """Drive towards the goal, and take the first free slot that is nearer to it than the median slot.

    From the slot nearest to the goal on, drive to the nearest slot not observed taken.
    """
    fleet = fleet_at(address, 0)
    car = car_at(fleet.cars, number)
    search = search_at(car.search, 0)
    fresh = car.target == _NONE
    if fresh or _was_observed_taken(search, car.target):
        planned = _plan_route(fleet, car, search, _GOOD_FREE, _NONE)
        if not planned and fresh:
            planned = _plan_to_cheapest(fleet, car, search)
        if not planned and not _plan_route(fleet, car, search, _CANDIDATE, _NONE):
            _plan_to_likeliest(fleet, car, search)
    elif not _was_observed_free(search, car.target) and _sees_good_free(fleet, car, search):
        _plan_route(fleet, car, search, _GOOD_FREE, _NONE)
    return int(_follow_route(car, search))


@kernel
def decide_ordered_entry(address: int, number: int) -> int:
    """Stand in the free slot with the lowest cost of arrival at once; if there is none, park elsewhere.

    The driver of queueing theory's ordered entry: it knows everything and drives in no time.
    """
    fleet = fleet_at(address, 0)
    by_cost = int64s(fleet.by_cost + 8 * fleet.n_slots * car_at(fleet.cars, number).place)
    for i in range(fleet.n_slots):
        if is_slot_open(address, by_cost[i], number, fleet.time):
            return int(TAKE_SLOT + by_cost[i])
    return LEAVE


RULES = {
    rule.name: rule
    for rule in (
        Rule("random", decide_random),
        Rule("greedy-drive", decide_greedy_drive),
        Rule("first-free", decide_first_free),
        Rule("ordered-entry", decide_ordered_entry),
    )
}
"""The compiled drivers by name."""


# ---- what a driver knows


@inlined
def _was_observed_taken(search: Any, slot: int) -> bool:
    return bool(slot_at(search.slots, np.int64(int32s(search.columns)[slot])).observed_taken)


@inlined
def _was_observed_free(search: Any, slot: int) -> bool:
    record = slot_at(search.slots, np.int64(int32s(search.columns)[slot]))
    return bool(record.observed and not record.observed_taken)


@inlined
def _cost_s(scenario: Any, slot: int) -> float:
    """Walk from a slot to the goal plus its parking cost, s."""
    return float(float64s(scenario.walk_s)[slot] + float64s(scenario.parking_cost_s)[slot])


@inlined
def _is_good(fleet: Any, car: Any, scenario: Any, slot: int) -> bool:
    """Return whether a slot is at least as near to the goal as the median slot."""
    return bool(_cost_s(scenario, slot) <= float64s(fleet.median_cost_s)[car.place])


@inlined
def _sees_good_free(fleet: Any, car: Any, search: Any) -> bool:
    """Return whether a good slot among those in view was observed free."""
    scenario = scenario_at(search.scenario, 0)
    viewed, starts = int64s(scenario.viewed), int64s(scenario.view_starts)
    for i in range(starts[search.vertex], starts[search.vertex + 1]):
        if _was_observed_free(search, viewed[i]) and _is_good(fleet, car, scenario, viewed[i]):
            return True
    return False


# ---- routes


@inlined
def _follow_route(car: Any, search: Any) -> int:
    """Return the next move to the target; park there."""
    if car.target == search.vertex or car.n_moves == 0:
        return PARK
    car.n_moves -= 1
    return int(uint8s(car.moves)[car.n_moves])


@kernel
def _plan_to_cheapest(fleet: Any, car: Any, search: Any) -> bool:
    """Plan a route to the slot not observed taken with the lowest cost of arrival that can be reached."""
    by_cost = int64s(fleet.by_cost + 8 * fleet.n_slots * car.place)
    for i in range(fleet.n_slots):
        slot = by_cost[i]
        if not _was_observed_taken(search, slot) and _plan_route(fleet, car, search, _GIVEN, slot):
            return True
    return False


@kernel
def _plan_to_likeliest(fleet: Any, car: Any, search: Any) -> None:
    """Where every slot within reach was observed taken: plan a route to the one most likely to be free by now.

    Slots without a route are passed over; the car stays where it is if there is no other.
    """
    car.target, car.n_moves = search.vertex, 0
    best, least = _NONE, np.inf
    for column in range(SENTINEL + 1, search.n_columns + 1):
        p, slot = belief_now(search, column), int(slot_at(search.slots, column).slot)
        if slot != search.vertex and p < least:
            best, least = slot, p
    if best != _NONE:
        _plan_route(fleet, car, search, _GIVEN, best)


@kernel
def _plan_route(fleet: Any, car: Any, search: Any, wanted: int, given: int) -> bool:
    """Plan a shortest route to the nearest wanted slot (Dijkstra); among equals, to that with the least arrival cost.

    Args:
        fleet: the FLEET record, whose work space is used.
        car: the CAR record; its target and moves are set.
        search: its SEARCH record.
        wanted: which slots: `_CANDIDATE`, not observed taken; `_GOOD_FREE`, good and observed free; `_GIVEN`.
        given: the slot for `_GIVEN`.

    Returns:
        Whether there is one; otherwise nothing is changed.
    """
    scenario = scenario_at(search.scenario, 0)
    seconds, origin = float64s(fleet.route_seconds), int64s(fleet.route_from)
    stamp, keys, vertices = (
        int64s(fleet.route_stamp),
        float64s(fleet.route_keys),
        int64s(fleet.route_vertices),
    )
    fleet.route_number += 1
    number, start = fleet.route_number, search.vertex
    stamp[start], seconds[start] = number, 0.0
    keys[0], vertices[0], size = 0.0, start, 1
    best, best_s, least = _NONE, np.inf, np.inf
    while size > 0:
        far, v = keys[0], vertices[0]
        if far > best_s:
            break
        size = _pop(fleet.route_keys, fleet.route_vertices, size)
        if far > seconds[v]:
            continue
        if v < scenario.n_slots and _is_wanted(fleet, car, search, scenario, wanted, given, v):
            cost = _cost_s(scenario, v)
            if cost < least:
                best, best_s, least = v, far, cost
        for move in range(N_MOVES):
            edge = edge_at(scenario.edges, v * N_ACTIONS + move)
            to = edge.target
            after = far + edge.seconds
            if to != v and (stamp[to] != number or after < seconds[to]):
                stamp[to], seconds[to], origin[to] = number, after, v * N_ACTIONS + move
                size = _push(fleet.route_keys, fleet.route_vertices, size, after, to)
    if best == _NONE:
        return False
    moves, n, v = uint8s(car.moves), 0, best
    while v != start:
        moves[n] = origin[v] % N_ACTIONS
        v = origin[v] // N_ACTIONS
        n += 1
    car.target, car.n_moves = best, n
    return True


@inlined
def _is_wanted(fleet: Any, car: Any, search: Any, scenario: Any, wanted: int, given: int, slot: int) -> bool:
    if wanted == _GIVEN:
        return bool(slot == given)
    if wanted == _CANDIDATE:
        return bool(not _was_observed_taken(search, slot))
    return bool(_was_observed_free(search, slot) and _is_good(fleet, car, scenario, slot))


@inlined
def _push(keys_at: int, vertices_at: int, size: int, key: float, vertex: int) -> int:
    """Add an entry to a binary heap; returns its size."""
    keys, vertices, i = float64s(keys_at), int64s(vertices_at), size
    while i > 0 and keys[(i - 1) >> 1] > key:
        keys[i], vertices[i] = keys[(i - 1) >> 1], vertices[(i - 1) >> 1]
        i = (i - 1) >> 1
    keys[i], vertices[i] = key, vertex
    return size + 1


@inlined
def _pop(keys_at: int, vertices_at: int, size: int) -> int:
    """Remove the first entry of a binary heap; returns its size."""
    keys, vertices, size, i = float64s(keys_at), int64s(vertices_at), size - 1, 0
    key, vertex = keys[size], vertices[size]
    while 2 * i + 1 < size:
        child = 2 * i + 1
        if child + 1 < size and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[i], vertices[i] = keys[child], vertices[child]
        i = child
    keys[i], vertices[i] = key, vertex
    return size
