"""The occupancy grid of the thesis: cells that cars cover (T §3.3.1)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array, FloatArray
from parkenv.compiled.jit import compiled
from parkenv.errors import InputError, require_number
from parkenv.perception.box_fit import CAR_LENGTH, CAR_WIDTH
from parkenv.perception.slot_filter import P_FREE, P_OCCUPIED

MOST_LOG_ODDS = 12.0  # bound of the log-odds, so that later observations can still change the estimate
REACH = 12.0  # m, d_max, distance of the frontier along the optical axis
_UNOBSERVED, _FREE, _OCCUPIED = 0, 1, 2


class OccupancyGrid:
    """Occupancy probability of square cells, by the static-state binary Bayes filter (eq. 3.3-3.8) in log-odds.

    The prior of eq. 3.8 is 0.5, which is 0 in log-odds. Each image adds the logit of P_FREE or P_OCCUPIED to the cells
    that it observes, once per cell.

    Args:
        low, high: x, y in m, opposite corners of the area, world frame.
        cell: m, side of a cell.

    Attributes:
        log_odds: (rows, columns) float32; row 0 is the southernmost, column 0 the westernmost.
        seen: (rows, columns) bool, cells that were ever observed.

    Raises:
        InputError: an area or a cell size that is not positive.

    Examples:
        >>> grid = OccupancyGrid((0.0, 0.0), (15.0, 4.0), 0.5)
        >>> grid.update((0.25, 2.25), 0.0, math.radians(20.0), np.array([[0.0, 6.0]]))
        >>> [round(float(grid.probability[4, column]), 2) for column in (4, 13, 22)]
        [0.45, 0.95, 0.5]
    """

    def __init__(self, low: tuple[float, float], high: tuple[float, float], cell: float = 0.2) -> None:
        size = np.array(high, dtype=np.float64) - np.array(low, dtype=np.float64)
        if not (np.isfinite(size).all() and (size > 0.0).all() and math.isfinite(cell) and cell > 0.0):
            raise InputError(
                f"grid from {low} to {high} with cells of {cell} m, want an area and a cell size above 0"
            )
        self.low = (float(low[0]), float(low[1]))
        self.cell = float(cell)
        columns, rows = (math.ceil(s / cell) for s in size)
        self.log_odds: Float32Array = np.zeros((rows, columns), dtype=np.float32)
        self.seen = np.zeros((rows, columns), dtype=np.bool_)
        self._marks = np.zeros((rows, columns), dtype=np.uint8)

    @property
    def probability(self) -> Float32Array:
        """P(occupied), (rows, columns) float32; 0.5 where nothing was observed."""
        return np.asarray(1.0 / (1.0 + np.exp(-self.log_odds)), dtype=np.float32)

    def centers(self) -> FloatArray:
        """Return the centre of each cell, (rows, columns, 2) float64, m, world frame."""
        rows, columns = self.log_odds.shape
        x = self.low[0] + self.cell * (np.arange(columns) + 0.5)
        return np.stack(np.meshgrid(x, self.low[1] + self.cell * (np.arange(rows) + 0.5)), axis=2)

    def update(
        self,
        camera: tuple[float, float],
        yaw: float,
        half_angle: float,
        cars: FloatArray,
    ) -> None:
        """Update the grid from the cars in one image (eq. 3.9).

        The frontier of the field of view is the line of cells between its left and right end points. Along the rays
        from the camera to each frontier cell, cells are free in front of a car and occupied for a car's length from
        there; cells behind it (the "tails") are not visible and keep their value. A ray without a car is free up to
        the frontier.

        Args:
            camera: x, y in m, world frame.
            yaw: rad, direction of the optical axis, world frame.
            half_angle: rad, half the horizontal field of view; below π/2.
            cars: (n, 2) bearing, rad counter-clockwise from `yaw`, and distance, m, of each detected car.

        Raises:
            InputError: a number outside its range.
        """
        require_number("half_angle", half_angle, above=0.0, below=math.pi / 2)
        polar = np.asarray(cars, dtype=np.float64).reshape(-1, 2)
        x, y = self._cells(*camera)
        bearing, distance = np.ascontiguousarray(polar[:, 0]), polar[:, 1] / self.cell
        self._add(_mark_view(self._marks, x, y, yaw, half_angle, bearing, distance, self.cell))

    def merge(self, other: OccupancyGrid) -> None:
        """Add the evidence of another grid of the same cells."""
        self.log_odds = np.clip(self.log_odds + other.log_odds, -MOST_LOG_ODDS, MOST_LOG_ODDS)
        self.seen |= other.seen

    def _cells(self, x: float, y: float) -> tuple[float, float]:
        return (x - self.low[0]) / self.cell, (y - self.low[1]) / self.cell

    def _add(self, window: tuple[int, int, int, int]) -> None:
        free, occupied = (math.log(p / (1.0 - p)) for p in (P_FREE, P_OCCUPIED))
        _add_evidence(self.log_odds, self.seen, self._marks, window, free, occupied, MOST_LOG_ODDS)


@compiled
def _add_evidence(
    log_odds: Float32Array,
    seen: NDArray[np.bool_],
    marks: NDArray[np.uint8],
    window: tuple[int, int, int, int],
    free: float,
    occupied: float,
    most: float,
) -> None:
    for r in range(window[0], window[1]):
        for c in range(window[2], window[3]):
            if marks[r, c] == _UNOBSERVED:
                continue
            seen[r, c] = True
            value = log_odds[r, c] + (occupied if marks[r, c] == _OCCUPIED else free)
            log_odds[r, c] = min(max(value, -most), most)
            marks[r, c] = _UNOBSERVED


@compiled
def _window(
    marks: NDArray[np.uint8], x0: float, x1: float, y0: float, y1: float
) -> tuple[int, int, int, int]:
    """Return the rows and columns, as half-open ranges, of the cells that touch a rectangle."""
    rows, columns = marks.shape
    return (
        min(max(math.floor(y0), 0), rows),
        min(max(math.floor(y1) + 1, 0), rows),
        min(max(math.floor(x0), 0), columns),
        min(max(math.floor(x1) + 1, 0), columns),
    )


@compiled
def _mark_view(
    marks: NDArray[np.uint8],
    x: float,
    y: float,
    yaw: float,
    half_angle: float,
    bearing: FloatArray,
    distance: FloatArray,
    cell: float,
) -> tuple[int, int, int, int]:
    """Mark the observed cells of a size, m; lengths are in cells. Return the rows and columns that may be marked."""
    side = REACH / cell / math.cos(half_angle)
    left_x, left_y = x + side * math.cos(yaw + half_angle), y + side * math.sin(yaw + half_angle)
    right_x, right_y = x + side * math.cos(yaw - half_angle), y + side * math.sin(yaw - half_angle)
    half_bearing = np.arctan2(CAR_WIDTH / 2 / cell, distance)
    column, row = math.floor(left_x), math.floor(left_y)
    end_column, end_row = math.floor(right_x), math.floor(right_y)
    dx, dy = abs(end_column - column), -abs(end_row - row)
    step_x = 1 if column < end_column else -1
    step_y = 1 if row < end_row else -1
    error = dx + dy
    while True:
        angle = math.atan2(row + 0.5 - y, column + 0.5 - x) - yaw
        nearest = math.inf
        for k in range(len(bearing)):
            off = angle - bearing[k]
            off -= 2.0 * math.pi * math.floor(off / (2.0 * math.pi) + 0.5)
            if abs(off) <= half_bearing[k]:
                nearest = min(nearest, distance[k])
        _ray(marks, x, y, column, row, nearest, nearest + CAR_LENGTH / cell)
        if column == end_column and row == end_row:
            break
        twice = 2 * error
        if twice >= dy:
            error += dy
            column += step_x
        if twice <= dx:
            error += dx
            row += step_y
    window: tuple[int, int, int, int] = _window(
        marks,
        min(x, left_x, right_x),
        max(x, left_x, right_x),
        min(y, left_y, right_y),
        max(y, left_y, right_y),
    )
    return window


@compiled
def _ray(
    marks: NDArray[np.uint8],
    x: float,
    y: float,
    end_column: int,
    end_row: int,
    car_from: float,
    car_to: float,
) -> None:
    """Mark Bresenham's line to a cell: free up to `car_from`, occupied up to `car_to`, unchanged beyond."""
    column, row = math.floor(x), math.floor(y)
    dx, dy = abs(end_column - column), -abs(end_row - row)
    step_x = 1 if column < end_column else -1
    step_y = 1 if row < end_row else -1
    error = dx + dy
    while True:
        away = math.hypot(column + 0.5 - x, row + 0.5 - y)
        if away > car_to:
            return
        if 0 <= row < marks.shape[0] and 0 <= column < marks.shape[1]:
            if away > car_from:
                marks[row, column] = _OCCUPIED
            elif marks[row, column] == _UNOBSERVED:
                marks[row, column] = _FREE
        if column == end_column and row == end_row:
            return
        twice = 2 * error
        if twice >= dy:
            error += dy
            column += step_x
        if twice <= dx:
            error += dx
            row += step_y
