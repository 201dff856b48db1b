"""The occupancy grid of the thesis: where cars are seen, cell by cell (T §3.3.1)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.perception.ranging import CarSightings
from parkenv.perception.sweeps import Sweep
from sim_sensors.compilation import compiled

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]

P_FREE, P_OCCUPIED, P_PRIOR = 0.45, 0.95, 0.5
"""The observation model of eq. 3.9."""
MOST_LOG_ODDS = 12.0
"""Log-odds are kept between minus and plus this, so that the map can still change its mind."""
_NOTHING, _FREE, _OCCUPIED = 0, 1, 2


class OccupancyGrid:
    """P(a car stands here) of square cells, by the static-state binary Bayes filter (eq. 3.3-3.8) in log-odds.

    The prior of eq. 3.8 is 0.5, which is 0 in log-odds; each look adds the logit of P_FREE or P_OCCUPIED to the cells
    that it tells something of, once a look.

    Args:
        low, high: x, y in m, corners of the area, world frame.
        cell: m, side of a cell.

    Attributes:
        log_odds: (rows, columns) float32; row 0 is in the south, column 0 in the west.
        seen: (rows, columns) bool, cells that were ever in view.

    Raises:
        InputError: an area or a cell without size.

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
        self._says = np.zeros((rows, columns), dtype=np.uint8)

    @property
    def probability(self) -> Float32Array:
        """(rows, columns) float32, P(occupied); 0.5 where nothing was seen."""
        return np.asarray(1.0 / (1.0 + np.exp(-self.log_odds)), dtype=np.float32)

    def centers(self) -> FloatArray:
        """(rows, columns, 2) float64, m, world frame: the middle of each cell."""
        rows, columns = self.log_odds.shape
        x = self.low[0] + self.cell * (np.arange(columns) + 0.5)
        y = self.low[1] + self.cell * (np.arange(rows) + 0.5)
        return np.stack(np.meshgrid(x, y), axis=2)

    def update(
        self,
        camera: tuple[float, float],
        yaw: float,
        half_angle: float,
        cars: FloatArray,
        reach: float = 12.0,
        *,
        car: float = 4.4,
        half_width: float = 0.9,
    ) -> None:
        """Take in one look as the thesis does (eq. 3.9).

        The frontier of the field of view is the line of cells between its left and right margin points. Along the
        rays from the camera to each cell of it, cells are free before a car and occupied for a car's length from
        there; those behind, the "tails", are not visible and stay as they are. Without a car a ray is free to the
        frontier.

        Args:
            camera: x, y in m, world frame.
            yaw: rad, where it looks.
            half_angle: rad, of the field of view, to each side; below a quarter turn.
            cars: (n, 2) of each detected car the bearing, rad from `yaw`, counter-clockwise, and the distance, m.
            reach: m, d_max: how far ahead the frontier is.
            car: m, s_car: how far occupied cells go on behind a detection.
            half_width: m, how far to each side of its bearing a car stands in the rays' way.

        Raises:
            InputError: a number out of its range.
        """
        if not 0.0 < half_angle < math.pi / 2:
            raise InputError(f"half_angle is {half_angle} rad, want between 0 and a quarter turn")
        if not reach > 0.0:
            raise InputError(f"reach is {reach} m, want above 0")
        polar = np.asarray(cars, dtype=np.float64).reshape(-1, 2)
        x, y = self._cells(*camera)
        self._add(
            _look_as_the_thesis(
                self._says, x, y, yaw, half_angle,
                np.ascontiguousarray(polar[:, 0]), polar[:, 1] / self.cell,
                reach / self.cell, car / self.cell, half_width / self.cell,
            )
        )  # fmt: skip

    def update_from_sweep(self, sweep: Sweep, cars: CarSightings, reach: float = 12.0) -> None:
        """Take in one look with the sweep's own beams: free as far as they go, occupied where a car was fitted.

        So a car's cells lie as the car does, not as it was looked at, and walls, people and cars that were not detected
        hide what is behind them.

        Args:
            sweep: distances all around.
            cars: detected and fitted from it.
            reach: m, how far beams count.
        """
        x, y = self._cells(sweep.x, sweep.y)
        middle = (cars.xy - np.array(self.low)) / self.cell
        self._add(
            _look_along_beams(
                self._says, x, y, sweep.angle, sweep.distance / self.cell, reach / self.cell,
                middle, cars.yaw, 0.5 * cars.size / self.cell,
            )
        )  # fmt: skip

    def _cells(self, x: float, y: float) -> tuple[float, float]:
        """A place in units of cells."""
        return (x - self.low[0]) / self.cell, (y - self.low[1]) / self.cell

    def _add(self, window: tuple[int, int, int, int]) -> None:
        """Add what `_says` holds within a window of rows and columns, and wipe it."""
        free, occupied = (math.log(p / (1.0 - p)) for p in (P_FREE, P_OCCUPIED))
        _take_in(self.log_odds, self.seen, self._says, window, free, occupied, MOST_LOG_ODDS)


@compiled
def _take_in(
    log_odds: Float32Array,
    seen: NDArray[np.bool_],
    says: NDArray[np.uint8],
    window: tuple[int, int, int, int],
    free: float,
    occupied: float,
    most: float,
) -> None:
    for r in range(window[0], window[1]):
        for c in range(window[2], window[3]):
            if says[r, c] == _NOTHING:
                continue
            seen[r, c] = True
            value = log_odds[r, c] + (occupied if says[r, c] == _OCCUPIED else free)
            log_odds[r, c] = min(max(value, -most), most)
            says[r, c] = _NOTHING


@compiled
def _window(says: NDArray[np.uint8], x0: float, x1: float, y0: float, y1: float) -> tuple[int, int, int, int]:
    """First and last + 1 row, and column, of the cells that touch a rectangle."""
    rows, columns = says.shape
    return (
        min(max(math.floor(y0), 0), rows),
        min(max(math.floor(y1) + 1, 0), rows),
        min(max(math.floor(x0), 0), columns),
        min(max(math.floor(x1) + 1, 0), columns),
    )


@compiled
def _look_as_the_thesis(
    says: NDArray[np.uint8],
    x: float,
    y: float,
    yaw: float,
    half_angle: float,
    bearing: FloatArray,
    distance: FloatArray,
    reach: float,
    car: float,
    half_width: float,
) -> tuple[int, int, int, int]:
    """Mark what a look says, in units of cells; the window of rows and columns that may be marked."""
    side = reach / math.cos(half_angle)
    left_x, left_y = x + side * math.cos(yaw + half_angle), y + side * math.sin(yaw + half_angle)
    right_x, right_y = x + side * math.cos(yaw - half_angle), y + side * math.sin(yaw - half_angle)
    half_bearing = np.arctan2(half_width, distance)
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
        _ray(says, x, y, column, row, nearest, nearest + car)
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
        says,
        min(x, left_x, right_x),
        max(x, left_x, right_x),
        min(y, left_y, right_y),
        max(y, left_y, right_y),
    )
    return window


@compiled
def _look_along_beams(
    says: NDArray[np.uint8],
    x: float,
    y: float,
    angle: FloatArray,
    distance: FloatArray,
    reach: float,
    middle: FloatArray,
    yaw: FloatArray,
    half_size: FloatArray,
) -> tuple[int, int, int, int]:
    """As `_look_as_the_thesis`, for beams and fitted cars."""
    x0, x1, y0, y1 = x - reach, x + reach, y - reach, y + reach
    for b in range(len(angle)):
        if math.isnan(distance[b]):
            continue
        away = min(distance[b], reach)
        end_x, end_y = x + away * math.cos(angle[b]), y + away * math.sin(angle[b])
        _ray(says, x, y, math.floor(end_x), math.floor(end_y), away, away)
    for k in range(len(yaw)):
        c, s = math.cos(yaw[k]), math.sin(yaw[k])
        far = math.hypot(half_size[k, 0], half_size[k, 1])
        x0, x1 = min(x0, middle[k, 0] - far), max(x1, middle[k, 0] + far)
        y0, y1 = min(y0, middle[k, 1] - far), max(y1, middle[k, 1] + far)
        low_row, high_row, low_column, high_column = _window(
            says, middle[k, 0] - far, middle[k, 0] + far, middle[k, 1] - far, middle[k, 1] + far
        )
        for row in range(low_row, high_row):
            for column in range(low_column, high_column):
                dx, dy = column + 0.5 - middle[k, 0], row + 0.5 - middle[k, 1]
                if abs(c * dx + s * dy) <= half_size[k, 0] and abs(c * dy - s * dx) <= half_size[k, 1]:
                    says[row, column] = _OCCUPIED
    window: tuple[int, int, int, int] = _window(says, x0, x1, y0, y1)
    return window


@compiled
def _ray(
    says: NDArray[np.uint8],
    x: float,
    y: float,
    end_column: int,
    end_row: int,
    car_from: float,
    car_to: float,
) -> None:
    """Bresenham's line to a cell: free before `car_from`, occupied up to `car_to`, untouched behind."""
    column, row = math.floor(x), math.floor(y)
    dx, dy = abs(end_column - column), -abs(end_row - row)
    step_x = 1 if column < end_column else -1
    step_y = 1 if row < end_row else -1
    error = dx + dy
    while True:
        away = math.hypot(column + 0.5 - x, row + 0.5 - y)
        if away > car_to:
            return
        if 0 <= row < says.shape[0] and 0 <= column < says.shape[1]:
            if away > car_from:
                says[row, column] = _OCCUPIED
            elif says[row, column] == _NOTHING:
                says[row, column] = _FREE
        if column == end_column and row == end_row:
            return
        twice = 2 * error
        if twice >= dy:
            error += dy
            column += step_x
        if twice <= dx:
            error += dx
            row += step_y
