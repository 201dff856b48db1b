"""Obstacles in a horizontal scan plane: convex footprints and walls, sorted into a grid for fast queries."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from sim_sensors.errors import SensorError, as_floats, as_integers

NO_RETURN = -1
WALL = -2
NOWHERE = -1

LANES = 16  # obstacles per pass of vector code
QUAD, OCTAGON = 4, 8
FAR = 1e9

CELL_M = 16.0
LARGEST_IN_A_CELL_M = 8.0  # obstacles that extend further from their centre are checked in every scan
SPARE_PLACES = 32
SHORTEST_EDGE_M = 1e-6
STRAIGHT_RAD = 1e-9


class Cells(NamedTuple):
    """Obstacles for compiled code, in blocks of sixteen; a wall is a polygon of two corners.

    Places `0:cell_start[-1]` are sorted by cell, row after row, so neighbouring cells of a row are consecutive places.
    The places after them hold obstacles that are too large for a cell or have left their cell, and spare places. Unused
    places lie `FAR` away.
    """

    # (n_places / LANES · k · 2 · LANES,) m, counter-clockwise, relative to the centre: for each block of LANES places
    # the x and the y of corner 0, of corner 1, ... A polygon with fewer than k corners repeats its last one.
    corners: NDArray[np.float32]
    x: FloatArray  # (n_places,) m, world frame: the centre. Only offsets are float32, so a lot may lie anywhere.
    y: FloatArray
    radius: NDArray[np.float32]  # (n_places,) m, of a circle around the obstacle
    label: NDArray[np.int32]  # (n_places,) the footprint's id, or `WALL`
    cell_start: IntArray  # (n_rows · n_columns + 1,)
    frame: FloatArray  # (6,) x and y of the first cell's corner and the cell size (m), rows, columns, places in use
    k: int  # corners per obstacle


class CellTable:
    """Convex polygons of at most k corners, sorted into cells; polygons can be replaced individually.

    Those with no corners or with more than k are omitted.
    """

    def __init__(self, k: int, corners: FloatArray, n_corners: IntArray, labels: IntArray) -> None:
        stands = np.flatnonzero((n_corners > 0) & (n_corners <= k))
        circle = _enclosing_circles(corners[stands], n_corners[stands])
        fits = circle[:, 2] <= LARGEST_IN_A_CELL_M
        frame = _frame(circle[fits])
        n_cells = int(frame[3] * frame[4])
        cell = np.full(len(stands), n_cells)
        cell[fits] = _cell_of(circle[fits], frame)
        order = np.argsort(cell, kind="stable")
        self._used = len(order)
        self._place = np.full(len(n_corners), NOWHERE)
        self._place[stands[order]] = np.arange(self._used)
        spare = SPARE_PLACES + int(np.sqrt(self._used))
        n_blocks = -(-(self._used + spare) // LANES) if self._used else 0
        self.cells = Cells(
            np.zeros(n_blocks * k * 2 * LANES, np.float32),
            np.full(n_blocks * LANES, FAR),
            np.full(n_blocks * LANES, FAR),
            np.zeros(n_blocks * LANES, np.float32),
            np.full(n_blocks * LANES, NO_RETURN, np.int32),
            np.searchsorted(cell[order], np.arange(n_cells + 1)),
            np.append(frame, self._used),
            k,
        )
        chosen = stands[order]
        self._write(np.arange(self._used), circle[order], corners[chosen], n_corners[chosen], labels[chosen])

    def copy(self) -> CellTable:
        twin = object.__new__(CellTable)
        twin._used, twin._place = self._used, self._place.copy()
        changeable = ("corners", "x", "y", "radius", "label", "frame")
        twin.cells = self.cells._replace(**{name: getattr(self.cells, name).copy() for name in changeable})
        return twin

    def remove(self, index: int) -> None:
        place = self._place[index]
        if place != NOWHERE:
            self.cells.x[place] = self.cells.y[place] = FAR

    def put(self, index: int, corners: FloatArray, label: int) -> bool:
        """Replace polygon `index`; return False, without a change, if no place is free and a new sort is due."""
        count = np.array([len(corners)])
        circle = _enclosing_circles(corners[None], count)
        place, start = int(self._place[index]), self.cells.cell_start
        if place == NOWHERE or not (place >= start[-1] or self._in_cell_of(place, circle)):
            if self._used == len(self.cells.x):
                return False
            self.remove(index)
            place = self._place[index] = self._used
            self._used += 1
            self.cells.frame[5] = self._used
        self._write(np.array([place]), circle, corners[None], count, np.array([label]))
        return True

    def _in_cell_of(self, place: int, circle: FloatArray) -> bool:
        cell, start = int(_cell_of(circle, self.cells.frame)[0]), self.cells.cell_start
        return (
            cell >= 0 and circle[0, 2] <= LARGEST_IN_A_CELL_M and bool(start[cell] <= place < start[cell + 1])
        )

    def _write(
        self, place: IntArray, circle: FloatArray, corners: FloatArray, n_corners: IntArray, label: IntArray
    ) -> None:
        cells = self.cells
        cells.x[place], cells.y[place], cells.radius[place] = circle[:, 0], circle[:, 1], circle[:, 2]
        cells.label[place] = label
        last = np.minimum(np.arange(cells.k), n_corners[:, None] - 1)
        local = np.take_along_axis(corners, last[..., None], 1) - circle[:, None, :2]
        cells.corners.reshape(-1, cells.k, 2, LANES)[place // LANES, :, :, place % LANES] = local


class ScanPlane:
    """The obstacles in a horizontal laser plane (0.5 m above the ground): footprints and walls.

    Footprints are convex polygons (a post is a polygon of eight or more corners); walls are line segments without
    thickness, visible from both sides. They may overlap. Construction sorts all of them; afterwards a change affects
    only one footprint, and a scan visits only the cells within its range.

    Args:
        footprints: (n, k_max, 2) float, m, world frame: corners in order, in either orientation. They are stored
            counter-clockwise, without corners on a straight edge.
        n_corners: (n,) int, number of corners used: 3 to k_max, or 0 for an empty place that `replace` may fill later.
            None: all.
        walls: (m, 2, 2) float, m, world frame: the two ends of each.
        ids: (n,) int, 0 or more, the id that a scan reports for a hit; several footprints may share one. None: 0 to
            n-1.

    Examples:
        >>> plane = ScanPlane([[[1, -1], [2, -1], [2, 1], [1, 1]]], walls=[[[5, -9], [5, 9]]])
        >>> plane.n_footprints, plane.n_walls
        (1, 1)
    """

    def __init__(
        self,
        footprints: ArrayLike,
        n_corners: ArrayLike | None = None,
        walls: ArrayLike | None = None,
        ids: ArrayLike | None = None,
    ) -> None:
        corners = as_floats("footprints", footprints, None, None, 2)
        n, k_max = corners.shape[:2]
        count = np.full(n, k_max) if n_corners is None else as_integers("n_corners", n_corners, n)
        wall = as_floats("walls", () if walls is None else walls, None, 2, 2)
        self.ids = np.arange(n) if ids is None else as_integers("ids", ids, n, least=0)
        length = np.hypot(*(wall[:, 1] - wall[:, 0]).T)
        if (length < SHORTEST_EDGE_M).any():
            i = int(np.argmax(length < SHORTEST_EDGE_M))
            raise SensorError(f"walls[{i}] is {wall[i].tolist()}, want two ends apart")
        self.n_footprints, self.n_walls, self.k_max = n, len(wall), max(k_max, QUAD)
        self.walls = wall  # (m, 2, 2) float64, m, world frame; read-only
        self._corners = np.zeros((n, self.k_max, 2))
        self._corners[:, :k_max], self._n_corners = _normalised("footprints", corners, count)
        self._sort()

    @property
    def cells(self) -> tuple[Cells, Cells]:
        """The obstacles for compiled code: those with up to four corners, and the others. Read-only."""
        return self._quads.cells, self._others.cells

    @property
    def footprints(self) -> tuple[FloatArray, IntArray]:
        """Corners, (n, k_max, 2) float64, m, world frame, counter-clockwise, zero-padded; (n,) int64 counts."""
        return self._corners.copy(), self._n_corners.copy()

    def replace(self, index: int, corners: ArrayLike | None) -> None:
        """Replace or clear a footprint; its id stays.

        This takes microseconds, except that all footprints are sorted again after a few dozen moves between cells.

        Args:
            index: index of the footprint, 0 to n_footprints - 1.
            corners: (k, 2) float, m, world frame, 3 to k_max corners in either orientation; None to clear it.
        """
        if not 0 <= index < self.n_footprints:
            raise SensorError(f"index is {index}, want 0 to {self.n_footprints - 1}")
        new = as_floats("corners", () if corners is None else corners, None, 2)
        if len(new) > self.k_max:
            raise SensorError(f"corners has {len(new)} rows, want at most {self.k_max}")
        shape, count = _normalised("corners", new[None], np.array([len(new)]))
        self._corners[index] = 0.0
        self._corners[index, : len(new)], self._n_corners[index] = shape[0], count[0]
        table, other = (self._quads, self._others) if count[0] <= QUAD else (self._others, self._quads)
        other.remove(index)
        if count[0] == 0:
            table.remove(index)
        elif not table.put(index, shape[0, : count[0]], int(self.ids[index])):
            self._sort()

    def with_footprint(self, index: int, corners: ArrayLike | None) -> ScanPlane:
        twin = object.__new__(ScanPlane)
        twin.__dict__.update(self.__dict__)
        twin._corners, twin._n_corners = self._corners.copy(), self._n_corners.copy()
        twin._quads, twin._others = self._quads.copy(), self._others.copy()
        twin.replace(index, corners)
        return twin

    def _sort(self) -> None:
        pieces = _short_pieces(self.walls)
        corners = np.zeros((self.n_footprints + len(pieces), self.k_max, 2))
        corners[: self.n_footprints], corners[self.n_footprints :, :2] = self._corners, pieces
        n_corners = np.concatenate([self._n_corners, np.full(len(pieces), 2)])
        labels = np.concatenate([self.ids, np.full(len(pieces), WALL)])
        self._quads = CellTable(QUAD, corners, n_corners, labels)
        larger = np.where(n_corners > QUAD, n_corners, 0)
        self._others = CellTable(max(OCTAGON, self.k_max), corners, larger, labels)


def _short_pieces(walls: FloatArray) -> FloatArray:
    start, along = walls[:, 0], walls[:, 1] - walls[:, 0]
    n = np.ceil(np.hypot(along[:, 0], along[:, 1]) / (2 * LARGEST_IN_A_CELL_M)).astype(np.int64)
    wall = np.repeat(np.arange(len(walls)), n)
    number = np.arange(len(wall)) - np.repeat(np.cumsum(n) - n, n)
    ends = (number[:, None] + [0, 1]) / n[wall, None]
    return np.asarray(start[wall, None] + ends[..., None] * along[wall, None])


def _frame(circle: FloatArray) -> FloatArray:
    low, high = (circle[:, :2].min(0), circle[:, :2].max(0)) if len(circle) else (np.zeros(2), np.zeros(2))
    extent = high - low
    # If few obstacles cover a large area, larger cells keep the number of cells in proportion to them.
    size = max(CELL_M, float(np.sqrt(np.prod(extent) / (64 + 4 * len(circle)))), float(extent.max()) / 4096)
    columns, rows = np.floor(extent / size) + 1
    return np.array([*low, size, rows, columns])


def _cell_of(circle: FloatArray, frame: FloatArray) -> IntArray:
    x, y, size, rows, columns = frame[:5]
    column, row = np.floor((circle[:, 0] - x) / size), np.floor((circle[:, 1] - y) / size)
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    return np.where(inside, row * columns + column, -1).astype(np.int64)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _enclosing_circles(corners: FloatArray, n_corners: IntArray) -> FloatArray:
    used = np.arange(corners.shape[1]) < n_corners[:, None]
    centre = (corners * used[..., None]).sum(1) / n_corners[:, None]
    reach = np.hypot(*np.moveaxis(corners - centre[:, None], -1, 0))
    return np.column_stack([centre, np.where(used, reach, 0.0).max(1, initial=0.0)])


def _normalised(name: str, corners: FloatArray, n_corners: IntArray) -> tuple[FloatArray, IntArray]:
    """Return footprints, (n, k_max, 2), counter-clockwise, without collinear corners, and their numbers of corners."""
    k_max = corners.shape[1]
    wrong = (n_corners < 3) & (n_corners != 0) | (n_corners > k_max)
    if wrong.any():
        i = int(np.argmax(wrong))
        raise SensorError(f"n_corners[{i}] is {n_corners[i]}, want 3 to {k_max}, or 0 for none")
    kept, count = np.zeros_like(corners), n_corners.copy()
    for k in np.unique(n_corners[n_corners > 0]):
        group = np.flatnonzero(n_corners == k)
        outline = corners[group, :k]
        relative = outline - outline[:, :1]
        clockwise = _cross(relative, np.roll(relative, -1, 1)).sum(1) < 0
        outline[clockwise] = outline[clockwise, ::-1]
        edge = np.roll(outline, -1, 1) - outline
        before = np.roll(edge, 1, 1)
        short = np.hypot(edge[..., 0], edge[..., 1]) < SHORTEST_EDGE_M
        _refuse(name, "corners that lie apart", group, outline, short)
        turn = np.arctan2(_cross(before, edge), (before * edge).sum(-1))
        # A convex outline turns left at every corner, by one full turn in total; an outline without area turns back.
        flat = np.abs(np.abs(turn) - np.pi) < STRAIGHT_RAD
        _refuse(name, "an area above zero", group, outline, flat)
        crossed = np.abs(turn.sum(1, keepdims=True) - 2 * np.pi) > 1e-3
        _refuse(name, "a convex outline", group, outline, (turn < -STRAIGHT_RAD) | crossed)
        corner = turn > STRAIGHT_RAD
        count[group] = corner.sum(1)
        first = np.argsort(~corner, axis=1, kind="stable")
        kept[group, :k] = np.take_along_axis(outline, first[..., None], 1)
    kept[np.arange(k_max) >= count[:, None]] = 0.0
    return kept, count


def _refuse(name: str, wanted: str, group: IntArray, outline: FloatArray, wrong: NDArray[np.bool_]) -> None:
    if wrong.any():
        i = int(np.argmax(wrong.any(1)))
        raise SensorError(f"{name}[{group[i]}] is {outline[i].round(4).tolist()}, want {wanted}")
