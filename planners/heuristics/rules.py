"""The rules of the heuristics, compiled: which slot to drive to, and the way there.

Each rule is written here once. Agents (`planners.heuristics.agents`) and compiled policies of fleets
(`planners.heuristics.policies`) call it, so they decide alike in every situation.

A slot is a candidate unless it was recently observed taken, or the driver may not park there: then its arrival cost is
infinite. Slots are ranked by the drive, or by arrival cost
(`SearchProblem.arrival_cost_s`): the walk, and the price where slots have one. In a fleet it is that of the car's own
stay.

Rules ask for the states of few slots. In a fleet they are computed from the tables of the search when they are asked
for; an agent writes those of its observation into its `TABLES`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import OBSERVED_FREE, OBSERVED_TAKEN, UNOBSERVED
from parkenv.compiled.heap import pop, push
from parkenv.compiled.jit import inlined, kernel
from parkenv.compiled.memory import ADDRESS, float64_array, float64s, int32_array, int32s, record_at, uint8s
from parkenv.engine.policy import (
    PolicyData,
    arrival_cost_s,
    has_own_price,
    known_slot,
    p_occupied,
    recent_state,
    search_of,
)
from parkenv.world.lot import MOVES
from parkenv.world.scenario import SearchProblem

GREEDY_GOAL, GREEDY_DRIVE, FIRST_FREE, GREEDY_TOTAL = range(4)
NO_SLOT = -1
# How many times `GREEDY_TOTAL` counts the drive to a slot that was not observed, which may be taken.
# Where one slot in two is free, the drive to a slot with arrival cost c pays off against one that is known to be free,
# and takes t in all, if drive + c / 2 + (drive + t) / 2 < t, since it may have to drive back: if c + 3 drive < t.
UNOBSERVED_DETOUR = 3.0
# What `_nearest` ranks slots by: the drive; then the arrival cost; the sum of both.
BY_DRIVE, BY_DRIVE_THEN_COST, BY_TOTAL = range(3)
_N_MOVES = len(MOVES)
_ROUNDING_S = 1e-6


def addresses(names: str) -> list[tuple[str, Any]]:
    """Return fields of a record, separated by spaces, that hold addresses of arrays."""
    return [(name, ADDRESS) for name in names.split()]


# What a heuristic needs in a lot, and its work space.
TABLES = np.dtype(
    [
        ("heuristic", np.int64),
        ("n_slots", np.int64),
        ("n_vertices", np.int64),
        # The drive graph, (n_vertices, 4): int32 vertex that each move leads to, -1 for none; float64 its cost, s.
        *addresses("neighbors move_s"),
        # By place: (n_slots,) float64 arrival costs, s; float64, arrival cost up to which `FIRST_FREE` takes a free
        # slot at once, s.
        *addresses("arrival_cost_s near_s"),
        # A slot with the lowest parking cost.
        ("least_price", np.int64),
        # What the observation of an agent holds, (n_slots,): uint8 recent states; float64 P(taken).
        *addresses("states p_occupied"),
        # Of the last search in the graph: (n_vertices,) float64 drive times, s, inf where it did not arrive;
        # (n_vertices,) int32, the last edge of the shortest route to each vertex, 4 v + move from vertex v;
        # (n_vertices + 1,) int32, how many vertices it reached, and then these.
        *addresses("seconds last_edge reached"),
        # A heap: (4 n_vertices + 1,) float64 keys, int32 vertices.
        *addresses("keys vertices"),
    ],
    align=True,
)
tables_at = record_at(TABLES)


def heuristic_tables(heuristic: int, problems: Sequence[SearchProblem], within_m: float | None) -> PolicyData:
    """Return the tables of a heuristic, such as `GREEDY_GOAL`, for the problem of each place, all in one lot.

    `within_m` is the distance from the goal up to which `FIRST_FREE` takes a free slot at once; None: the median's.
    """
    lot, costs_s = problems[0].lot, np.array([problem.arrival_cost_s for problem in problems], np.float64)
    n, room = lot.n_vertices, _N_MOVES * lot.n_vertices + 1
    near_s = [
        np.median(cost_s[np.isfinite(cost_s)]) if within_m is None else within_m / problem.v_walk
        for problem, cost_s in zip(problems, costs_s, strict=True)
    ]
    least_price = int(problems[0].parking_cost_s.argmin())
    numbers = {"heuristic": heuristic, "n_slots": lot.n_slots, "n_vertices": n, "least_price": least_price}
    arrays: dict[str, NDArray[Any]] = {
        "neighbors": lot.neighbors.astype(np.int32),
        "move_s": np.array(problems[0].move_cost_s, np.float64),
        "arrival_cost_s": costs_s,
        "near_s": np.array(near_s, np.float64),
        "states": np.full(lot.n_slots, UNOBSERVED, np.uint8),
        "p_occupied": np.zeros(lot.n_slots),
        "seconds": np.full(n, np.inf),
        "last_edge": np.zeros(n, np.int32),
        "reached": np.zeros(n + 1, np.int32),
        "keys": np.zeros(room),
        "vertices": np.zeros(room, np.int32),
    }
    return PolicyData(TABLES, numbers, arrays)


@kernel
def keeps_target(heuristic: int, target: int, state: int) -> bool:
    """Return whether a target, or `NO_SLOT`, in a recent state is kept whatever was observed of other slots."""
    if target == NO_SLOT or state == OBSERVED_TAKEN:
        return False
    return heuristic not in (FIRST_FREE, GREEDY_TOTAL) or state == OBSERVED_FREE


@inlined
def choose_route(
    address: int, place: int, search: int, vertex: int, target: int, moves: NDArray[np.uint8], n_moves: int
) -> tuple[int, int]:
    """Choose the slot to drive to where `keeps_target` is False, and plan a shortest route to it.

    `address` is that of the TABLES record, `place` the index of the problem, `search` the address of the SEARCH record
    whose tables hold what was observed, or 0 if those of the heuristic do. `moves`, (2 n_vertices,), are those to the
    target, the last one first, and change in place. Return the target, and the number of moves to it; `NO_SLOT` and 0
    where the driver may park in no slot in reach.
    """
    tables = tables_at(address, 0)
    chosen = _choose_target(tables, place, search, vertex, target)
    if chosen == NO_SLOT:
        chosen = _likeliest_target(tables, place, search, vertex)
    if chosen == NO_SLOT:
        return NO_SLOT, 0
    if chosen == target and state_of(tables, search, target) != OBSERVED_TAKEN:
        return target, n_moves
    n_moves, v = 0, np.int64(chosen)
    while v != vertex:
        edge = np.int64(int32s(tables.last_edge)[v])
        moves[n_moves] = edge % _N_MOVES
        v = edge // _N_MOVES
        n_moves += 1
    return chosen, n_moves


@kernel
def still_leads(
    address: int, place: int, search: int, vertex: int, target: int, moves: NDArray[np.uint8], n_moves: int
) -> bool:
    """Return whether `GREEDY_TOTAL` would choose its target again, which has not been observed, without a search.

    At the last decision it was the best. A step towards it has made it better by three times the step, and no other
    slot by more, unless that was observed free since, or is no longer known to be taken. So it leads if each slot of
    which something is known would be worse even if it were here. Arguments are as for `choose_route`, in a fleet.
    """
    tables = tables_at(address, 0)
    far, v = 0.0, np.int64(vertex)
    for i in range(n_moves - 1, -1, -1):
        edge = v * _N_MOVES + moves[i]
        far += float64s(tables.move_s)[edge]
        v = np.int64(int32s(tables.neighbors)[edge])
    total_s = cost_of(tables, place, search, target) + UNOBSERVED_DETOUR * far
    for i in range(_n_known(tables, search)):
        slot = _known_slot(search, i)
        if slot == target or cost_of(tables, place, search, slot) > total_s + _ROUNDING_S:
            continue
        if state_of(tables, search, slot) != OBSERVED_TAKEN:
            return False
    return True


# ---- what was observed


@inlined
def state_of(tables: Any, search: int, slot: int) -> int:
    return int(recent_state(search_of(search), slot) if search else uint8s(tables.states)[slot])


@inlined
def _p_occupied(tables: Any, search: int, slot: int) -> float:
    return float(p_occupied(search_of(search), slot) if search else float64s(tables.p_occupied)[slot])


@inlined
def _n_known(tables: Any, search: int) -> int:
    """Return of how many slots something may have been observed."""
    return int(search_of(search).n_columns if search else tables.n_slots)


@inlined
def _known_slot(search: int, i: int) -> int:
    return int(known_slot(search_of(search), i) if search else i)


@inlined
def _expected_cost_s(tables: Any, place: int, slot: int) -> float:
    """Return the arrival cost of a slot for the expected stay, s."""
    return float(float64s(tables.arrival_cost_s)[tables.n_slots * place + slot])


@inlined
def cost_of(tables: Any, place: int, search: int, slot: int) -> float:
    """Return the arrival cost of a slot for the car's own stay, s."""
    if search and has_own_price(search_of(search)):
        return float(arrival_cost_s(search_of(search), slot))
    return float(_expected_cost_s(tables, place, slot))


@inlined
def _near_s(tables: Any, place: int, search: int) -> float:
    """Return the arrival cost up to which `FIRST_FREE` takes a free slot at once, s.

    For a car's own stay it rises by what the lowest price does.
    """
    slot = np.int64(tables.least_price)
    more_s = cost_of(tables, place, search, slot) - _expected_cost_s(tables, place, slot)
    return float(float64s(tables.near_s)[place] + more_s)


# ---- the choice


@inlined
def _choose_target(tables: Any, place: int, search: int, vertex: int, previous: int) -> int:
    """Return the slot to drive to; `NO_SLOT` if every slot in reach was observed taken."""
    if tables.heuristic == GREEDY_GOAL:
        return int(_cheapest(tables, place, search, vertex))
    if tables.heuristic == FIRST_FREE:
        return int(_first_free(tables, place, search, vertex, previous))
    order = BY_DRIVE_THEN_COST if tables.heuristic == GREEDY_DRIVE else BY_TOTAL
    return int(_nearest(tables, place, search, vertex, False, np.inf, order))


@kernel
def _first_free(tables: Any, place: int, search: int, vertex: int, previous: int) -> int:
    """Return the nearest free slot near the goal; without one the target so far, the first one near the goal."""
    near_s = _near_s(tables, place, search)
    for i in range(_n_known(tables, search)):
        slot = _known_slot(search, i)
        is_near = cost_of(tables, place, search, slot) <= near_s
        if is_near and state_of(tables, search, slot) == OBSERVED_FREE:
            nearest = _nearest(tables, place, search, vertex, True, near_s, BY_DRIVE)
            if nearest != NO_SLOT:
                return int(nearest)
            break
    if previous == NO_SLOT:
        return int(_cheapest(tables, place, search, vertex))
    if state_of(tables, search, previous) != OBSERVED_TAKEN:
        return previous
    return int(_nearest(tables, place, search, vertex, False, np.inf, BY_DRIVE))


@kernel
def _likeliest_target(tables: Any, place: int, search: int, vertex: int) -> int:
    """Return the slot most likely to be free by now, for where every slot in reach was observed taken.

    It is another one than the slot before which the car stands, if there is one; `NO_SLOT` if none can be reached.
    """
    _search_everywhere(tables, place, search, vertex)
    seconds, best, least = float64s(tables.seconds), NO_SLOT, np.inf
    for slot in range(tables.n_slots):
        if slot != vertex and seconds[slot] < np.inf and cost_of(tables, place, search, slot) < np.inf:
            p = _p_occupied(tables, search, slot)
            if p < least:
                best, least = slot, p
    if best == NO_SLOT and vertex < tables.n_slots and cost_of(tables, place, search, vertex) < np.inf:
        return vertex
    return best


@kernel
def _cheapest(tables: Any, place: int, search: int, vertex: int) -> int:
    """Return the candidate with the lowest arrival cost; among equals, the one with the shortest drive."""
    seconds, least, lowest = float64s(tables.seconds), np.inf, np.inf
    for slot in range(tables.n_slots):
        cost_s = cost_of(tables, place, search, slot)
        if cost_s < least and state_of(tables, search, slot) != OBSERVED_TAKEN:
            least = cost_s
    best = int(_nearest(tables, place, search, vertex, False, least, BY_DRIVE))
    if best == NO_SLOT and least < np.inf:
        # It cannot be reached: among those that can.
        _search_everywhere(tables, place, search, vertex)
        for slot in range(tables.n_slots):
            cost_s = cost_of(tables, place, search, slot)
            if max(cost_s, seconds[slot]) == np.inf or state_of(tables, search, slot) == OBSERVED_TAKEN:
                continue
            if best == NO_SLOT or (cost_s, seconds[slot]) < (lowest, seconds[best]):
                best, lowest = slot, cost_s
    return best


@kernel
def _search_everywhere(tables: Any, place: int, search: int, vertex: int) -> None:
    _nearest(tables, place, search, vertex, False, -np.inf, BY_DRIVE)


@kernel
def _nearest(
    tables: Any, place: int, search: int, vertex: int, only_free: bool, limit_s: float, order: int
) -> int:
    """Return the first slot in an `order`, such as `BY_DRIVE` (Dijkstra's algorithm), or `NO_SLOT`.

    Among equals it is that of the lowest number. Only slots up to an arrival cost of `limit_s` count. Afterwards drive
    times in the tables are exact up to the slot, upper bounds beyond.
    """
    seconds, reached, last_edge = float64s(tables.seconds), int32s(tables.reached), int32s(tables.last_edge)
    neighbors, move_s = int32s(tables.neighbors), float64s(tables.move_s)
    room = _N_MOVES * tables.n_vertices + 1
    keys, vertices = float64_array(tables.keys, (room,)), int32_array(tables.vertices, (room,))
    for i in range(1, reached[0] + 1):
        seconds[reached[i]] = np.inf
    seconds[vertex], reached[0], reached[1] = 0.0, 1, vertex
    size = push(keys, vertices, 0, 0.0, vertex)
    best, best_s, best_cost_s = NO_SLOT, np.inf, np.inf
    while size > 0:
        far, v = keys[0], np.int64(vertices[0])
        if far > best_s:
            break
        size = pop(keys, vertices, size)
        if far > seconds[v]:
            continue
        if v < tables.n_slots and (limit_s == np.inf or cost_of(tables, place, search, v) <= limit_s):
            state = state_of(tables, search, v)
            if state == OBSERVED_FREE or not (only_free or state == OBSERVED_TAKEN):
                value, cost_s = far, cost_of(tables, place, search, v)
                if order == BY_TOTAL:
                    value = cost_s + (far if state == OBSERVED_FREE else UNOBSERVED_DETOUR * far)
                by_cost = order == BY_DRIVE_THEN_COST and cost_s != best_cost_s
                first = cost_s < best_cost_s if by_cost else v < best
                if cost_s < np.inf and (value < best_s or (value == best_s and first)):
                    best, best_s, best_cost_s = int(v), value, cost_s
        for edge in range(v * _N_MOVES, (v + 1) * _N_MOVES):
            u, after = np.int64(neighbors[edge]), far + move_s[edge]
            if u >= 0 and after < seconds[u]:
                if seconds[u] == np.inf:
                    reached[0] += 1
                    reached[reached[0]] = u
                seconds[u], last_edge[u] = after, edge
                size = push(keys, vertices, size, after, u)
    return best
