"""Connections between aisles: the shortest ways through free space, as few as make every drive reasonably short."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np
import shapely
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from parkenv.compiled.arrays import FloatArray, IntArray

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
    """Connect centre lines, (k, 2) m each, that share no point, by ways up to `longest` m."""
    stations, xy, owner = _samples(lines)
    cells = space.cells(xy)
    distance, before, source, pairs = space.spread(np.unique(cells))
    at_cell: dict[int, int] = {}
    # Ends of lines come first.
    is_end = np.r_[True, owner[1:] != owner[:-1]] | np.r_[owner[1:] != owner[:-1], True]
    for i in np.lexsort((stations, owner, ~is_end)).tolist():
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


def _road_graph(
    lines: Sequence[FloatArray], stations: FloatArray, xy: FloatArray, owner: IntArray
) -> nx.Graph:
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


LEAST_CLEARANCE = 1.4  # half the width of a one-way road, m
COMFORTABLE = 2.9  # clearance, m, from which more is worth nothing
MARGIN = 14.0  # m around the obstacles
FINE, COARSE, FINE_CELLS = 0.7, 1.0, 250_000
"""Sizes of cells, m, and the number of fine cells above which they are coarse."""


class FreeSpace:
    """A grid over the surroundings of obstacles, polygons, m, that no car drives over."""

    def __init__(self, obstacles: Sequence[shapely.Geometry]) -> None:
        whole = shapely.union_all(list(obstacles))
        x0, y0, x1, y1 = whole.bounds
        area = (x1 - x0 + 2 * MARGIN) * (y1 - y0 + 2 * MARGIN)
        self.cell = FINE if area / FINE**2 <= FINE_CELLS else max(COARSE, (area / FINE_CELLS) ** 0.5)
        self.low = np.array([x0, y0]) - MARGIN
        nx, ny = np.ceil((np.array([x1, y1]) + MARGIN - self.low) / self.cell).astype(int)
        self.shape = (int(nx), int(ny))
        self.xy = (
            self.low
            + (np.stack(np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"), -1) + 0.5) * self.cell
        )
        shapely.prepare(whole)
        covered = shapely.contains_xy(whole, self.xy[..., 0].ravel(), self.xy[..., 1].ravel()).reshape(
            self.shape
        )
        self.clearance = np.asarray(distance_transform_edt(~covered)) * self.cell - 0.5 * self.cell
        self._whole = whole
        self._boundary = shapely.STRtree(shapely.get_parts(whole))

    def cells(self, xy: FloatArray) -> IntArray:
        """Return the flat index of the cell of each point, (n, 2) m."""
        index = np.clip(((xy - self.low) / self.cell).astype(int), 0, np.array(self.shape) - 1)
        return np.asarray(np.ravel_multi_index((index[:, 0], index[:, 1]), self.shape))

    def centers(self, cells: IntArray) -> FloatArray:
        return self.xy.reshape(-1, 2)[cells]

    def spread(self, start: IntArray) -> tuple[FloatArray, IntArray, IntArray, IntArray]:
        """Drive from cells to all others at once.

        Returns the cost from the nearest start, (n_cells,) m, the predecessor and the start of each cell, and pairs of
        neighbouring cells, (m, 2), that belong to different starts.
        """
        flat = self.clearance.ravel()
        price = 1.0 + 1.5 * np.clip((COMFORTABLE - flat) / (COMFORTABLE - LEAST_CLEARANCE), 0.0, 1.0)
        passable = flat >= LEAST_CLEARANCE - 0.35 * self.cell
        passable[start] = True
        number = np.arange(flat.size).reshape(self.shape)
        tails, heads, costs = [], [], []
        for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
            a = number[: self.shape[0] - dx, max(0, -dy) : self.shape[1] - max(0, dy)].ravel()
            b = number[dx:, max(0, dy) : self.shape[1] - max(0, -dy)].ravel()
            both = passable[a] & passable[b]
            a, b = a[both], b[both]
            tails.append(a)
            heads.append(b)
            costs.append((price[a] + price[b]) / 2 * float(np.hypot(dx, dy)) * self.cell)
        tail, head, cost = map(np.concatenate, (tails, heads, costs))
        graph = coo_array((cost, (tail, head)), shape=(flat.size,) * 2).tocsr()
        distance, before, source = dijkstra(
            graph, directed=False, indices=start, min_only=True, return_predecessors=True
        )
        apart = (source[tail] != source[head]) & np.isfinite(distance[tail]) & np.isfinite(distance[head])
        pairs = np.stack([tail[apart], head[apart]], axis=1).astype(np.int64)
        return np.asarray(distance), before.astype(np.int64), source.astype(np.int64), pairs

    def is_clear(self, points: FloatArray, clearance: float) -> bool:
        line = shapely.LineString(points)
        return len(self._boundary.query(line, predicate="dwithin", distance=clearance)) == 0

    def room(self, points: FloatArray) -> float:
        return float(shapely.distance(shapely.LineString(points), self._whole))

    def pulled_straight(self, path: FloatArray) -> FloatArray:
        """Return a path with as few corners as its clearance allows, (k, 2) m."""
        wide = self.clearance.ravel()[self.cells(path)]
        kept, at = [0], 0
        while at < len(path) - 1:
            ahead = len(path) - 1
            while ahead > at + 1:
                least = float(
                    np.clip(
                        wide[at : ahead + 1].min() - 0.6 * self.cell, LEAST_CLEARANCE - 0.1, COMFORTABLE - 0.3
                    )
                )
                if self.is_clear(path[[at, ahead]], least):
                    break
                ahead -= max(1, (ahead - at) // 12)
            ahead = max(ahead, at + 1)
            kept.append(ahead)
            at = ahead
        return path[kept]
