"""Collision checks of the car's rectangular footprint against the exact outlines of obstacles."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.driving.vehicle import VehicleParameters, move_along

CELL_M = 0.1  # cell of the distance field, m
_BEYOND_M = 3.0  # distance, m, by which a car may reach beyond the window
CHECK_M, FINE_M = 0.15, 0.015  # maximum distance, m, between checked poses, and that without any clearance
ROOMY_M = 0.045  # clearance, m, from which on the first one is enough
DISCS = 4  # number of discs in a row that cover the footprint

_SAMPLE_M = 0.5 * CELL_M
# Error of a distance in the field: half a cell's diagonal at either end and half a sample.
_UNSURE = math.sqrt(2.0) * CELL_M + 0.5 * _SAMPLE_M


class Clearance(NamedTuple):
    # (n, k_max, 2) float64, m: convex outlines in either orientation; lines have two corners
    corners: FloatArray
    n_corners: IntArray  # (n,) int64
    circle: FloatArray  # (n, 3) float64, m: centre x, y and radius of a circle around each outline
    # (rows, columns) float32, m: approximate distance of each cell to the nearest outline
    field: NDArray[np.float32]
    low: FloatArray  # (2,) float64, m: lower corner of the field's first cell
    half: FloatArray  # (2,) float64, m: half the car's length and width
    middle: float  # m, distance from the rear axle to the footprint's middle


def clearance(
    vehicle: VehicleParameters, outlines: FloatArray, n_corners: IntArray, low: FloatArray, high: FloatArray
) -> Clearance:
    """Prepare collision checks of a car among convex outlines, (n, k_max, 2) m, the first `n_corners`, (n,), of each.

    `low` and `high`, (2,) m, are the corners of the window; poses outside count as collisions.
    """
    used = np.arange(outlines.shape[1]) < n_corners[:, None]
    center = (outlines * used[..., None]).sum(axis=1) / n_corners[:, None]
    away = np.hypot(*np.moveaxis(outlines - center[:, None], -1, 0))
    circle = np.column_stack([center, np.where(used, away, 0.0).max(axis=1, initial=0.0)])
    near = (circle[:, :2] + circle[:, 2:] > low - _BEYOND_M).all(axis=1) & (
        circle[:, :2] - circle[:, 2:] < high + _BEYOND_M
    ).all(axis=1)
    outlines, n_corners, circle = outlines[near], n_corners[near], circle[near]
    columns, rows = np.ceil((high - low) / CELL_M).astype(int).tolist()
    taken = np.zeros((rows, columns), dtype=np.bool_)
    _draw(outlines, n_corners, low, taken)
    field = distance_transform_edt(~taken) * CELL_M if taken.any() else np.full(taken.shape, 1e3)
    return Clearance(
        np.ascontiguousarray(outlines, dtype=np.float64),
        np.ascontiguousarray(n_corners, dtype=np.int64),
        circle,
        field.astype(np.float32),
        np.asarray(low, dtype=np.float64),
        np.array([0.5 * vehicle.length, 0.5 * vehicle.width]),
        vehicle.middle,
    )


@compiled(error_model="numpy")
def _draw(outlines: FloatArray, n_corners: IntArray, low: FloatArray, taken: NDArray[np.bool_]) -> None:
    """Mark the cells on the outlines and inside them."""
    rows, columns = taken.shape
    for i in range(len(outlines)):
        k = n_corners[i]
        for j in range(k if k > 2 else 1):
            x0, y0 = outlines[i, j, 0], outlines[i, j, 1]
            x1, y1 = outlines[i, (j + 1) % k, 0], outlines[i, (j + 1) % k, 1]
            n = math.ceil(math.hypot(x1 - x0, y1 - y0) / _SAMPLE_M) + 1
            for m in range(n + 1):
                column = math.floor((x0 + (x1 - x0) * m / n - low[0]) / CELL_M)
                row = math.floor((y0 + (y1 - y0) * m / n - low[1]) / CELL_M)
                if 0 <= row < rows and 0 <= column < columns:
                    taken[row, column] = True
        if k < 3:
            continue
        # The outline is convex, so all cells between the leftmost and the rightmost marked one of a row belong to it.
        bottom, top = outlines[i, :k, 1].min(), outlines[i, :k, 1].max()
        left, right = outlines[i, :k, 0].min(), outlines[i, :k, 0].max()
        first = max(math.floor((bottom - low[1]) / CELL_M), 0)
        last = min(math.floor((top - low[1]) / CELL_M), rows - 1)
        begin = max(math.floor((left - low[0]) / CELL_M), 0)
        end = min(math.floor((right - low[0]) / CELL_M), columns - 1)
        for row in range(first, last + 1):
            y = low[1] + (row + 0.5) * CELL_M
            for column in range(begin, end + 1):
                x = low[0] + (column + 0.5) * CELL_M
                sign, inside = 0.0, True
                for j in range(k):
                    ax, ay = outlines[i, j, 0], outlines[i, j, 1]
                    bx, by = outlines[i, (j + 1) % k, 0], outlines[i, (j + 1) % k, 1]
                    cross = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
                    if cross * sign < 0.0:
                        inside = False
                        break
                    if cross != 0.0:
                        sign = cross
                if inside:
                    taken[row, column] = True


@compiled(error_model="numpy")
def is_collision_free(space: Clearance, x: float, y: float, yaw: float, margin: float) -> bool:
    """Return whether the car, grown by `margin` m on all sides, is free of obstacles with its rear axle at a pose."""
    rows, columns = space.field.shape
    half_length, half_width = space.half[0] + margin, space.half[1] + margin
    cosine, sine = math.cos(yaw), math.sin(yaw)
    pitch = 2.0 * half_length / DISCS
    radius = math.hypot(0.5 * pitch, half_width)
    clear = True
    for i in range(DISCS):
        ahead = space.middle - half_length + (i + 0.5) * pitch
        column = math.floor((x + ahead * cosine - space.low[0]) / CELL_M)
        row = math.floor((y + ahead * sine - space.low[1]) / CELL_M)
        if row < 0 or column < 0 or row >= rows or column >= columns:
            return False
        away = space.field[row, column]
        # What lies beyond the field is not in it.
        edge = CELL_M * min(row, column, rows - 1 - row, columns - 1 - column)
        # The discs at either end reach beyond the footprint before they reach its sides.
        if away + _UNSURE < (half_width if 0 < i < DISCS - 1 else min(half_width, 0.5 * pitch)):
            return False
        if min(away, edge) - _UNSURE < radius:
            clear = False
    if clear:
        return True
    mx, my = x + space.middle * cosine, y + space.middle * sine
    reach = math.hypot(half_length, half_width)
    for i in range(len(space.circle)):
        dx, dy = space.circle[i, 0] - mx, space.circle[i, 1] - my
        far = reach + space.circle[i, 2]
        if dx * dx + dy * dy < far * far:
            k = space.n_corners[i]
            if _overlap(space.corners, i, k, mx, my, cosine, sine, half_length, half_width):
                return False
    return True


@compiled(error_model="numpy")
def _overlap(
    corners: FloatArray,
    i: int,
    k: int,
    mx: float,
    my: float,
    cosine: float,
    sine: float,
    half_length: float,
    half_width: float,
) -> bool:
    """Return whether a rectangle and convex outline i overlap (separating axis test)."""
    low_x = low_y = math.inf
    high_x = high_y = -math.inf
    for j in range(k):
        dx, dy = corners[i, j, 0] - mx, corners[i, j, 1] - my
        u, v = cosine * dx + sine * dy, cosine * dy - sine * dx
        low_x, high_x = min(low_x, u), max(high_x, u)
        low_y, high_y = min(low_y, v), max(high_y, v)
    if low_x > half_length or high_x < -half_length or low_y > half_width or high_y < -half_width:
        return False
    for j in range(k if k > 2 else 1):
        ax, ay = corners[i, j, 0], corners[i, j, 1]
        bx, by = corners[i, (j + 1) % k, 0], corners[i, (j + 1) % k, 1]
        nx, ny = by - ay, ax - bx
        # Half the length of the rectangle's projection onto the normal.
        shadow = half_length * abs(nx * cosine + ny * sine) + half_width * abs(ny * cosine - nx * sine)
        at = nx * (mx - ax) + ny * (my - ay)
        low = high = 0.0
        for m in range(k):
            d = nx * (corners[i, m, 0] - ax) + ny * (corners[i, m, 1] - ay)
            low, high = min(low, d), max(high, d)
        if at - shadow > high or at + shadow < low:
            return False
    return True


@compiled(error_model="numpy")
def room_at(space: Clearance, x: float, y: float, yaw: float, most: float) -> float:
    """Return the largest margin, m, up to `most`, with which the car is collision-free at a pose; below 0 if none."""
    if not is_collision_free(space, x, y, yaw, 0.0):
        return -1.0
    low, high = 0.0, most
    for _ in range(12):
        middle = 0.5 * (low + high)
        if is_collision_free(space, x, y, yaw, middle):
            low = middle
        else:
            high = middle
    return low


@compiled(error_model="numpy")
def _check_every(margin: float) -> float:
    """Return the distance between checked poses, m: corners that pass each other in between overlap little."""
    return CHECK_M if margin >= ROOMY_M else max(1.5 * margin, FINE_M)


@compiled(error_model="numpy")
def arc_is_free(
    space: Clearance, x: float, y: float, yaw: float, curvature: float, way: float, margin: float
) -> bool:
    """Return whether the car, grown by `margin` m, is collision-free along an arc of `way` m."""
    n = max(1, math.ceil(abs(way) / _check_every(margin)))
    for i in range(1, n + 1):
        px, py, pyaw = move_along(x, y, yaw, curvature, way * i / n)
        if not is_collision_free(space, px, py, pyaw, margin):
            return False
    return True


@compiled(error_model="numpy")
def free_length(
    space: Clearance, x: float, y: float, yaw: float, curvature: float, most: float, margin: float
) -> float:
    """Return how far, m, up to `most`, the car, grown by `margin` m, may drive along an arc; both negative backward."""
    n = math.ceil(abs(most) / _check_every(margin))
    for i in range(1, n + 1):
        px, py, pyaw = move_along(x, y, yaw, curvature, most * i / n)
        if not is_collision_free(space, px, py, pyaw, margin):
            free, blocked = most * (i - 1) / n, most * i / n
            for _ in range(5):
                middle = 0.5 * (free + blocked)
                px, py, pyaw = move_along(x, y, yaw, curvature, middle)
                if is_collision_free(space, px, py, pyaw, margin):
                    free = middle
                else:
                    blocked = middle
            return float(free)
    return most
