"""All shortest drives of a lot or a part of it: times and routes between all vertices."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled
from parkenv.errors import InputError
from parkenv.world.scenario import SearchProblem

_CHEAPER = 6  # about how many rows of next vertices take as long as one of drive times


class RoadTable:
    """Shortest drives between all vertices, computed when they are first asked for, or before, a few rows at a time.

    Args:
        neighbors: (n_vertices, 4) int32, target of each move, or -1.
        move_s: (n_vertices, 4) float64, s, duration of each move.
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

    @classmethod
    def of(cls, problem: SearchProblem) -> Self:
        """Make the table of the whole lot."""
        return cls(problem.lot.neighbors, problem.move_cost_s)

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
        """Return the first move of a shortest route."""
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
