"""The thesis's MDP as a stopping problem, solved exactly by one pass of label setting.

A failed attempt leads back to the slot that it was made at, so repeating it until it succeeds has a closed-form value,
Q(u) = (p·(r_max - r_u) - (1-p)·c) / (1 - γ(1-p)), r being the arrival cost and c the failure cost. What is left to
decide is where to stop: with costs J = -V,

    J(u) = min( h(u), min over edges u→v of d + γ·J(v) ),

where h(u) is the least cost of staying at u: attempts until one succeeds, waiting for ever, or shuttling for ever
along an edge and back. Labels spread from the cheapest stops against the edges, as in Dijkstra's algorithm.

**Why it is exact.** An edge is called climbing where d + γ·J(v) > J(v), that is J(v) < d/(1-γ): driving on over such
edges for ever costs more than v. While edges climb, labels are settled in ascending order, each once; in any
digraph that holds for all labels below d_min/(1-γ). The queue has buckets as wide as the shortest edge. They are
exact while that is at most the least climb (Denardo and Fox 1979), which γ lowers a little at positive labels. Where
a label that was spread still improves, for either reason, it is spread again. So when the pass terminates no
edge offers less than any label: J satisfies the equation above, whose solution is unique where γ < 1. Termination is
the certificate.

It terminates on two-way edges, since h includes the cost of shuttling, so that every edge climbs or ties; and
wherever no directed cycle beats every stop. Where one does, labels would fall for ever: a limit on the work stops
that, first with a heap, whose order does not depend on climbs, and then policy iteration takes over.
At γ = 1 it is Dijkstra's algorithm with a virtual source; plans that never end cost infinity.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.world.lot import PARK
from planners.thesis.heap import pop, push
from planners.thesis.mdp import ParkingMDP
from planners.thesis.policy_iteration import Solution, policy_iteration
from sim_sensors.compilation import compiled

FloatArray = NDArray[np.float64]

STOP = PARK
"""The move of a vertex at which to stay: to park, or because nothing is reachable."""
TIE_S = 1e-7
"""s: actions whose values differ by less are equally good; solvers agree to well within it."""
_BUCKETS_PER_VERTEX = 2
"""Buckets per vertex at most, so that passing over empty ones costs little."""
_REFILLS = 64
"""How often all buckets may be refilled before a heap is faster."""


class StoppingGraph(NamedTuple):
    """The part of the stopping problem that does not depend on the belief.

    Attributes:
        neighbors: (n, 4) int32, the vertex that up, down, left, right lead to, or -1.
        move_s: (n, 4) float64, s, drive time of each edge.
        in_start: (n + 1,) int32; the edges to v are rows in_start[v] to in_start[v + 1] of the next three.
        in_source: (m,) int32, where the edge comes from.
        in_move: (m,) int8, which move it is there.
        in_s: (m,) float64, s, its drive time.
        park_reward: (n,) float64, s, r_max - r_u.
        never_s: (n,) float64, s, least discounted cost of waiting, or shuttling along one edge, for ever; inf
            at γ = 1.
        failure_s: s, what the planner believes a failed attempt to cost.
        wait_s: s, cost of a move that the graph does not have.
        gamma: discount a decision.
    """

    neighbors: NDArray[np.int32]
    move_s: FloatArray
    in_start: NDArray[np.int32]
    in_source: NDArray[np.int32]
    in_move: NDArray[np.int8]
    in_s: FloatArray
    park_reward: FloatArray
    never_s: FloatArray
    failure_s: float
    wait_s: float
    gamma: float

    @classmethod
    def of(cls, mdp: ParkingMDP) -> StoppingGraph:
        """Make the graph of a process, without its probabilities."""
        # Copies: numba compiles a function once more for arrays that are read-only.
        neighbors, move_s = mdp.neighbors.astype(np.int32), np.array(mdp.move_s, order="C")
        in_start, in_source, in_move, in_s = edges_in(neighbors, move_s)
        never_s = _never(neighbors, move_s, mdp.wait_s, mdp.gamma)
        return cls(
            neighbors,
            move_s,
            in_start,
            in_source,
            in_move,
            in_s,
            np.ascontiguousarray(mdp.park_reward),
            never_s,
            float(mdp.failure_s),
            float(mdp.wait_s),
            float(mdp.gamma),
        )


@dataclass
class Labels:
    """A plan: the cost of each vertex and the action there. `label_repair.repair` changes it in place.

    Attributes:
        cost: (n,) float64, s, -V of each vertex.
        move: (n,) int8, the move that the label came from, or `STOP`.
        p_free: (n,) float64, the probabilities that it was made for.
        settled: whether `move` leads from every vertex to a stop, by edges that the labels follow exactly; False
            where another solver made the plan.
    """

    cost: FloatArray
    move: NDArray[np.int8]
    p_free: FloatArray
    settled: bool


def label_setting(mdp: ParkingMDP) -> Solution:
    """Solve the process exactly, in near-linear time; the module states the conditions and the proof.

    Unlike policy iteration it takes gamma 1, where a vertex that can reach no slot has value -inf. The policy
    breaks ties as `best_move` says. `iterations` is 1, or those of policy iteration where it had to take over.
    """
    graph = StoppingGraph.of(mdp)
    labels = set_labels(graph, mdp.p_free)
    iterations = 1
    if not labels.settled:
        labels, iterations = by_policy_iteration(mdp, labels)
    return Solution(-labels.cost, best_moves(graph, labels.p_free, labels.cost), iterations)


def set_labels(graph: StoppingGraph, p_free: FloatArray) -> Labels:
    """Plan by one pass of label setting.

    Args:
        graph: the stopping problem.
        p_free: (n,) float64; kept, not copied.

    Returns:
        The plan; where `settled` is False circling pays somewhere and the costs are upper bounds only.
    """
    n = len(p_free)
    labels = Labels(np.empty(n), np.empty(n, dtype=np.int8), p_free, settled=False)
    update_labels(graph, labels)
    return labels


def update_labels(graph: StoppingGraph, labels: Labels) -> None:
    """Update a plan to its present probabilities by one pass of label setting, in place."""
    width = float(graph.in_s.min()) if len(graph.in_s) else 1.0
    labels.settled = bool(
        _set_by_buckets(graph, labels.p_free, width, labels.cost, labels.move)
        or _set_by_heap(graph, labels.p_free, labels.cost, labels.move)
    )


def by_policy_iteration(mdp: ParkingMDP, start: Labels | None = None) -> tuple[Labels, int]:
    """Plan by the thesis's solver, starting from the moves of another plan; return the plan and the iterations.

    Raises:
        InputError: gamma is 1.
    """
    policy = None if start is None else start.move.astype(np.int64)
    solution = policy_iteration(mdp, policy)
    labels = Labels(-solution.values, solution.policy.astype(np.int8), mdp.p_free, settled=False)
    return labels, solution.iterations


def with_p_free(mdp: ParkingMDP, p_free: FloatArray) -> ParkingMDP:
    """Return the same process with other probabilities, (n,)."""
    return dataclasses.replace(mdp, p_free=p_free)


@compiled(error_model="numpy")
def stop_cost(graph: StoppingGraph, p_free: FloatArray, vertex: int) -> float:
    """Return h, the least cost, s, of staying at a vertex."""
    p = p_free[vertex]
    left = 1.0 - graph.gamma * (1.0 - p)
    if left <= 0.0:
        return np.inf
    retry = ((1.0 - p) * graph.failure_s - p * graph.park_reward[vertex]) / left
    return float(min(retry, graph.never_s[vertex]))


@compiled(error_model="numpy")
def move_cost(graph: StoppingGraph, cost: FloatArray, vertex: int, move: int) -> float:
    """Return the cost, s, of a move followed by the plan; a missing move waits."""
    v = graph.neighbors[vertex, move]
    if v < 0:
        return graph.wait_s + graph.gamma * float(cost[vertex])
    return float(graph.move_s[vertex, move] + graph.gamma * cost[v])


@compiled(error_model="numpy")
def best_move(graph: StoppingGraph, p_free: FloatArray, cost: FloatArray, vertex: int) -> int:
    """Return an optimal action of one vertex, by the costs alone, so that solvers which agree choose the same.

    Among actions that are equally good to within `TIE_S` parking comes first, then the moves in order. Where
    every cost is infinite it waits if it can.
    """
    p = p_free[vertex]
    park = (1.0 - p) * graph.failure_s - p * graph.park_reward[vertex]
    if p < 1.0:
        park += (1.0 - p) * graph.gamma * cost[vertex]
    best = park
    n_moves = graph.neighbors.shape[1]
    for move in range(n_moves):
        best = min(best, move_cost(graph, cost, vertex, move))
    if best < np.inf:
        if park <= best + TIE_S:
            return STOP
        for move in range(n_moves):
            if move_cost(graph, cost, vertex, move) <= best + TIE_S:
                return move
    for move in range(n_moves):
        if graph.neighbors[vertex, move] < 0:
            return move
    return STOP


@compiled(error_model="numpy")
def best_moves(graph: StoppingGraph, p_free: FloatArray, cost: FloatArray) -> NDArray[np.int64]:
    """Return `best_move` of every vertex, (n,) int64."""
    moves = np.empty(len(cost), dtype=np.int64)
    for u in range(len(cost)):
        moves[u] = best_move(graph, p_free, cost, u)
    return moves


@compiled(error_model="numpy")
def _is_source(graph: StoppingGraph, cost: FloatArray, u: int) -> bool:
    """Return whether labels may have to start from a vertex: not where one hop to a cheaper stop beats stopping.

    The stop one hop off must be the cheaper one: at the cost of shuttling two vertices could otherwise each
    leave it to the other by a rounding error.
    """
    own = cost[u]
    if own == np.inf:
        return False
    for move in range(graph.neighbors.shape[1]):
        v = graph.neighbors[u, move]
        if v >= 0 and cost[v] < own and graph.move_s[u, move] + graph.gamma * cost[v] < own:
            return False
    return True


@compiled(error_model="numpy")
def _set_by_buckets(
    graph: StoppingGraph, p_free: FloatArray, width: float, cost: FloatArray, move: NDArray[np.int8]
) -> bool:
    """Fill `cost` and `move`; bucket b holds the vertices to spread whose labels lie in [b, b + 1) times `width`.

    Buckets are linked lists in one pool. Those beyond the last bucket wait in `later` until all buckets before
    are empty, and then refill them.

    Returns:
        Whether the pass terminated within its limits.
    """
    n = len(cost)
    for u in range(n):
        cost[u] = stop_cost(graph, p_free, u)
        move[u] = STOP
    sources, n_sources = np.empty(n, dtype=np.int32), 0
    low, high = np.inf, -np.inf
    for u in range(n):
        if _is_source(graph, cost, u):
            sources[n_sources] = u
            n_sources += 1
            low, high = min(low, cost[u]), max(high, cost[u])
    if n_sources == 0:
        return True
    if not width > 0.0 or (high - low) / width > 1e15:
        return False
    per_s = 1.0 / width

    n_buckets = int(min((high - low) * per_s, _BUCKETS_PER_VERTEX * n)) + 64
    head = np.full(n_buckets, -1, dtype=np.int32)
    # Where edges climb, a vertex is spread once: each source and each edge enters at most one label.
    pool = 2 * (n + len(graph.in_s)) + 64
    entry_vertex, entry_next, used = np.empty(pool, dtype=np.int32), np.empty(pool, dtype=np.int32), 0
    to_spread = np.zeros(n, dtype=np.bool_)
    later, first = -1, 0
    for i in range(n_sources):
        u = sources[i]
        to_spread[u] = True
        b = int((cost[u] - low) * per_s)
        entry_vertex[used] = u
        if b < n_buckets:
            entry_next[used], head[b] = head[b], used
        else:
            entry_next[used], later = later, used
        used += 1
    for _ in range(_REFILLS):
        for b in range(n_buckets):
            while head[b] >= 0:
                v = entry_vertex[head[b]]
                head[b] = entry_next[head[b]]
                if not to_spread[v]:
                    continue
                to_spread[v] = False
                ahead = cost[v]
                for e in range(graph.in_start[v], graph.in_start[v + 1]):
                    u = graph.in_source[e]
                    label = graph.in_s[e] + graph.gamma * ahead
                    if label < cost[u]:
                        if used == pool:
                            return False
                        cost[u], move[u] = label, graph.in_move[e]
                        to_spread[u] = True
                        entry_vertex[used] = u
                        q = max(int((label - low) * per_s) - first, b)
                        if q < n_buckets:
                            entry_next[used], head[q] = head[q], used
                        else:
                            entry_next[used], later = later, used
                        used += 1
        # What is left of `later` is distributed from its least label on.
        first, e = np.iinfo(np.int64).max, later
        while e >= 0:
            if to_spread[entry_vertex[e]]:
                first = min(first, int((cost[entry_vertex[e]] - low) * per_s))
            e = entry_next[e]
        e, later = later, -1
        while e >= 0:
            u, following = entry_vertex[e], entry_next[e]
            if to_spread[u]:
                b = int((cost[u] - low) * per_s) - first
                if b < n_buckets:
                    entry_next[e], head[b] = head[b], e
                else:
                    entry_next[e], later = later, e
            e = following
        if first == np.iinfo(np.int64).max:
            return True
    return False


@compiled(error_model="numpy")
def _set_by_heap(graph: StoppingGraph, p_free: FloatArray, cost: FloatArray, move: NDArray[np.int8]) -> bool:
    """Do the same with a heap, for climbs so small that buckets would be too many, or too wide."""
    n = len(cost)
    for u in range(n):
        cost[u] = stop_cost(graph, p_free, u)
        move[u] = STOP
    room = 2 * (n + len(graph.in_s)) + 64
    keys, vertices, size = np.empty(room), np.empty(room, dtype=np.int32), 0
    for u in range(n):
        if _is_source(graph, cost, u):
            size = push(keys, vertices, size, cost[u], u)
    return bool(spread(graph, cost, move, keys, vertices, size) >= 0)


@compiled(error_model="numpy")
def spread(
    graph: StoppingGraph,
    cost: FloatArray,
    move: NDArray[np.int8],
    keys: FloatArray,
    vertices: NDArray[np.int32],
    size: int,
) -> int:
    """Spread the labels in a heap, and those that they improve, in ascending order.

    Args:
        graph: the stopping problem.
        cost: (n,), changed in place.
        move: (n,), changed in place.
        keys: (room,) the heap's labels.
        vertices: (room,) their vertices.
        size: how many there are.

    Returns:
        How many labels were entered; -1 where they would have been more than there is room for.
    """
    n_entered, room = 0, len(keys) - size
    while size > 0:
        v, ahead = vertices[0], keys[0]
        size = pop(keys, vertices, size)
        if ahead > cost[v]:
            continue
        for e in range(graph.in_start[v], graph.in_start[v + 1]):
            u = graph.in_source[e]
            label = graph.in_s[e] + graph.gamma * ahead
            if label < cost[u]:
                if n_entered == room:
                    return -1
                n_entered += 1
                cost[u], move[u] = label, graph.in_move[e]
                size = push(keys, vertices, size, label, u)
    return n_entered


@compiled
def edges_in(
    neighbors: NDArray[np.int32], move_s: FloatArray
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int8], FloatArray]:
    """Return the edges sorted by the vertex that they lead to: rows, sources, moves and drive times, s."""
    n, n_moves = neighbors.shape
    start = np.zeros(n + 1, dtype=np.int32)
    for u in range(n):
        for a in range(n_moves):
            if neighbors[u, a] >= 0:
                start[neighbors[u, a] + 1] += 1
    for v in range(n):
        start[v + 1] += start[v]
    m = start[n]
    source, move, seconds = np.empty(m, dtype=np.int32), np.empty(m, dtype=np.int8), np.empty(m)
    place = start[:-1].copy()
    for u in range(n):
        for a in range(n_moves):
            v = neighbors[u, a]
            if v >= 0:
                source[place[v]], move[place[v]], seconds[place[v]] = u, a, move_s[u, a]
                place[v] += 1
    return start, source, move, seconds


@compiled
def _never(neighbors: NDArray[np.int32], move_s: FloatArray, wait_s: float, gamma: float) -> FloatArray:
    """Return the lower cost, (n,) s, of waiting for ever and shuttling along one edge for ever."""
    n, n_moves = neighbors.shape
    never = np.full(n, np.inf)
    if gamma == 1.0:
        return never
    for u in range(n):
        for a in range(n_moves):
            v = neighbors[u, a]
            if v < 0:
                never[u] = min(never[u], wait_s / (1.0 - gamma))
                continue
            for b in range(n_moves):
                if neighbors[v, b] == u:
                    there_and_back = move_s[u, a] + gamma * move_s[v, b]
                    never[u] = min(never[u], there_and_back / ((1.0 - gamma) * (1.0 + gamma)))
    return never
