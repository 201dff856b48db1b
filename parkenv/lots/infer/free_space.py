"""The free space between obstacles as a grid of clearances, and shortest paths through it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from parkenv.compiled.arrays import FloatArray, IntArray

LEAST_CLEARANCE = 1.4  # half the width of a one-way road, m
COMFORTABLE = 2.9  # clearance, m, from which more is worth nothing
MARGIN = 14.0  # m around the obstacles
FINE, COARSE, FINE_CELLS = 0.7, 1.0, 250_000
"""Sizes of cells, m, and the number of fine cells above which they are coarse."""


class FreeSpace:
    """A grid over the surroundings of obstacles.

    Args:
        obstacles: polygons that no car drives over, m.
    """

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
        """Return the centres, (n, 2) m, of cells."""
        return self.xy.reshape(-1, 2)[cells]

    def spread(self, start: IntArray) -> tuple[FloatArray, IntArray, IntArray, IntArray]:
        """Drive from cells to all others at once.

        Returns:
            The cost from the nearest start, (n_cells,) m, the predecessor and the start of each cell, and pairs of
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
        """Whether a polyline, (k, 2) m, keeps a distance from all obstacles."""
        line = shapely.LineString(points)
        return len(self._boundary.query(line, predicate="dwithin", distance=clearance)) == 0

    def room(self, points: FloatArray) -> float:
        """Return the distance of a polyline, (k, 2) m, to the nearest obstacle."""
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
