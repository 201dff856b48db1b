"""Grid distances to a point for a disc among obstacles: the search's heuristic that ignores the car's kinematics."""

from __future__ import annotations

import math

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.heap import pop, push
from parkenv.compiled.jit import compiled
from planners.driving.clearance import CELL_M, Clearance

GRID_CELLS = 2  # cells of the distance field per cell of the grid


@compiled(error_model="numpy")
def grid_distances(space: Clearance, x: float, y: float, least: float) -> FloatArray:
    """Return the shortest distances, m, of all cells to a point, for a disc of radius `least`; inf if unreachable."""
    step = CELL_M * GRID_CELLS
    rows, columns = space.field.shape[0] // GRID_CELLS, space.field.shape[1] // GRID_CELLS
    left = np.full((rows, columns), math.inf)
    keys, cells = np.empty(8 * rows * columns + 8), np.empty(8 * rows * columns + 8, np.int32)
    row, column = int((y - space.low[1]) / step), int((x - space.low[0]) / step)
    if row < 0 or column < 0 or row >= rows or column >= columns:
        return left
    left[row, column] = 0.0
    size = push(keys, cells, 0, 0.0, row * columns + column)
    while size > 0:
        key, cell = keys[0], cells[0]
        size = pop(keys, cells, size)
        row, column = cell // columns, cell % columns
        if key > left[row, column]:
            continue
        for dr in range(-1, 2):
            for dc in range(-1, 2):
                r, c = row + dr, column + dc
                if r < 0 or c < 0 or r >= rows or c >= columns or (dr == 0 and dc == 0):
                    continue
                # Allow for half a grid cell and the field's error, so that distances are not overestimated.
                if space.field[r * GRID_CELLS, c * GRID_CELLS] + 0.35 < least:
                    continue
                further = key + step * math.sqrt(float(dr * dr + dc * dc))
                if further < left[r, c] - 1e-9:
                    left[r, c] = further
                    size = push(keys, cells, size, further, r * columns + c)
    return left
