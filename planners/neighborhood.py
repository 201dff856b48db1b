"""Subgraphs of large lots: the part of the drive graph that matters for a search, with all shortest drives in it."""

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.heap import pop, push
from parkenv.compiled.jit import compiled
from parkenv.errors import require_whole
from parkenv.world.scenario import SearchProblem
from parkenv.world.sensor_model import SensorRates
from planners.belief.planning_graph import VIEW, PlanningGraph
from planners.routes import RoadTable
from planners.thesis.label_setting import StoppingGraph, set_labels
from planners.thesis.mdp import ParkingMDP

# Default maximum number of vertices of a subgraph. The table of drives grows with its square and takes 40 MB.
MOST_VERTICES = 2000
_LEAST_VERTICES = 16
_KEPT = 4


@dataclass(frozen=True, eq=False)
class Neighborhood:
    """A subgraph of a lot with its own vertex numbers, and all shortest drives within it."""

    # (k,) int64, numbers of its vertices in the lot, ascending, so slots come first here, too
    vertices: IntArray
    n_slots: int  # number of slots among them
    whole: bool  # whether it is the whole lot
    entry: int  # the vertex of the lot from which it was expanded and where the car enters it
    table: RoadTable  # shortest drives
    view_starts: IntArray  # (k + 1,) int64, rows of `views`
    views: NDArray[Any]  # `VIEW` records, slots of the subgraph in view of each vertex
    own_rate: FloatArray  # (n_slots,) float64, P(each slot is detected from its own vertex)
    cost_s: FloatArray  # (n_slots,) float64, s, arrival cost

    @classmethod
    def of(cls, problem: SearchProblem, vertices: IntArray, entry: int) -> Self:
        lot = problem.lot
        whole, n_slots = len(vertices) == lot.n_vertices, int(np.searchsorted(vertices, lot.n_slots))
        neighbors, (starts, slots), rates = lot.neighbors, problem.slots_in_view, problem.sensor_rates
        if not whole:
            neighbors = _renumber(vertices, lot.neighbors[vertices]).astype(np.int32)
            first, last = starts[vertices], starts[vertices + 1]
            viewer = np.repeat(np.arange(len(vertices)), last - first)
            row = np.arange(len(viewer)) - np.repeat(np.cumsum(last - first) - last, last - first)
            seen = _renumber(vertices, slots[row])
            starts = np.searchsorted(viewer[seen >= 0], np.arange(len(vertices) + 1)).astype(np.int64)
            slots, rates = seen[seen >= 0], SensorRates(*(rate[row][seen >= 0] for rate in rates))
        views = np.empty(len(slots), VIEW)
        views["slot"], views["rate"], views["hit"], views["false_alarm"] = slots, *rates
        # Copies: the lot's arrays are read-only, for which numba would compile every function again.
        neighbors, starts = neighbors.copy(), starts.copy()
        table, own_rate = RoadTable(neighbors, problem.move_cost_s[vertices]), np.zeros(n_slots)
        own = slots == np.repeat(np.arange(len(vertices)), np.diff(starts))
        own_rate[slots[own]] = rates.seen[own]
        cost_s = problem.finite_cost_s[vertices[:n_slots]]
        return cls(vertices, n_slots, whole, entry, table, starts, views, own_rate, cost_s)

    @property
    def slots(self) -> IntArray:
        return self.vertices[: self.n_slots]

    def index(self, vertex: int) -> int:
        """Return the number in this subgraph of a vertex of the lot, or -1."""
        i = int(np.searchsorted(self.vertices, vertex))
        return i if i < len(self.vertices) and self.vertices[i] == vertex else -1

    def in_view(self, vertex: int) -> NDArray[Any]:
        return self.views[self.view_starts[vertex] : self.view_starts[vertex + 1]]

    def planning_graph(self, problem: SearchProblem, failure_s: float) -> PlanningGraph:
        """Return the data of a path search, given the whole problem and the cost, s, of finding a slot taken."""
        return PlanningGraph(
            self.table.seconds, self.table.following, self.view_starts, self.views, self.own_rate, self.cost_s,
            problem.wait_s, problem.give_up_s, failure_s, self.whole,
        )  # fmt: skip


class Neighborhoods:
    """Finds the subgraph of a lot that matters for a search.

    A lower bound on any plan via a vertex is g = drive time to it + h, where h is the least drive time plus arrival
    cost from there if all slots were free. Vertices are added in the order of g. The rest can be left out at any point:
    no plan that is expected to take less than the next g goes there first. The subgraph contains the shortest routes
    from its start to all its vertices. Near the goal the expansion starts at the car. If the car is farther from the
    goal than a quarter of `most_vertices` reaches, the expansion starts where a shortest route first comes that near:
    the subgraph's entry.

    Args:
        problem: lot, goal and speeds.
        most_vertices: maximum size of a subgraph; lots up to this size are one neighbourhood.
    """

    def __init__(self, problem: SearchProblem, most_vertices: int = MOST_VERTICES) -> None:
        require_whole("most_vertices", most_vertices, least=_LEAST_VERTICES, most=np.iinfo(np.int16).max)
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
        """Return the subgraph for a search that begins at a vertex. The last few are cached."""
        if self._whole is not None:
            return self._whole
        if vertex not in self._kept:
            entry = self._descend(vertex, self._least_s, self._far_s)
            self._kept[vertex] = self._expand(entry, self._least_s)
            if len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        return self._kept[vertex]

    def around(self, vertex: int, taken: IntArray) -> Neighborhood:
        """Return the subgraph for going on from a vertex, or the best slot, that has others than `taken`, (k,)."""
        if self._whole is not None:
            return self._whole
        least_s = self._least(taken)
        near = self._expand(vertex, least_s)
        if np.isin(near.slots, taken).all():
            near = self._expand(self._descend(vertex, least_s, -np.inf), least_s)
        return near

    def _descend(self, vertex: int, least_s: FloatArray, enough_s: float) -> int:
        """Return the first vertex on a shortest route to the best slot that is within a given time of it."""
        while enough_s < least_s[vertex] < np.inf:
            onward = self._problem.lot.neighbors[vertex]
            through = np.where(onward >= 0, self._problem.move_cost_s[vertex] + least_s[onward], np.inf)
            if through.min() > least_s[vertex] + 1e-6:
                break
            vertex = int(onward[through.argmin()])
        return vertex

    def _least(self, taken: IntArray) -> FloatArray:
        """Return h of every vertex, (n_vertices,) s up to a constant, if all slots except `taken` are free."""
        p_free = self._free.copy()
        p_free[taken] = 0.0
        return set_labels(self._graph, p_free).cost

    def _expand(self, entry: int, least_s: FloatArray) -> Neighborhood:
        lot = self._problem.lot
        vertices = _first_by_bound(entry, least_s, lot.neighbors, self._problem.move_cost_s, self._most)
        return Neighborhood.of(self._problem, np.sort(vertices).astype(np.int64), entry)


def _renumber(vertices: IntArray, numbers: NDArray[np.integer]) -> IntArray:
    """Return the positions in `vertices` of some vertices of the lot; -1 if absent."""
    place = np.minimum(np.searchsorted(vertices, numbers), len(vertices) - 1)
    return np.where(vertices[place] == numbers, place, -1).astype(np.int64)


@compiled
def _first_by_bound(
    start: int, least_s: FloatArray, neighbors: NDArray[np.int32], move_s: FloatArray, most: int
) -> NDArray[np.int32]:
    """Return up to `most` vertices in the order of drive time plus the bound `least_s` (A* search)."""
    seconds = np.full(len(neighbors), np.inf)
    settled = np.zeros(len(neighbors), np.bool_)
    room = neighbors.shape[1] * most + 1
    keys, vertices = np.empty(room), np.empty(room, np.int32)
    nearest, n_nearest = np.empty(most, np.int32), 0
    seconds[start] = 0.0
    size = push(keys, vertices, 0, 0.0, start)
    while size > 0 and n_nearest < most:
        v = vertices[0]
        size = pop(keys, vertices, size)
        if settled[v]:
            continue
        settled[v] = True
        nearest[n_nearest] = v
        n_nearest += 1
        for m in range(neighbors.shape[1]):
            u = neighbors[v, m]
            if u >= 0 and seconds[v] + move_s[v, m] < seconds[u]:
                seconds[u] = seconds[v] + move_s[v, m]
                size = push(keys, vertices, size, seconds[u] + least_s[u], u)
    return nearest[:n_nearest]
