"""Hybrid A* with Reeds-Shepp shots: plan a path between two poses among obstacles.

After Dolgov, Thrun, Montemerlo and Diebel, "Path planning for autonomous vehicles in unknown semi-structured
environments", International Journal of Robotics Research 29 (2010). The search starts at the slot: few moves are
possible there, so it leaves the slot after few expansions, and a shot over the open lane completes the path. A
kinematic path can be driven in both directions, so the result is reversed.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.heap import pop, push
from parkenv.compiled.jit import compiled
from parkenv.driving.vehicle import VehicleParameters, move_along
from parkenv.files.field_types import NotNegative, Number, Validated, Whole
from planners.driving.car_path import CarPath
from planners.driving.clearance import CELL_M, Clearance, arc_is_free, clearance, free_length, room_at
from planners.driving.reeds_shepp import (
    PIECES,
    DriveCosts,
    Words,
    cheapest_shot,
    distance_between,
    shorten_path,
    words_buffer,
)

WINDOW_M = 9.0
"""Margin, m, around start and target within which the car may drive."""

_GRID_CELLS = 2  # cells of the distance field per cell of the heuristic's grid
_STEERINGS = np.array([0.0, 0.5, -0.5, 1.0, -1.0])
_MOST_NODES = 60_000
# Size of the hash table of cells, and a factor that spreads them over it.
_TABLE, _SPREAD = 1 << 17, 0x9E3779B1
_TIGHT_CELL_M, _TIGHT_YAW_CELLS, _FINE_BELOW_M = 0.02, 720, 0.01  # halved where a move has less clearance
_SHORTEST_M, _LONGEST_M = 0.02, 1.5  # of moves that end where the car would touch something


def _a_move(metres: float) -> float:
    if not (metres == 0.0 or 0.05 <= metres <= 2.0):
        raise ValueError("a move of 0 or 0.05 to 2 m")
    return metres


Attempts = Annotated[
    tuple[tuple[NotNegative, Annotated[Number, AfterValidator(_a_move)]], ...], Field(min_length=1)
]


@dataclass(frozen=True)
class SearchSettings(Validated):
    """Costs and limits of the search.

    Args:
        change_m: cost of a change of direction, m.
        steer_m: cost of turning the wheel from straight to its stop, m, at each change of curvature.
        reserve: fraction by which planned turning circles exceed the smallest one, which leaves room for corrections.
        attempts: pairs, tried in order, of the clearance to obstacles, m (less where start or target are closer), and
            the length of a search move, m. Cells are half as wide as a move is long. Moves of length 0 go on until
            the car would touch something, which leads out of the tightest slots.
        greed: weight of the heuristic, at least 1.
        most_expansions: number of expanded nodes after which an attempt fails.
        patience: after the first path, the search expands further nodes, this fraction of those so far.

    Raises:
        InputError: a value out of its range.
    """

    change_m: NotNegative = 3.0
    steer_m: NotNegative = 0.4
    reserve: NotNegative = 0.06
    attempts: Attempts = (
        (0.20, 0.5), (0.10, 0.5), (0.05, 0.5), (0.05, 0.0), (0.02, 0.0), (0.01, 0.0),
    )  # fmt: skip
    greed: Annotated[Number, Field(ge=1.0)] = 1.3
    most_expansions: Annotated[Whole, Field(ge=1)] = 20_000
    patience: NotNegative = 1.0


def plan_path(
    vehicle: VehicleParameters,
    outlines: FloatArray,
    n_corners: IntArray,
    start: FloatArray,
    target: FloatArray,
    settings: SearchSettings | None = None,
    window_m: float = WINDOW_M,
) -> CarPath | None:
    """Plan a collision-free path from one pose to another.

    Args:
        vehicle: the car.
        outlines: (n, k_max, 2) m: convex outlines of obstacles; lines have two corners.
        n_corners: (n,) number of valid corners of each outline.
        start: (3,) x, y in m and yaw in rad of the rear axle.
        target: (3,) likewise.
        settings: of the search.
        window_m: margin around start and target within which the car may drive.

    Returns:
        The path, or None if none was found.
    """
    settings = settings or SearchSettings()
    ends = np.stack([start[:2], target[:2]])
    low, high = ends.min(axis=0) - window_m, ends.max(axis=0) + window_m
    space = clearance(vehicle, outlines, n_corners, low, high)
    widest = max(margin for margin, _ in settings.attempts)
    ends_room = min(room_at(space, *map(float, pose), widest + 0.01) for pose in (start, target)) - 0.01
    if ends_room < -0.01:
        return None
    radius = vehicle.turning_radius * (1.0 + settings.reserve)
    # Copies, which are writable: compiled code for read-only arrays is another one.
    tried, origin = (-1.0, 0.0), np.array(target, dtype=np.float64)
    expansions = 0
    for wanted, move in settings.attempts:
        margin = max(min(wanted, ends_room), 0.0)
        if (margin, move) == tried:
            continue
        tried = (margin, move)
        left = _grid_distances(space, start[0], start[1], space.half[1] + margin)
        costs = DriveCosts(radius, margin, settings.change_m, settings.steer_m)
        goal = np.array(start, dtype=np.float64)
        limits = settings.greed, settings.most_expansions, settings.patience
        lengths, curvatures, opened = _search(space, left, origin, goal, costs, move, limits)
        expansions += opened
        if len(lengths):
            lengths, curvatures = shorten_path(space, origin, lengths, curvatures, costs)
            # Planned from the target outward, driven in reverse.
            return CarPath(np.array(start), -lengths[::-1], curvatures[::-1], expansions, margin, vehicle)
    return None


def why_no_path(
    vehicle: VehicleParameters,
    outlines: FloatArray,
    n_corners: IntArray,
    start: FloatArray,
    target: FloatArray,
) -> str:
    """Say why `plan_path` found none for these arguments."""
    size = f"{vehicle.length:g} m × {vehicle.width:g} m"
    for pose, where in ((target, "in the slot"), (start, "where it stands")):
        space = clearance(vehicle, outlines, n_corners, pose[:2] - WINDOW_M, pose[:2] + WINDOW_M)
        if room_at(space, *map(float, pose), 0.01) <= 0.0:
            return f"no path was found: the car, {size}, would touch an obstacle {where}"
    return f"no path was found for a car, {size}, that turns on a radius of {vehicle.turning_radius:.1f} m"


@compiled(error_model="numpy")
def _grid_distances(space: Clearance, x: float, y: float, least: float) -> FloatArray:
    """Return the shortest distances, m, of all cells to a point, for a disc of radius `least`; inf if unreachable.

    It is the heuristic that ignores the car's kinematics.
    """
    step = CELL_M * _GRID_CELLS
    rows, columns = space.field.shape[0] // _GRID_CELLS, space.field.shape[1] // _GRID_CELLS
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
                if space.field[r * _GRID_CELLS, c * _GRID_CELLS] + 0.35 < least:
                    continue
                further = key + step * math.sqrt(float(dr * dr + dc * dc))
                if further < left[r, c] - 1e-9:
                    left[r, c] = further
                    size = push(keys, cells, size, further, r * columns + c)
    return left


@compiled(error_model="numpy")
def _search(
    space: Clearance,
    left: FloatArray,
    start: FloatArray,
    end: FloatArray,
    costs: DriveCosts,
    move: float,
    limits: tuple[float, int, float],
) -> tuple[FloatArray, FloatArray, int]:
    """Run hybrid A*; return lengths, m, and curvatures, 1/m, of the arcs from start to end, and the expansions."""
    # Best node per cell and direction of arrival, in a hash table. In a tight slot moves shift the car sideways by
    # millimetres, so cells are small there; else each move would end in the cell where it started.
    tight = move == 0.0
    cell, yaw_cells = (_TIGHT_CELL_M, _TIGHT_YAW_CELLS) if tight else (0.5 * move, round(36.0 / move))
    if tight and costs.margin < _FINE_BELOW_M:
        cell, yaw_cells = 0.5 * cell, 2 * yaw_cells
    rows, columns = space.field.shape[0] * CELL_M / cell + 1.0, space.field.shape[1] * CELL_M / cell + 1.0
    node_of, cell_of = np.full(_TABLE, -1, np.int32), np.empty(_MOST_NODES, np.int64)
    pose, cost = np.empty((_MOST_NODES, 3)), np.empty(_MOST_NODES)
    parent = np.empty(_MOST_NODES, np.int32)
    way, steering = np.empty(_MOST_NODES), np.empty(_MOST_NODES)
    closed = np.zeros(_MOST_NODES, np.bool_)
    keys, queue = np.empty(_MOST_NODES + 1), np.empty(_MOST_NODES + 1, np.int32)
    words, radius = Words(*words_buffer()), costs.radius
    shot_piece, shot_turn = np.zeros(PIECES), np.zeros(PIECES, np.int64)
    shot_count, shot_node, best = 0, -1, math.inf
    coarse = CELL_M * _GRID_CELLS

    pose[0], cost[0], parent[0], way[0], steering[0] = start, 0.0, -1, 0.0, 0.0
    n, size = 1, push(keys, queue, 0, 0.0, 0)
    greed, last, patience = limits
    opened = 0
    while size > 0 and opened < last and n < _MOST_NODES - 16:
        key, node = keys[0], queue[0]
        size = pop(keys, queue, size)
        if closed[node]:
            continue
        if key >= best:
            break
        closed[node] = True
        opened += 1
        x, y, yaw = pose[node]
        if tight or opened <= 64 or opened % 4 == 0:
            below = best - cost[node]
            word, more = cheapest_shot(space, pose[node], end, costs, way[node], steering[node], below, words)
            if word >= 0:
                if shot_node < 0:
                    last = min(last, opened + int(patience * opened) + 32)
                best, shot_node, shot_count = cost[node] + more, node, words.n_pieces[word]
                for i in range(len(shot_piece)):
                    shot_piece[i], shot_turn[i] = words.piece[word, i], words.turn[word, i]
        for direction in (1.0, -1.0):
            for share in _STEERINGS:
                curvature, length = share / radius, direction * move
                if tight:
                    length = free_length(space, x, y, yaw, curvature, direction * _LONGEST_M, costs.margin)
                    if abs(length) < _SHORTEST_M:
                        continue
                g = cost[node] + abs(length) + costs.steer_m * abs(share - steering[node])
                if way[node] * direction < 0.0:
                    g += costs.change_m
                nx, ny, nyaw = move_along(x, y, yaw, curvature, length)
                row, column = int((ny - space.low[1]) / cell), int((nx - space.low[0]) / cell)
                r, c = int((ny - space.low[1]) / coarse), int((nx - space.low[0]) / coarse)
                if row < 0 or column < 0 or row >= rows or column >= columns:
                    continue
                if r < 0 or c < 0 or r >= left.shape[0] or c >= left.shape[1]:
                    continue
                yaw_cell = math.floor(nyaw / (2.0 * math.pi) * yaw_cells) % yaw_cells
                key = ((row * int(columns) + column) * yaw_cells + yaw_cell) * 2 + (direction > 0.0)
                place = ((key * _SPREAD) >> 16) % _TABLE  # low bits of a product depend on low bits alone
                while node_of[place] >= 0 and cell_of[node_of[place]] != key:
                    place = (place + 1) % _TABLE
                old = node_of[place]
                if old >= 0 and (closed[old] or cost[old] <= g):
                    continue
                if not (tight or arc_is_free(space, x, y, yaw, curvature, length, costs.margin)):
                    continue
                cs, sn = math.cos(nyaw), math.sin(nyaw)
                dx, dy = end[0] - nx, end[1] - ny
                along, across = cs * dx + sn * dy, cs * dy - sn * dx
                h = distance_between(along, across, end[2] - nyaw, radius, costs.change_m, words)
                if left[r, c] < math.inf:
                    h = max(h, left[r, c])
                if g + h >= best:
                    continue
                node_of[place], cell_of[n] = n, key
                pose[n, 0], pose[n, 1], pose[n, 2] = nx, ny, nyaw
                cost[n], parent[n], way[n], steering[n] = g, node, length, share
                if old >= 0:
                    closed[old] = True
                size = push(keys, queue, size, g + greed * h, n)
                n += 1
    if shot_node < 0:
        return np.empty(0), np.empty(0), opened
    depth, node = 0, shot_node
    while parent[node] >= 0:
        depth, node = depth + 1, parent[node]
    lengths, curvatures = np.empty(depth + shot_count), np.empty(depth + shot_count)
    node = shot_node
    for i in range(depth - 1, -1, -1):
        lengths[i], curvatures[i] = way[node], steering[node] / radius
        node = parent[node]
    for i in range(shot_count):
        lengths[depth + i], curvatures[depth + i] = shot_piece[i] * radius, shot_turn[i] / radius
    return lengths, curvatures, opened
