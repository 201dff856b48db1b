"""The part of a lot that a search can be about, with every drive in it."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.world.scenario import SearchProblem
from planners.belief.planning_graph import Ground
from planners.driving.road_table import RoadTable
from planners.thesis.heap import pop, push
from planners.thesis.label_setting import StoppingGraph, settle
from planners.thesis.mdp import ParkingMDP
from sim_sensors.compilation import compiled

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MOST_VERTICES = 2000
"""A part's table of drives grows with the square: this many vertices take 40 MB."""
_LEAST_VERTICES = 16
_KEPT = 4


@dataclass(frozen=True, eq=False)
class Neighborhood:
    """Some vertices of a lot, with numbers of their own, and all drives that stay among them.

    Attributes:
        vertices: (k,) int64, their numbers in the lot, ascending, so that slots come first here, too.
        n_slots: how many of them lie before slots.
        whole: whether it is the whole lot.
        gate: the vertex in the lot that it spreads from.
        table: the drives.
        view_starts: (k + 1,) int64, rows of `view_slots`.
        view_slots: int64, slots of the neighbourhood in view of each vertex.
        view_rates: float64, P(each of them is made out).
        own_rates: (n_slots,) float64, the same of each slot from its own vertex.
        walk_s: (n_slots,) float64, s.
    """

    vertices: IntArray
    n_slots: int
    whole: bool
    gate: int
    table: RoadTable
    view_starts: IntArray
    view_slots: IntArray
    view_rates: FloatArray
    own_rates: FloatArray
    walk_s: FloatArray

    @classmethod
    def of(cls, problem: SearchProblem, vertices: IntArray, gate: int) -> Neighborhood:
        """That of some vertices, (k,) ascending."""
        lot = problem.lot
        whole, n_slots = len(vertices) == lot.n_vertices, int(np.searchsorted(vertices, lot.n_slots))
        neighbors, (starts, slots), rates = lot.neighbors, problem.slots_in_view, problem.sensor_rates.seen
        if not whole:
            neighbors = _numbered(vertices, lot.neighbors[vertices]).astype(np.int32)
            first, last = starts[vertices], starts[vertices + 1]
            viewer = np.repeat(np.arange(len(vertices)), last - first)
            row = np.arange(len(viewer)) - np.repeat(np.cumsum(last - first) - last, last - first)
            seen = _numbered(vertices, slots[row])
            starts = np.searchsorted(viewer[seen >= 0], np.arange(len(vertices) + 1)).astype(np.int64)
            slots, rates = seen[seen >= 0], rates[row][seen >= 0]
        table, own_rates = RoadTable.over(neighbors, problem.move_s[vertices]), np.zeros(n_slots)
        own = slots == np.repeat(np.arange(len(vertices)), np.diff(starts))
        own_rates[slots[own]] = rates[own]
        walk_s = problem.walk_s[vertices[:n_slots]]
        return cls(vertices, n_slots, whole, gate, table, starts, slots, rates, own_rates, walk_s)

    @property
    def slots(self) -> IntArray:
        """The slots' numbers in the lot, (n_slots,)."""
        return self.vertices[: self.n_slots]

    def place(self, vertex: int) -> int:
        """The number here of one of the lot's vertices, or -1."""
        i = int(np.searchsorted(self.vertices, vertex))
        return i if i < len(self.vertices) and self.vertices[i] == vertex else -1

    def ground(self, problem: SearchProblem, failure_s: float) -> Ground:
        """What a path search wants to know of it."""
        return Ground(
            self.table.seconds,
            self.table.following,
            self.view_starts,
            self.view_slots,
            self.view_rates,
            self.own_rates,
            self.walk_s,
            problem.wait_s,
            problem.give_up_s,
            failure_s,
            self.whole,
        )


class Neighborhoods:
    """Finds the part of a lot that matters to a search.

    A vertex cannot do better than g = drive to it + h, where h is the least drive and walk from there if every slot
    were free. Taken in the order of g, vertices can be left out from any on: no plan that is expected to take less
    than the next one's g goes there first. The shortest ways from the start to those taken lie among them. Near the
    goal that is so from where the car is; while it is farther from the goal than a quarter of what there is room for,
    it is from where a quickest way comes as near as that, the gate.

    Args:
        problem: the lot, goal and speeds.
        most_vertices: lots of up to so many are one neighbourhood.

    Raises:
        InputError: too few vertices, or too many for a table.
    """

    def __init__(self, problem: SearchProblem, most_vertices: int = MOST_VERTICES) -> None:
        if not _LEAST_VERTICES <= most_vertices <= np.iinfo(np.int16).max:
            raise InputError(
                f"most_vertices is {most_vertices}, want {_LEAST_VERTICES} to {np.iinfo(np.int16).max}"
            )
        self._problem, self._most = problem, most_vertices
        self._kept: OrderedDict[int, Neighborhood] = OrderedDict()
        self._whole: Neighborhood | None = None
        lot = problem.lot
        if lot.n_vertices <= most_vertices:
            self._whole = Neighborhood.of(problem, np.arange(lot.n_vertices), 0)
            return
        mdp = ParkingMDP.from_belief(problem, np.zeros(lot.n_slots), failure_s=0.0, gamma=1.0)
        self._graph, self._free = StoppingGraph.of(mdp), mdp.p_free
        self._least_s = self._least(np.empty(0, dtype=np.int64))
        self._far_s = float(np.partition(self._least_s, most_vertices // 4)[most_vertices // 4])

    def toward(self, vertex: int) -> Neighborhood:
        """Where a search that begins at a vertex will take place. The last few are kept."""
        if self._whole is not None:
            return self._whole
        if vertex not in self._kept:
            self._kept[vertex] = self._spread(
                self._descend(vertex, self._least_s, self._far_s), self._least_s
            )
            if len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        return self._kept[vertex]

    def around(self, vertex: int, taken: IntArray) -> Neighborhood:
        """Where a search goes on from a vertex when some slots, (k,), were found taken.

        It spreads from there; where that reaches no other slot, from the best of them.
        """
        if self._whole is not None:
            return self._whole
        least_s = self._least(taken)
        near = self._spread(vertex, least_s)
        if np.isin(near.slots, taken).all():
            near = self._spread(self._descend(vertex, least_s, -np.inf), least_s)
        return near

    def _descend(self, vertex: int, least_s: FloatArray, enough_s: float) -> int:
        """Where a quickest way to the best slot is first within some time, or its end."""
        while enough_s < least_s[vertex] < np.inf:
            onward = self._problem.lot.neighbors[vertex]
            through = np.where(onward >= 0, self._problem.move_s[vertex] + least_s[onward], np.inf)
            if through.min() > least_s[vertex] + 1e-6:
                break
            vertex = int(onward[through.argmin()])
        return vertex

    def _least(self, taken: IntArray) -> FloatArray:
        """The h of every vertex, (n_vertices,) s up to a constant, where all slots but some are free."""
        p_free = self._free.copy()
        p_free[taken] = 0.0
        return settle(self._graph, p_free).cost

    def _spread(self, gate: int, least_s: FloatArray) -> Neighborhood:
        lot = self._problem.lot
        found = _in_order(gate, least_s, lot.neighbors, self._problem.move_s, self._most)
        return Neighborhood.of(self._problem, np.sort(found).astype(np.int64), gate)


def _numbered(vertices: IntArray, numbers: NDArray[np.integer]) -> IntArray:
    """The places of the lot's numbers among `vertices`; -1 where one is not there."""
    place = np.minimum(np.searchsorted(vertices, numbers), len(vertices) - 1)
    return np.where(vertices[place] == numbers, place, -1).astype(np.int64)


@compiled
def _in_order(
    start: int, least_s: FloatArray, neighbors: NDArray[np.int32], move_s: FloatArray, most: int
) -> NDArray[np.int32]:
    """Up to `most` vertices, by the drive to them and `least_s` from there on: A*'s order, whose bounds those are."""
    seconds = np.full(len(neighbors), np.inf)
    settled = np.zeros(len(neighbors), np.bool_)
    room = neighbors.shape[1] * most + 1
    keys, vertices = np.empty(room), np.empty(room, np.int32)
    found, n_found = np.empty(most, np.int32), 0
    seconds[start] = 0.0
    size = push(keys, vertices, 0, 0.0, start)
    while size > 0 and n_found < most:
        v = vertices[0]
        size = pop(keys, vertices, size)
        if settled[v]:
            continue
        settled[v] = True
        found[n_found] = v
        n_found += 1
        for m in range(neighbors.shape[1]):
            u = neighbors[v, m]
            if u >= 0 and seconds[v] + move_s[v, m] < seconds[u]:
                seconds[u] = seconds[v] + move_s[v, m]
                size = push(keys, vertices, size, seconds[u] + least_s[u], u)
    return found[:n_found]
