"""Shortest drives over the lot's graph."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from parkenv.errors import InputError
from parkenv.scenario import SearchProblem

_KEPT_TARGETS = 64


class DriveRoutes:
    """Distances from a vertex, and the way to one.

    Args:
        problem: whose lot is driven, and how fast.
    """

    def __init__(self, problem: SearchProblem) -> None:
        self._neighbors = problem.lot.neighbors
        self._seconds: Any = problem.lot.drive_matrix() / problem.v_drive
        self._backward: Any = self._seconds.T.tocsr()
        self._move_s = np.where(self._neighbors >= 0, problem.move_s, np.inf)
        self._moves: OrderedDict[int, NDArray[np.int8]] = OrderedDict()

    def seconds_from(self, vertex: int) -> NDArray[np.float64]:
        """Drive time, (n_vertices,) s, from a vertex to every other; inf where no way leads."""
        return np.asarray(dijkstra(self._seconds, indices=[vertex])[0], dtype=np.float64)

    def move_toward(self, vertex: int, target: int) -> int:
        """The first move of a shortest way.

        Raises:
            InputError: no way leads to the target, or the car is there already.
        """
        move = int(self._moves_to(target)[vertex])
        if move < 0:
            raise InputError(f"no way leads on from vertex {vertex} to vertex {target}")
        return move

    def way(self, vertex: int, target: int) -> Iterator[tuple[int, int]]:
        """A shortest way, hop by hop: the move and the vertex that it leads to; nothing where the car is there.

        Raises:
            InputError: no way leads to the target.
        """
        while vertex != target:
            move = self.move_toward(vertex, target)
            vertex = int(self._neighbors[vertex, move])
            yield move, vertex

    def _moves_to(self, target: int) -> NDArray[np.int8]:
        """(n_vertices,) the first move toward the target from everywhere, -1 where there is none."""
        if target in self._moves:
            self._moves.move_to_end(target)
            return self._moves[target]
        seconds = np.append(dijkstra(self._backward, indices=[target])[0], np.inf)
        through = self._move_s + seconds[self._neighbors]
        moves = np.where(np.isfinite(seconds[:-1]), through.argmin(axis=1), -1).astype(np.int8)
        moves[target] = -1
        self._moves[target] = moves
        if len(self._moves) > _KEPT_TARGETS:
            self._moves.popitem(last=False)
        return moves
