"""Connections between aisles: the shortest ways through free space, as few as make every drive reasonably short."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np
import shapely

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.lots.infer.free_space import FreeSpace

WIDE, DETOUR_WIDE, DETOUR_ENDS, DETOUR_MIDWAY = 2.2, 1.8, 2.2, 4.0
"""Clearance, m, of a wide connection, and the longest drive between the ends of a possible connection without it, as a
multiple of its length: of a wide one, of one between ends of aisles, and of any other."""
SAMPLE = 1.0  # spacing, m, of the points of an aisle from which connections may start
NEAR_END = 6.0  # distance, m, from the end of an aisle within which a connection starts at the end
SHORTEST = 0.3  # m


@dataclass(frozen=True, eq=False)
class Connection:
    """A way between two aisles."""

    points: FloatArray  # (k, 2) m
    ends: tuple[int, int]  # indices of the aisles
    clearance: float  # m, distance to the nearest obstacle


def connect(lines: Sequence[FloatArray], space: FreeSpace, longest: float) -> list[Connection]:
    """Connect centre lines, (k, 2) m each.

    Args:
        lines: aisles and roads; those that share a point are connected already.
        space: the free space around them.
        longest: length, m, of the longest connection.
    """
    stations, xy, owner = _samples(lines)
    cells = space.cells(xy)
    distance, before, source, pairs = space.spread(np.unique(cells))
    at_cell: dict[int, int] = {}
    for i in _by_importance(stations, owner):
        at_cell.setdefault(int(cells[i]), i)
    graph = _road_graph(lines, stations, xy, owner)
    length = [shapely.LineString(line).length for line in lines]

    def kind(i: int) -> int:
        line, station = int(owner[i]), stations[i]
        if station <= min(NEAR_END, length[line] / 2):
            return 0
        return 1 if station >= length[line] - NEAR_END else 2

    best: dict[tuple[int, int, int, int], tuple[float, int, int]] = {}
    one, other = source[pairs[:, 0]], source[pairs[:, 1]]
    gap = np.hypot(*(space.centers(pairs[:, 0]) - space.centers(pairs[:, 1])).T)
    cost = distance[pairs[:, 0]] + distance[pairs[:, 1]] + gap
    for c, p, q, a, b in zip(
        cost.tolist(), pairs[:, 0].tolist(), pairs[:, 1].tolist(), one.tolist(), other.tolist(), strict=True
    ):
        i, j = at_cell[a], at_cell[b]
        if owner[i] == owner[j] and abs(stations[i] - stations[j]) < 20.0:
            continue
        if owner[i] > owner[j]:
            i, j, p, q = j, i, q, p
        key = (int(owner[i]), kind(i), int(owner[j]), kind(j))
        if c < best.get(key, (np.inf,))[0]:
            best[key] = (c, p, q)

    found: list[Connection] = []
    for c, p, q in sorted(best.values()):
        i, j = (at_cell[int(source[cell])] for cell in (p, q))
        if c > longest:
            break
        try:
            known = nx.dijkstra_path_length(graph, i, j)
        except nx.NetworkXNoPath:
            known = np.inf
        if known <= DETOUR_WIDE * max(c, SHORTEST):
            continue
        path = np.concatenate([_trace(space, before, p)[::-1], _trace(space, before, q)])
        path = np.concatenate([[xy[i]], path[1:-1], [xy[j]]])
        room = float(space.clearance.ravel()[space.cells(path)].min())
        detour = DETOUR_ENDS if kind(i) < 2 and kind(j) < 2 else DETOUR_MIDWAY
        if known <= (DETOUR_WIDE if room >= WIDE else detour) * max(c, SHORTEST):
            continue
        points = space.pulled_straight(path)
        steps = np.hypot(*np.diff(points, axis=0).T)
        points = points[np.r_[True, steps > 0.05]]
        graph.add_edge(i, j, weight=c)
        if len(points) > 1:
            found.append(Connection(points, (int(owner[i]), int(owner[j])), space.room(points)))
    return found


def _samples(lines: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return points every metre along lines, ends included: stations, (n,) m, points, (n, 2) m, and lines, (n,)."""
    stations, xy, owner = [], [], []
    for k, points in enumerate(lines):
        line = shapely.LineString(points)
        count = max(2, int(np.ceil(line.length / SAMPLE)) + 1)
        at = np.linspace(0.0, line.length, count)
        stations.append(at)
        xy.append(shapely.get_coordinates(shapely.line_interpolate_point(line, at)))
        owner.append(np.full(count, k))
    return np.concatenate(stations), np.concatenate(xy), np.concatenate(owner)


def _by_importance(stations: FloatArray, owner: IntArray) -> list[int]:
    """Return the samples, ends of lines first."""
    is_end = np.r_[True, owner[1:] != owner[:-1]] | np.r_[owner[1:] != owner[:-1], True]
    return [int(i) for i in np.lexsort((stations, owner, ~is_end))]


def _road_graph(
    lines: Sequence[FloatArray], stations: FloatArray, xy: FloatArray, owner: IntArray
) -> nx.Graph:
    """Return the graph of all samples, connected along lines and where lines meet."""
    graph = nx.Graph()
    graph.add_nodes_from(range(len(xy)))
    along = owner[1:] == owner[:-1]
    for i in np.flatnonzero(along).tolist():
        graph.add_edge(i, i + 1, weight=float(stations[i + 1] - stations[i]))
    shapes = np.array([shapely.LineString(points) for points in lines])
    one, other = shapely.STRtree(shapes).query(shapes, predicate="dwithin", distance=0.05)
    first = np.searchsorted(owner, np.arange(len(lines)))
    for a, b in zip(one[one < other].tolist(), other[one < other].tolist(), strict=True):
        meeting = shapely.get_coordinates(shapely.shortest_line(shapes[a], shapes[b]))[0]
        i, j = (int(first[k] + np.argmin(np.hypot(*(xy[owner == k] - meeting).T))) for k in (a, b))
        graph.add_edge(i, j, weight=0.1)
    return graph


def _trace(space: FreeSpace, before: IntArray, cell: int) -> FloatArray:
    cells = [cell]
    while before[cells[-1]] >= 0:
        cells.append(int(before[cells[-1]]))
    return space.centers(np.array(cells))
