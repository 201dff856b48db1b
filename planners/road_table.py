"""All shortest drives of a lot or a part of it: times and routes between all vertices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled
from parkenv.errors import InputError
from parkenv.world.scenario import SearchProblem


@dataclass(frozen=True, eq=False)
class RoadTable:
    """Shortest drives between all vertices."""

    seconds: FloatArray  # (n_vertices, n_vertices) float64, s, from row to column; inf where unreachable
    # (n_vertices, n_vertices) int16, the next vertex on a shortest route from row to column, -1 where unreachable and
    # on the diagonal
    following: NDArray[np.int16]
    neighbors: NDArray[np.int32]  # (n_vertices, 4) int32, target of each move, or -1
    move_s: FloatArray  # (n_vertices, 4) float64, s, duration of each move

    @classmethod
    def of(cls, problem: SearchProblem) -> Self:
        """Make the table of the whole lot."""
        return cls.over(problem.lot.neighbors, problem.move_cost_s)

    @classmethod
    def over(cls, neighbors: NDArray[np.int32], move_s: FloatArray) -> Self:
        """Make the table of a graph from (n_vertices, 4) neighbours, -1 for none, and drive times, s."""
        n = len(neighbors)
        source, move = np.nonzero(neighbors >= 0)
        target, drive = neighbors[source, move], move_s[source, move]
        # The matrix would add up parallel edges: keep the fastest.
        order = np.lexsort((drive, target, source))
        source, target, drive = source[order], target[order], drive[order]
        first = np.r_[True, (np.diff(source) != 0) | (np.diff(target) != 0)][: len(source)]
        matrix: Any = csr_matrix((drive[first], (source[first], target[first])), shape=(n, n))
        seconds = np.ascontiguousarray(dijkstra(matrix), dtype=np.float64)
        following = np.empty(seconds.shape, dtype=np.int16)
        _follow(seconds, neighbors, move_s, following)
        return cls(seconds, following, neighbors, move_s)

    def move(self, vertex: int, target: int) -> int:
        """Return the first move of a shortest route.

        Raises:
            InputError: no route leads to the target, or the car is there already.
        """
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
    seconds: FloatArray, neighbors: NDArray[np.int32], move_s: FloatArray, following: NDArray[np.int16]
) -> None:
    n = len(seconds)
    for v in range(n):
        for t in range(n):
            best, chosen = np.inf, -1
            if v != t:
                for m in range(neighbors.shape[1]):
                    u = neighbors[v, m]
                    if u >= 0 and move_s[v, m] + seconds[u, t] < best:
                        best, chosen = move_s[v, m] + seconds[u, t], u
            following[v, t] = chosen
