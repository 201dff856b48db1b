"""The thesis's MDP as a stopping problem, solved exactly by one pass of label setting.

A failed attempt leaves the car at the same slot, so repeating it until it succeeds has a closed-form value,
Q(u) = (p·(r_max - r_u) - (1-p)·c) / (1 - γ(1-p)), where r is the arrival cost and c the failure cost. What remains is
to decide where to stop: with costs J = -V,

    J(u) = min( h(u), min over edges u→v of d + γ·J(v) ),

where h(u) is the least cost of staying at u: attempts until one succeeds, waiting for ever, or shuttling for ever along
an edge and back. As in Dijkstra's algorithm, labels spread from the cheapest stops against the direction of the edges.

**Why it is exact.** An edge climbs if d + γ·J(v) > J(v), that is J(v) < d/(1-γ): driving over such edges for ever costs
more than J(v). While edges climb, labels are settled in ascending order, each once; in any digraph this holds for all
labels below d_min/(1-γ). The buckets of the queue are as wide as the shortest edge. They are exact while that is at
most the smallest climb (Denardo and Fox 1979), which γ lowers a little at positive labels. If, for either reason, a
label improves after it was spread, it is spread again. So when the pass terminates, no edge can improve any label: J
satisfies the equation above, whose solution is unique for γ < 1. Termination is the certificate.

It terminates if all edges are two-way, since h includes the cost of shuttling, so every edge climbs or ties; and if no
directed cycle is cheaper than every stop. Otherwise labels would fall for ever. A limit on the work then stops the
pass: it is repeated with a heap, whose order does not depend on climbs, and if that fails policy iteration takes over.
At γ = 1 it is Dijkstra's algorithm with a virtual source; plans that never end cost infinity.

**Repair** after some probabilities have changed, instead of planning from scratch (Ramalingam and Reps 1996): a change
can increase only the labels of the tree of vertices that were labelled from the changed stop. These get the best label
that their other neighbours offer; labels then spread only from there and from stops that improved. Most observations
affect a handful of vertices, whatever the size of the lot. If a change reaches more than a fixed part of the lot,
planning from scratch is faster and is done instead.
"""

from dataclasses import dataclass
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.heap import pop, push
from parkenv.compiled.jit import compiled
from parkenv.world.lot import PARK
from planners.thesis.mdp import ParkingMDP
from planners.thesis.policy_iteration import Solution, policy_iteration

STOP = PARK  # the move of a vertex at which to stay: to park, or because nothing is reachable
TIE_S = 1e-7  # s: actions whose values differ by less are equally good; solvers agree to well within it
_BUCKETS_PER_VERTEX = 2  # maximum number of buckets per vertex, so that skipping empty ones costs little
_NEVER = np.iinfo(np.int64).max
REACH = 0.1  # fraction of the lot's vertices that a repair may change; above it the plan is made from scratch
_LEAST_REACH = 64
_AFFECTED = STOP + 1
_REFILLS = 64  # maximum number of refills of all buckets; beyond it a heap is faster


class StoppingGraph(NamedTuple):
    """The part of the stopping problem that does not depend on the belief."""

    neighbors: NDArray[np.int32]  # (n, 4) int32, the vertex that up, down, left, right lead to, or -1
    move_s: FloatArray  # (n, 4) float64, s, drive time of each edge
    # (n + 1,) int32; the edges to v are rows in_start[v] to in_start[v + 1] of the next three arrays
    in_start: NDArray[np.int32]
    in_source: NDArray[np.int32]  # (m,) int32, source of the edge
    in_move: NDArray[np.int8]  # (m,) int8, move at the source
    in_s: FloatArray  # (m,) float64, s, drive time
    park_reward: FloatArray  # (n,) float64, s, r_max - r_u
    # (n,) float64, s, least discounted cost of waiting or shuttling along one edge for ever; inf at γ = 1
    never_s: FloatArray
    failure_s: float  # s, the planner's cost of a failed attempt
    wait_s: float  # s, cost of a move without an edge
    gamma: float  # discount per decision

    @classmethod
    def of(cls, mdp: ParkingMDP) -> Self:
        # Copies: numba would compile every function again for read-only arrays.
        neighbors, move_s = mdp.neighbors.astype(np.int32), np.array(mdp.move_s, order="C")
        start, source, move, seconds = edges_in(neighbors, move_s)
        never_s = _never(neighbors, move_s, mdp.wait_s, mdp.gamma)
        reward, failure_s = np.ascontiguousarray(mdp.park_reward), float(mdp.failure_s)
        wait_s, gamma = float(mdp.wait_s), float(mdp.gamma)
        return cls(neighbors, move_s, start, source, move, seconds, reward, never_s, failure_s, wait_s, gamma)


@dataclass
class Labels:
    """A plan: cost and action of each vertex. `repair` changes it in place."""

    cost: FloatArray  # (n,) float64, s, -V of each vertex
    move: NDArray[np.int8]  # (n,) int8, the move that gave the label, or `STOP`
    p_free: FloatArray  # (n,) float64, the probabilities of the plan
    # whether `move` leads from every vertex to a stop, along edges on which the labels are exact; False if another
    # solver made the plan
    settled: bool


def label_setting(mdp: ParkingMDP) -> Solution:
    """Solve the process exactly, in near-linear time; see the module for conditions and proof.

    Unlike policy iteration it accepts gamma 1; a vertex that cannot reach any slot then has value -inf. Ties are broken
    as in `best_move`. `iterations` is 1, or that of policy iteration if it had to take over.
    """
    graph = StoppingGraph.of(mdp)
    labels = set_labels(graph, mdp.p_free)
    iterations = 1
    if not labels.settled:
        labels, iterations = by_policy_iteration(mdp, labels)
    return Solution(-labels.cost, best_moves(graph, labels.p_free, labels.cost), iterations)


def set_labels(graph: StoppingGraph, p_free: FloatArray) -> Labels:
    """Plan by one pass of label setting; `p_free`, (n,), is not copied. If not `settled`, costs are upper bounds."""
    labels = Labels(np.empty(len(p_free)), np.empty(len(p_free), dtype=np.int8), p_free, settled=False)
    update_labels(graph, labels)
    return labels


def update_labels(graph: StoppingGraph, labels: Labels) -> None:
    width = float(graph.in_s.min()) if len(graph.in_s) else 1.0
    labels.settled = bool(
        _set_by_buckets(graph, labels.p_free, width, labels.cost, labels.move)
        or _set_by_heap(graph, labels.p_free, labels.cost, labels.move)
    )


def by_policy_iteration(mdp: ParkingMDP, start: Labels | None = None) -> tuple[Labels, int]:
    """Plan by the thesis's solver from the moves of another plan; return the plan and the iterations."""
    policy = None if start is None else start.move.astype(np.int64)
    solution = policy_iteration(mdp, policy)
    labels = Labels(-solution.values, solution.policy.astype(np.int8), mdp.p_free, settled=False)
    return labels, solution.iterations


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
    """Return an optimal action of one vertex, from the costs alone: solvers with equal costs choose equal actions.

    Of actions that are equal to within `TIE_S`, parking comes first, then the moves in order. If every cost is
    infinite, it waits if it can.
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
    moves = np.empty(len(cost), dtype=np.int64)
    for u in range(len(cost)):
        moves[u] = best_move(graph, p_free, cost, u)
    return moves


@compiled(error_model="numpy")
def _sources(graph: StoppingGraph, p_free: FloatArray, cost: FloatArray, move: NDArray[np.int8]) -> IntArray:
    """Set every label to the cost of staying; return the vertices from which labels may have to spread.

    None where one hop to a cheaper stop beats stopping. The stop one hop away must be cheaper: otherwise, at the cost
    of shuttling, rounding could make two vertices each leave the stop to the other.
    """
    n, n_sources = len(cost), 0
    sources = np.empty(n, np.int64)
    for u in range(n):
        cost[u], move[u] = stop_cost(graph, p_free, u), STOP
    for u in range(n):
        own = cost[u]
        is_source = own < np.inf
        for a in range(graph.neighbors.shape[1]):
            v = graph.neighbors[u, a]
            if v >= 0 and cost[v] < own and graph.move_s[u, a] + graph.gamma * cost[v] < own:
                is_source = False
                break
        if is_source:
            sources[n_sources] = u
            n_sources += 1
    return sources[:n_sources]


@compiled(error_model="numpy")
def _set_by_buckets(
    graph: StoppingGraph, p_free: FloatArray, width: float, cost: FloatArray, move: NDArray[np.int8]
) -> bool:
    """Fill `cost` and `move`; return whether the pass terminated within its limits.

    Bucket b holds the vertices to spread whose labels lie in [b, b + 1) times `width`; the last one those beyond, until
    all before are empty, and then refills them. Buckets are linked lists in one pool.
    """
    n, sources = len(cost), _sources(graph, p_free, cost, move)
    if len(sources) == 0:
        return True
    low, high = cost[sources].min(), cost[sources].max()
    if not width > 0.0 or (high - low) / width > 1e15:
        return False
    per_s = 1.0 / width
    last = int(min((high - low) * per_s, _BUCKETS_PER_VERTEX * n)) + 64
    head = np.full(last + 1, -1, dtype=np.int32)
    # If edges climb, a vertex is spread once: each source and each edge enters at most one label.
    pool = 2 * (n + len(graph.in_s)) + 64
    entry_vertex, entry_next, used = np.empty(pool, dtype=np.int32), np.empty(pool, dtype=np.int32), 0
    to_spread = np.zeros(n, dtype=np.bool_)
    for u in sources:
        to_spread[u] = True
        b = min(int((cost[u] - low) * per_s), last)
        entry_vertex[used], entry_next[used], head[b] = u, head[b], used
        used += 1
    first = 0
    for _ in range(_REFILLS):
        for b in range(last):
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
                        q = min(max(int((label - low) * per_s) - first, b), last)
                        entry_vertex[used], entry_next[used], head[q] = u, head[q], used
                        used += 1
        first = _refill(head, entry_vertex, entry_next, np.where(to_spread, (cost - low) * per_s, -np.inf))
        if first == _NEVER:
            return True
    return False


@compiled(error_model="numpy")
def _refill(
    head: IntArray, entry_vertex: NDArray[np.int32], entry_next: NDArray[np.int32], place: FloatArray
) -> int:
    """Distribute the last bucket, from its first place on; return that, or `_NEVER` if nothing is left.

    `place` is that of each vertex, (n,); -inf if it is not to be spread.
    """
    last = len(head) - 1
    first, e = _NEVER, head[last]
    while e >= 0:
        if place[entry_vertex[e]] > -np.inf:
            first = min(first, int(place[entry_vertex[e]]))
        e = entry_next[e]
    e, head[last] = head[last], -1
    while e >= 0:
        following = entry_next[e]
        if place[entry_vertex[e]] > -np.inf:
            b = min(int(place[entry_vertex[e]]) - first, last)
            entry_next[e], head[b] = head[b], e
        e = following
    return first


@compiled(error_model="numpy")
def _set_by_heap(graph: StoppingGraph, p_free: FloatArray, cost: FloatArray, move: NDArray[np.int8]) -> bool:
    """Do the same with a heap, for climbs so small that there would be too many buckets or too wide ones."""
    room = 2 * (len(cost) + len(graph.in_s)) + 64
    keys, vertices, size = np.empty(room), np.empty(room, dtype=np.int32), 0
    for u in _sources(graph, p_free, cost, move):
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
    """Spread the `size` labels in a heap, (room,) keys and vertices, and those that they improve, in ascending order.

    Return the number of labels entered; -1 if there was not enough room.
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


def repair(graph: StoppingGraph, labels: Labels, vertices: NDArray[np.int64], p_free: FloatArray) -> int:
    """Update a plan in place after some slots, (k,), got other probabilities, (k,), as if it were made from scratch.

    Return the number of labels set; -1 if it was planned from scratch. `labels.settled` is as after `set_labels`.
    """
    labels.p_free[vertices] = p_free
    reach = max(_LEAST_REACH, int(REACH * len(labels.cost)))
    touched = -1
    if labels.settled and len(vertices) <= reach:
        touched = _repair(graph, vertices, labels.p_free, labels.cost, labels.move, reach)
    if touched < 0:
        update_labels(graph, labels)
    return touched


@compiled(error_model="numpy")
def _repair(
    graph: StoppingGraph,
    vertices: NDArray[np.int64],
    p_free: FloatArray,
    cost: FloatArray,
    move: NDArray[np.int8],
    reach: int,
) -> int:
    """Return the number of labels set; -1, with unusable labels, if more than `reach` vertices are affected."""
    affected, n_affected = np.empty(reach, dtype=np.int32), 0
    keys, queued, size = np.empty(2 * reach), np.empty(2 * reach, dtype=np.int32), 0
    for i in range(len(vertices)):
        s = vertices[i]
        if move[s] == STOP and stop_cost(graph, p_free, s) > cost[s]:
            affected[n_affected], move[s] = s, _AFFECTED
            n_affected += 1
    tail = 0
    while tail < n_affected:
        v = affected[tail]
        tail += 1
        for e in range(graph.in_start[v], graph.in_start[v + 1]):
            u = graph.in_source[e]
            if move[u] == graph.in_move[e]:
                if n_affected == reach:
                    return -1
                affected[n_affected], move[u] = u, _AFFECTED
                n_affected += 1
    for i in range(n_affected):
        u = affected[i]
        cost[u], best = stop_cost(graph, p_free, u), STOP
        for a in range(graph.neighbors.shape[1]):
            v = graph.neighbors[u, a]
            if v >= 0 and move[v] != _AFFECTED:
                label = graph.move_s[u, a] + graph.gamma * cost[v]
                if label < cost[u]:
                    cost[u], best = label, a
        move[u] = best
        if cost[u] < np.inf:
            size = push(keys, queued, size, cost[u], u)
    n_set = n_affected
    for i in range(len(vertices)):
        s = vertices[i]
        own = stop_cost(graph, p_free, s)
        if own < cost[s]:
            cost[s], move[s] = own, STOP
            size = push(keys, queued, size, own, s)
            n_set += 1
    n_spread = spread(graph, cost, move, keys, queued, size)
    return n_set + n_spread if n_spread >= 0 else -1


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
    """Return the lower cost, (n,) s, of waiting for ever or shuttling along one edge for ever."""
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
