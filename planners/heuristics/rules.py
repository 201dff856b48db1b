"""The rules of the heuristics, compiled: which slot to drive to, and the way there.

Each rule is written here once. Agents (`planners.heuristics.agents`) and compiled policies of fleets
(`planners.heuristics.policies`) call it, so they decide alike in every situation.

A slot is a candidate unless it was recently observed taken. Slots are ranked by the drive, or by arrival cost
(`SearchProblem.arrival_cost_s`): the walk, and the price where slots have one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import OBSERVED_FREE, OBSERVED_TAKEN
from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.heap import pop, push
from parkenv.compiled.jit import compiled
from parkenv.world.lot import MOVES
from parkenv.world.scenario import SearchProblem
from planners.thesis.label_setting import edges_in

GREEDY_GOAL, GREEDY_DRIVE, FIRST_FREE = range(3)
NO_SLOT = -1
_N_MOVES = len(MOVES)
_TOLERANCE = 1e-9  # of a drive time, for sums of its parts in another order

rule = compiled(error_model="numpy", _nrt=False)
inlined_rule = compiled(error_model="numpy", _nrt=False, forceinline=True)


class DriveGraph(NamedTuple):
    """The drive graph of a lot, and work space for searches in it.

    Attributes:
        neighbors: (n_vertices, 4) int32, the vertex that each move leads to; -1 for none.
        move_s: (n_vertices, 4) float64, s.
        in_start: (n_vertices + 1,) int32; edges into v are rows `in_start[v]` to `in_start[v + 1]` of the next two.
        in_source: (n_edges,) int32, the vertex that the edge comes from.
        in_s: (n_edges,) float64, s.
        seconds: (n_vertices,) float64, drive times of the last search, s; inf where it did not arrive.
        last_edge: (n_vertices,) int32, the last edge of its shortest route to each vertex, 4 v + move from vertex v.
        reached: (n_vertices + 1,) int32, how many vertices the last search reached, and then these.
        keys: (4 n_vertices + 1,) float64, of a heap.
        vertices: (4 n_vertices + 1,) int32, of that heap.
    """

    neighbors: NDArray[np.int32]
    move_s: FloatArray
    in_start: NDArray[np.int32]
    in_source: NDArray[np.int32]
    in_s: FloatArray
    seconds: FloatArray
    last_edge: NDArray[np.int32]
    reached: NDArray[np.int32]
    keys: FloatArray
    vertices: NDArray[np.int32]

    @classmethod
    def of(cls, problem: SearchProblem) -> DriveGraph:
        """Return the graph of a problem's lot."""
        # Copies: numba would compile every function again for read-only arrays.
        neighbors, move_s = problem.lot.neighbors.astype(np.int32), problem.move_cost_s.copy()
        in_start, in_source, _, in_s = edges_in(neighbors, move_s)
        n = len(neighbors)
        room = _N_MOVES * n + 1
        return cls(
            neighbors,
            move_s,
            in_start,
            in_source,
            in_s,
            np.full(n, np.inf),
            np.zeros(n, np.int32),
            np.zeros(n + 1, np.int32),
            np.zeros(room),
            np.zeros(room, np.int32),
        )


@rule
def keeps_target(heuristic: int, target: int, state: int) -> bool:
    """Return whether the target is kept whatever was observed of other slots.

    Args:
        heuristic: `GREEDY_GOAL`, `GREEDY_DRIVE` or `FIRST_FREE`.
        target: the slot to drive to, or `NO_SLOT`.
        state: its recent state, see `SlotBelief.recent_state`.
    """
    if target == NO_SLOT or state == OBSERVED_TAKEN:
        return False
    return heuristic != FIRST_FREE or state == OBSERVED_FREE


@rule
def choose_target(
    heuristic: int,
    graph: DriveGraph,
    arrival_cost_s: FloatArray,
    near_s: float,
    states: NDArray[np.uint8],
    vertex: int,
    previous: int,
) -> int:
    """Return the slot to drive to where `keeps_target` is False; `NO_SLOT` if every slot was observed taken.

    Args:
        heuristic: `GREEDY_GOAL`, `GREEDY_DRIVE` or `FIRST_FREE`.
        graph: the drive graph; its work space holds the drive times afterwards.
        arrival_cost_s: (n_slots,) s.
        near_s: arrival cost up to which `FIRST_FREE` takes a free slot at once, s.
        states: (n_slots,) uint8, recent states.
        vertex: where the car is.
        previous: the target so far, or `NO_SLOT`.
    """
    is_kept = previous != NO_SLOT and states[previous] != OBSERVED_TAKEN
    if heuristic == FIRST_FREE:
        for slot in range(len(states)):
            if states[slot] == OBSERVED_FREE and arrival_cost_s[slot] <= near_s:
                found = _nearest(graph, arrival_cost_s, states, vertex, True, near_s, False)
                if found != NO_SLOT:
                    return int(found)
                break
        if is_kept:
            return previous
    if heuristic == GREEDY_DRIVE:
        return int(_nearest(graph, arrival_cost_s, states, vertex, False, np.inf, True))
    if heuristic == FIRST_FREE and previous != NO_SLOT:
        return int(_nearest(graph, arrival_cost_s, states, vertex, False, np.inf, False))
    return int(_cheapest(graph, arrival_cost_s, states, vertex))


@rule
def likeliest_target(
    graph: DriveGraph,
    arrival_cost_s: FloatArray,
    states: NDArray[np.uint8],
    p_occupied: FloatArray,
    vertex: int,
) -> int:
    """Return the slot most likely to be free by now, for where every slot in reach was observed taken.

    It is another one than the slot before which the car stands, if there is one; `NO_SLOT` if none can be reached.

    Args:
        graph: the drive graph; its work space holds the drive times afterwards.
        arrival_cost_s: (n_slots,) s.
        states: (n_slots,) uint8, recent states.
        p_occupied: (n_slots,) P(taken).
        vertex: where the car is.
    """
    _search_everywhere(graph, arrival_cost_s, states, vertex)
    best = NO_SLOT
    for slot in range(len(states)):
        other = slot != vertex and graph.seconds[slot] < np.inf
        if other and (best == NO_SLOT or p_occupied[slot] < p_occupied[best]):
            best = slot
    if best == NO_SLOT and vertex < len(states):
        return vertex
    return best


@rule
def plan_route(graph: DriveGraph, vertex: int, target: int, moves: NDArray[np.uint8]) -> int:
    """Write the moves of a shortest route to the target of the last search; return their number.

    Args:
        graph: the drive graph, after `choose_target` or `likeliest_target` from this vertex.
        vertex: where the car is.
        target: the slot that it returned.
        moves: (n_vertices,) output: the moves, the last one first.
    """
    n = 0
    while target != vertex:
        edge = graph.last_edge[target]
        moves[n] = edge % _N_MOVES
        target = edge // _N_MOVES
        n += 1
    return n


@rule
def _cheapest(graph: DriveGraph, arrival_cost_s: FloatArray, states: NDArray[np.uint8], vertex: int) -> int:
    """Return the candidate with the lowest arrival cost; among equals, the one with the shortest drive."""
    least = np.inf
    for slot in range(len(states)):
        if states[slot] != OBSERVED_TAKEN:
            least = min(least, arrival_cost_s[slot])
    found = int(_nearest(graph, arrival_cost_s, states, vertex, False, least, False))
    if found == NO_SLOT and least < np.inf:
        # It cannot be reached: among those that can.
        _search_everywhere(graph, arrival_cost_s, states, vertex)
        least = np.inf
        for slot in range(len(states)):
            if states[slot] != OBSERVED_TAKEN and graph.seconds[slot] < np.inf:
                least = min(least, arrival_cost_s[slot])
        found = NO_SLOT
        for slot in range(len(states)):
            nearer = graph.seconds[slot] < (np.inf if found == NO_SLOT else graph.seconds[found])
            if states[slot] != OBSERVED_TAKEN and arrival_cost_s[slot] == least and nearer:
                found = slot
    return found


@rule
def _search_everywhere(
    graph: DriveGraph, arrival_cost_s: FloatArray, states: NDArray[np.uint8], vertex: int
) -> None:
    """Compute the drive times from a vertex to all others."""
    _nearest(graph, arrival_cost_s, states, vertex, False, -np.inf, False)


@rule
def _nearest(
    graph: DriveGraph,
    arrival_cost_s: FloatArray,
    states: NDArray[np.uint8],
    vertex: int,
    only_free: bool,
    limit_s: float,
    by_cost: bool,
) -> int:
    """Return the nearest of some slots (Dijkstra's algorithm); among equals, the first one; `NO_SLOT` if there is none.

    Args:
        graph: the drive graph, whose work space is used; drive times are exact up to the slot, upper bounds beyond.
        arrival_cost_s: (n_slots,) s.
        states: (n_slots,) uint8, recent states.
        vertex: where the car is.
        only_free: whether only slots observed free count, not all candidates.
        limit_s: arrival cost up to which slots count, s.
        by_cost: whether that with the lowest arrival cost comes first among equals.
    """
    seconds, reached = graph.seconds, graph.reached
    for i in range(1, reached[0] + 1):
        seconds[reached[i]] = np.inf
    seconds[vertex], reached[0], reached[1] = 0.0, 1, vertex
    size = push(graph.keys, graph.vertices, 0, 0.0, vertex)
    best, best_s = NO_SLOT, np.inf
    while size > 0:
        far, v = graph.keys[0], np.int64(graph.vertices[0])
        if far > best_s:
            break
        size = pop(graph.keys, graph.vertices, size)
        if far > seconds[v]:
            continue
        counts = v < len(states) and arrival_cost_s[v] <= limit_s and _counts(states[v], only_free)
        if counts and (best == NO_SLOT or _comes_first(v, best, arrival_cost_s, by_cost)):
            best, best_s = int(v), far
        for move in range(_N_MOVES):
            u = np.int64(graph.neighbors[v, move])
            if u < 0:
                continue
            after = far + graph.move_s[v, move]
            if after < seconds[u]:
                if seconds[u] == np.inf:
                    reached[0] += 1
                    reached[reached[0]] = u
                seconds[u], graph.last_edge[u] = after, v * _N_MOVES + move
                size = push(graph.keys, graph.vertices, size, after, u)
    return best


@inlined_rule
def _counts(state: int, only_free: bool) -> bool:
    return state == OBSERVED_FREE or not (only_free or state == OBSERVED_TAKEN)


@inlined_rule
def _comes_first(slot: int, other: int, arrival_cost_s: FloatArray, by_cost: bool) -> bool:
    """Return whether of two slots at the same drive time the first one is chosen."""
    if by_cost and arrival_cost_s[slot] != arrival_cost_s[other]:
        return bool(arrival_cost_s[slot] < arrival_cost_s[other])
    return slot < other
