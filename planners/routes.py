"""Shortest drives: searched only as far as needed, and a table of all in a lot or a part of it."""

from collections import OrderedDict
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.heap import pop, push
from parkenv.compiled.jit import compiled
from parkenv.errors import InputError
from parkenv.world.lot import MOVES
from parkenv.world.scenario import SearchProblem
from planners.thesis.label_setting import edges_in

_KEPT_TARGETS = 64
_CHEAPER = 6  # about how many rows of next vertices take as long as one of drive times
_NONE = -1
_NOWHERE = np.zeros(0, dtype=np.bool_)


class DriveRoutes:
    def __init__(self, problem: SearchProblem) -> None:
        # Copies: numba would compile every function again for read-only arrays.
        self._neighbors, self._move_s = problem.lot.neighbors.copy(), problem.move_cost_s.copy()
        # Edges as `_search` takes them, outward and inward.
        start = np.arange(0, self._neighbors.size + 1, len(MOVES), dtype=np.int32)
        self._edges_out = start, self._neighbors.flatten(), self._move_s.flatten()
        start, source, _, seconds = edges_in(self._neighbors, self._move_s)
        self._edges_in = start, source, seconds
        self._moves: OrderedDict[int, dict[int, int]] = OrderedDict()

    def seconds_from(self, vertex: int, walls: NDArray[np.bool_] = _NOWHERE) -> FloatArray:
        """Return the drive time, (n_vertices,) s, from a vertex to every other; inf where unreachable.

        No drive leads through `walls`, (n_vertices,) bool, or none.
        """
        seconds = np.full(len(self._neighbors), np.inf)
        _search(*self._edges_out, vertex, _NOWHERE, walls, seconds)
        return seconds

    def nearest(self, vertex: int, slots: NDArray[np.bool_]) -> tuple[NDArray[np.int64], float]:
        """Return the nearest of `slots`, (n_slots,) bool, from a vertex, and their drive time, s.

        They are (k,) int64, ascending; none and inf if none is reachable.
        """
        seconds = np.full(len(self._neighbors), np.inf)
        reached = _search(*self._edges_out, vertex, slots, _NOWHERE, seconds)
        if reached == _NONE:
            return np.empty(0, dtype=np.int64), np.inf
        least = float(seconds[reached])
        return np.flatnonzero(slots & (seconds[: len(slots)] == least)), least

    def move_toward(self, vertex: int, target: int) -> int:
        moves = self._moves.setdefault(target, {})
        self._moves.move_to_end(target)
        if len(self._moves) > _KEPT_TARGETS:
            self._moves.popitem(last=False)
        if vertex not in moves:
            moves |= self._moves_along(vertex, target)
        if vertex not in moves:
            raise InputError(f"no route leads from vertex {vertex} to vertex {target}")
        return moves[vertex]

    def path(self, vertex: int, target: int) -> tuple[int, ...]:
        """Return the vertices of a shortest route without the first; empty without a target (-1) or a route."""
        if target < 0 or not np.isfinite(self.seconds_from(vertex)[target]):
            return ()
        return tuple(v for _, v in self.hops(vertex, target))

    def hops(self, vertex: int, target: int) -> Iterator[tuple[int, int]]:
        """Yield the moves of a shortest route and the vertices that they lead to; nothing at the target."""
        while vertex != target:
            move = self.move_toward(vertex, target)
            vertex = int(self._neighbors[vertex, move])
            yield move, vertex

    def _moves_along(self, vertex: int, target: int) -> dict[int, int]:
        """Return the moves of a shortest route, keyed by the vertex at which each is made; empty without a route."""
        seconds = np.full(len(self._neighbors), np.inf)
        end = np.zeros(vertex + 1, dtype=np.bool_)
        end[vertex] = True
        moves: dict[int, int] = {}
        if _search(*self._edges_in, target, end, _NOWHERE, seconds) == _NONE:
            return moves
        while vertex != target:
            following = self._neighbors[vertex]
            through = np.where(following >= 0, self._move_s[vertex] + seconds[following], np.inf)
            moves[vertex] = int(through.argmin())
            vertex = int(following[moves[vertex]])
        return moves


@compiled(error_model="numpy")
def _search(
    start: NDArray[np.int32],
    leads_to: NDArray[np.int32],
    edge_s: FloatArray,
    origin: int,
    ends: NDArray[np.bool_],
    walls: NDArray[np.bool_],
    seconds: FloatArray,
) -> int:
    """Run Dijkstra's algorithm until the first of `ends`, (k,) bool of the first k vertices, is settled.

    The edges of v are rows `start[v]` to `start[v + 1]` of `leads_to`, the vertex at the other end or -1, and `edge_s`.
    Those of `walls`, (n,) bool, or none, lead nowhere. `seconds`, (n,), all inf at first, become drive times, exact up
    to the vertex where the search stopped, upper bounds beyond. Return one of the nearest of `ends`, or -1.
    """
    keys, vertices = np.empty(len(leads_to) + 1), np.empty(len(leads_to) + 1, dtype=np.int32)
    seconds[origin] = 0.0
    size = push(keys, vertices, 0, 0.0, origin)
    while size > 0:
        v, far = vertices[0], keys[0]
        size = pop(keys, vertices, size)
        if far > seconds[v]:
            continue
        if v < len(ends) and ends[v]:
            return int(v)
        if v < len(walls) and walls[v]:
            continue
        for e in range(start[v], start[v + 1]):
            u = np.int64(leads_to[e])
            if u >= 0 and far + edge_s[e] < seconds[u]:
                seconds[u] = far + edge_s[e]
                size = push(keys, vertices, size, seconds[u], u)
    return _NONE


class RoadTable:
    """Shortest drives between all vertices, computed when they are first asked for, or before, a few rows at a time.

    `neighbors`, (n_vertices, 4) int32, is the target of each move, or -1; `move_s` its duration, s.
    """

    def __init__(self, neighbors: NDArray[np.int32], move_s: FloatArray) -> None:
        self.neighbors, self.move_s, n = neighbors, move_s, len(neighbors)
        source, move = np.nonzero(neighbors >= 0)
        target, drive = neighbors[source, move], move_s[source, move]
        # The matrix would add up parallel edges: keep the fastest.
        order = np.lexsort((drive, target, source))
        source, target, drive = source[order], target[order], drive[order]
        first = np.r_[True, (np.diff(source) != 0) | (np.diff(target) != 0)][: len(source)]
        self._matrix: Any = csr_matrix((drive[first], (source[first], target[first])), shape=(n, n))
        self._seconds, self._following = np.empty((n, n)), np.empty((n, n), np.int16)
        self._ready = 0, 0  # rows of seconds, and, after all of them, of following

    @property
    def seconds(self) -> FloatArray:
        """Drive times, (n_vertices, n_vertices) float64, s, from row to column; inf where unreachable."""
        self.prepare()
        return self._seconds

    @property
    def following(self) -> NDArray[np.int16]:
        """The next vertex on a shortest route from row to column, -1 where unreachable and on the diagonal."""
        self.prepare()
        return self._following

    def prepare(self, rows: int | None = None) -> None:
        """Compute the rest of the table, or some more rows of it, to spread the time over several decisions."""
        n, (timed, followed) = len(self._seconds), self._ready
        if timed < n:
            of = np.arange(timed, n if rows is None else min(timed + rows, n))
            self._seconds[of] = dijkstra(self._matrix, indices=of)
            self._ready = timed + len(of), 0
        if self._ready[0] == n > followed and (rows is None or timed == n):
            end = n if rows is None else min(followed + _CHEAPER * rows, n)
            _follow(self._seconds, self.neighbors, self.move_s, self._following, followed, end)
            self._ready = n, end

    def move(self, vertex: int, target: int) -> int:
        following = int(self.following[vertex, target])
        if following < 0:
            raise InputError(f"no route leads from vertex {vertex} to vertex {target}")
        return self.move_to(vertex, following)

    def move_to(self, vertex: int, neighbor: int) -> int:
        """Return the fastest move that leads to a neighbouring vertex."""
        leads = self.neighbors[vertex] == neighbor
        return int(np.where(leads, self.move_s[vertex], np.inf).argmin())


@compiled
def _follow(
    seconds: FloatArray,
    neighbors: NDArray[np.int32],
    move_s: FloatArray,
    following: NDArray[np.int16],
    begin: int,
    end: int,
) -> None:
    n = len(seconds)
    for v in range(begin, end):
        for t in range(n):
            best, chosen = np.inf, -1
            if v != t:
                for m in range(neighbors.shape[1]):
                    u = neighbors[v, m]
                    if u >= 0 and move_s[v, m] + seconds[u, t] < best:
                        best, chosen = move_s[v, m] + seconds[u, t], u
            following[v, t] = chosen
