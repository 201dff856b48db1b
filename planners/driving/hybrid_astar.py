"""A way for a car between two poses among obstacles: hybrid A* with Reeds-Shepp shots.

After Dolgov, Thrun, Montemerlo and Diebel, "Path planning for autonomous vehicles in unknown semi-structured
environments", International Journal of Robotics Research 29 (2010). The search runs from the slot outward: there few
moves are possible, so it comes out soon, and a shot over the open lane ends it. A car without inertia may drive any
path both ways, so the path is then reversed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from parkenv.driving.vehicle import VehicleParameters, move_along
from parkenv.errors import InputError
from planners.driving.clearance import CELL_M, Clearance, clearance, room_at, stands_free
from planners.driving.reeds_shepp import MOST_WORDS, PIECES, distance_between, word_cost, words_between
from planners.thesis.heap import pop, push
from sim_sensors.compilation import compiled

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CHECK_M = 0.15
"""m, between poses that are checked."""
WINDOW_M = 9.0
"""m, around start and target: where the car may go."""

_STEERINGS = np.array([0.0, 0.5, -0.5, 1.0, -1.0])
_COARSE = 2  # cells of the distance field in one of the grid that ways without a car's limits are sought on
_MOST_NODES = 60_000
_SHORT = 1e-6
_SHORT_MOVE_M = 0.4
_NARROW_M, _NARROW_CELL_M, _NARROW_YAW_CELLS = 2.0, 0.05, 360


@dataclass(frozen=True)
class SearchSettings:
    """What the search weighs and when it gives up.

    Args:
        change_m: m that a change of direction counts.
        steer_m: m that turning the wheel from straight to the stop counts, at each change of curvature.
        reserve: the planned turning circle is by this share wider than the car's, which leaves room to correct.
        attempts: pairs, tried in this order: m that the car keeps from everything, less where start or target lie
            closer; and m that one move of the search is long. A cell that keeps its best node alone is half as wide.
        greed: weight of the estimate of what is left, 1 or more.
        most_expansions: nodes opened before an attempt is given up.
        patience: the search goes on for a better path after the first by this share of the nodes opened until then.

    Raises:
        InputError: a value out of its range.
    """

    change_m: float = 3.0
    steer_m: float = 0.4
    reserve: float = 0.06
    attempts: tuple[tuple[float, float], ...] = (
        (0.20, 0.5),
        (0.10, 0.5),
        (0.05, 0.5),
        (0.05, 0.25),
        (0.02, 0.25),
    )
    greed: float = 1.3
    most_expansions: int = 20_000
    patience: float = 1.0

    def __post_init__(self) -> None:
        for name, least in (
            ("change_m", 0.0),
            ("steer_m", 0.0),
            ("reserve", 0.0),
            ("greed", 1.0),
            ("patience", 0.0),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= least):
                raise InputError(f"search {name} is {value!r}, want at least {least:g}")
        if not self.attempts or any(
            margin < 0.0 or not 0.05 <= move <= 2.0 for margin, move in self.attempts
        ):
            raise InputError(
                f"search attempts are {self.attempts!r}, want pairs of a margin, 0 m or more, and a move, 0.05 to 2 m"
            )
        if self.most_expansions < 1:
            raise InputError(f"search most_expansions is {self.most_expansions}, want at least 1")


@dataclass(frozen=True, eq=False)
class CarPath:
    """A path of arcs for a car that drives forward and backward.

    Args:
        start: (3,) x, y in m and yaw in rad of the rear axle.
        length: (k,) m of each arc, below 0 backward.
        curvature: (k,) 1/m, left above 0.
        expansions: nodes that the search opened.
        margin: m that the car keeps from everything.
    """

    start: FloatArray
    length: FloatArray
    curvature: FloatArray
    expansions: int = 0
    margin: float = 0.0

    @property
    def driven_m(self) -> float:
        """Its length, m."""
        return float(np.abs(self.length).sum())

    @property
    def direction_changes(self) -> int:
        """How often the car turns from forward to backward or back."""
        sign = np.sign(self.length[np.abs(self.length) > _SHORT])
        return int((sign[1:] != sign[:-1]).sum())

    @property
    def turned_rad(self) -> float:
        """How far the heading turns in all, rad, to either side: a measure of smoothness."""
        return float(np.abs(self.length * self.curvature).sum())

    def sampled(self, step: float = 0.05) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Poses along it, (n, 3); the curvature, (n,) 1/m, and direction, (n,) 1 or -1, of the arc that ends there."""
        poses, curvature, direction = [tuple(self.start.tolist())], [float(self.curvature[0])], [0.0]
        direction[0] = math.copysign(1.0, self.length[0])
        for length, bend in zip(self.length.tolist(), self.curvature.tolist(), strict=True):
            n = max(1, math.ceil(abs(length) / step))
            for _ in range(n):
                poses.append(move_along(*poses[-1], bend, length / n))
            curvature += [bend] * n
            direction += [math.copysign(1.0, length)] * n
        return np.array(poses), np.array(curvature), np.array(direction)


def plan_path(
    vehicle: VehicleParameters,
    outlines: FloatArray,
    n_corners: IntArray,
    start: FloatArray,
    target: FloatArray,
    settings: SearchSettings | None = None,
) -> CarPath | None:
    """A path from one pose to another that touches nothing.

    Args:
        vehicle: the car.
        outlines: (n, k_max, 2) m: convex outlines of what is in the way; lines have two corners.
        n_corners: (n,) how many corners of each count.
        start: (3,) x, y in m and yaw in rad of the rear axle.
        target: (3,) likewise.
        settings: of the search.

    Returns:
        The path, or None where none was found.
    """
    settings = settings or SearchSettings()
    ends = np.stack([start[:2], target[:2]])
    low, high = ends.min(axis=0) - WINDOW_M, ends.max(axis=0) + WINDOW_M
    space = clearance(vehicle, outlines, n_corners, low, high)
    widest = max(margin for margin, _ in settings.attempts)
    ends_room = min(room_at(space, *map(float, pose), widest + 0.01) for pose in (start, target)) - 0.01
    if ends_room < -0.01:
        return None
    radius = vehicle.turning_radius * (1.0 + settings.reserve)
    tried = (-1.0, 0.0)
    expansions = 0
    for wanted, move in settings.attempts:
        margin = max(min(wanted, ends_room), 0.0)
        if (margin, move) == tried:
            continue
        tried = (margin, move)
        left = ways_left(space, start[0], start[1], space.half[1] + margin)
        lengths, curvatures, opened = _search(
            space,
            left,
            np.asarray(target, dtype=np.float64),
            np.asarray(start, dtype=np.float64),
            radius,
            margin,
            move,
            settings.change_m,
            settings.steer_m,
            settings.greed,
            settings.most_expansions,
            settings.patience,
        )
        expansions += opened
        if len(lengths):
            lengths, curvatures = _shortened(
                space,
                np.asarray(target),
                lengths,
                curvatures,
                radius,
                margin,
                settings.change_m,
                settings.steer_m,
            )
            # Found from the target outward, driven the other way.
            return CarPath(np.array(start), -lengths[::-1], curvatures[::-1], expansions, margin)
    return None


@compiled(error_model="numpy")
def ways_left(space: Clearance, x: float, y: float, least: float) -> FloatArray:
    """Shortest ways, m, to a point for a disc of radius `least`, over a grid of `_COARSE` cells of the field."""
    step = CELL_M * _COARSE
    rows, columns = space.field.shape[0] // _COARSE, space.field.shape[1] // _COARSE
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
                # Half a cell of the grid and the field's own error are given away: an estimate must not be too long.
                if space.field[r * _COARSE, c * _COARSE] + 0.35 < least:
                    continue
                further = key + step * math.sqrt(float(dr * dr + dc * dc))
                if further < left[r, c] - 1e-9:
                    left[r, c] = further
                    size = push(keys, cells, size, further, r * columns + c)
    return left


@compiled(error_model="numpy")
def _arc_free(
    space: Clearance, x: float, y: float, yaw: float, curvature: float, way: float, margin: float
) -> bool:
    """Whether the car may drive an arc."""
    n = max(1, math.ceil(abs(way) / CHECK_M))
    for i in range(1, n + 1):
        px, py, pyaw = move_along(x, y, yaw, curvature, way * i / n)
        if not stands_free(space, px, py, pyaw, margin):
            return False
    return True


@compiled(error_model="numpy")
def _word_free(
    space: Clearance,
    x: float,
    y: float,
    yaw: float,
    piece: FloatArray,
    turn: IntArray,
    count: int,
    radius: float,
    margin: float,
) -> bool:
    for i in range(count):
        curvature, way = turn[i] / radius, piece[i] * radius
        if not _arc_free(space, x, y, yaw, curvature, way, margin):
            return False
        x, y, yaw = move_along(x, y, yaw, curvature, way)
    return True


@compiled(error_model="numpy")
def _steering_cost(turn: IntArray, count: int, before: float, steer_m: float) -> float:
    """What turning the wheel counts along a word that follows a curvature of `before` times the sharpest."""
    cost = 0.0
    for i in range(count):
        cost += steer_m * abs(turn[i] - before)
        before = float(turn[i])
    return cost


@compiled(error_model="numpy")
def _shot(
    space: Clearance,
    x: float,
    y: float,
    yaw: float,
    end: FloatArray,
    radius: float,
    margin: float,
    change_m: float,
    steer_m: float,
    direction: float,
    steering: float,
    below: float,
    pieces: FloatArray,
    turns: IntArray,
    counts: IntArray,
    costs: FloatArray,
) -> tuple[int, float]:
    """The cheapest word to `end` that touches nothing and costs less than `below`; its number, or -1, and cost."""
    dx, dy = end[0] - x, end[1] - y
    c, s = math.cos(yaw), math.sin(yaw)
    n = words_between(
        (c * dx + s * dy) / radius, (c * dy - s * dx) / radius, end[2] - yaw, pieces, turns, counts
    )
    for k in range(n):
        costs[k] = word_cost(pieces[k], counts[k], radius, change_m)
        costs[k] += _steering_cost(turns[k], counts[k], steering, steer_m)
        if pieces[k, 0] * direction < 0.0:
            costs[k] += change_m
    while True:
        best = -1
        for k in range(n):
            if costs[k] < below and (best < 0 or costs[k] < costs[best]):
                best = k
        if best < 0:
            return -1, math.inf
        if _word_free(space, x, y, yaw, pieces[best], turns[best], counts[best], radius, margin):
            return best, costs[best]
        costs[best] = math.inf


@compiled(error_model="numpy")
def _search(
    space: Clearance,
    left: FloatArray,
    start: FloatArray,
    end: FloatArray,
    radius: float,
    margin: float,
    move: float,
    change_m: float,
    steer_m: float,
    greed: float,
    most_expansions: int,
    patience: float,
) -> tuple[FloatArray, FloatArray, int]:
    """Hybrid A*; lengths, m, and curvatures, 1/m, of the arcs from `start` to `end`, and the nodes opened."""
    cell, yaw_cells = 0.5 * move, round(36.0 / move)
    rows = int(space.field.shape[0] * CELL_M / cell) + 1
    columns = int(space.field.shape[1] * CELL_M / cell) + 1
    # The best node of each cell, apart for arrivals forward and backward. Short moves are made to get out of a tight
    # slot, sideways by millimetres each: there cells are small, or each move would end in the cell where it began.
    n_wide = rows * columns * yaw_cells
    narrow = int(2.0 * _NARROW_M / _NARROW_CELL_M) if move < _SHORT_MOVE_M else 0
    node_of = np.full((n_wide + narrow * narrow * _NARROW_YAW_CELLS, 2), -1, np.int32)
    pose, cost = np.empty((_MOST_NODES, 3)), np.empty(_MOST_NODES)
    parent, way, steering = (
        np.empty(_MOST_NODES, np.int32), np.empty(_MOST_NODES), np.empty(_MOST_NODES),
    )  # fmt: skip
    closed = np.zeros(_MOST_NODES, np.bool_)
    keys, queue = np.empty(_MOST_NODES + 1), np.empty(_MOST_NODES + 1, np.int32)
    pieces, turns = np.zeros((MOST_WORDS, PIECES)), np.zeros((MOST_WORDS, PIECES), np.int64)
    counts, costs = np.zeros(MOST_WORDS, np.int64), np.empty(MOST_WORDS)
    shot_piece, shot_turn = np.zeros(PIECES), np.zeros(PIECES, np.int64)
    shot_count, shot_node, best = 0, -1, math.inf
    coarse = CELL_M * _COARSE

    pose[0], cost[0], parent[0], way[0], steering[0] = start, 0.0, -1, 0.0, 0.0
    n, size = 1, push(keys, queue, 0, 0.0, 0)
    opened, last = 0, most_expansions
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
        if opened <= 64 or opened % 4 == 0:
            word, more = _shot(
                space, x, y, yaw, end, radius, margin, change_m, steer_m, way[node], steering[node], best - cost[node],
                pieces, turns, counts, costs,
            )  # fmt: skip
            if word >= 0:
                if shot_node < 0:
                    last = min(last, opened + int(patience * opened) + 32)
                best, shot_node, shot_count = cost[node] + more, node, counts[word]
                shot_piece[:], shot_turn[:] = pieces[word], turns[word]
        for direction in (1.0, -1.0):
            for share in _STEERINGS:
                curvature, length = share / radius, direction * move
                g = cost[node] + move + steer_m * abs(share - steering[node])
                if way[node] * direction < 0.0:
                    g += change_m
                nx, ny, nyaw = move_along(x, y, yaw, curvature, length)
                row, column = int((ny - space.low[1]) / cell), int((nx - space.low[0]) / cell)
                r, c = int((ny - space.low[1]) / coarse), int((nx - space.low[0]) / coarse)
                if row < 0 or column < 0 or row >= rows or column >= columns:
                    continue
                if r < 0 or c < 0 or r >= left.shape[0] or c >= left.shape[1]:
                    continue
                turns_left = nyaw / (2.0 * math.pi)
                near_row = math.floor((ny - start[1] + _NARROW_M) / _NARROW_CELL_M)
                near_column = math.floor((nx - start[0] + _NARROW_M) / _NARROW_CELL_M)
                if 0 <= near_row < narrow and 0 <= near_column < narrow:
                    place = (near_row * narrow + near_column) * _NARROW_YAW_CELLS
                    place += n_wide + math.floor(turns_left * _NARROW_YAW_CELLS) % _NARROW_YAW_CELLS
                else:
                    place = (row * columns + column) * yaw_cells + math.floor(
                        turns_left * yaw_cells
                    ) % yaw_cells
                heading = 0 if direction > 0.0 else 1
                old = node_of[place, heading]
                if old >= 0 and (closed[old] or cost[old] <= g):
                    continue
                if not _arc_free(space, x, y, yaw, curvature, length, margin):
                    continue
                cs, sn = math.cos(nyaw), math.sin(nyaw)
                dx, dy = end[0] - nx, end[1] - ny
                h = distance_between(
                    cs * dx + sn * dy,
                    cs * dy - sn * dx,
                    end[2] - nyaw,
                    radius,
                    change_m,
                    pieces,
                    turns,
                    counts,
                )
                if left[r, c] < math.inf:
                    h = max(h, left[r, c])
                if g + h >= best:
                    continue
                node_of[place, heading] = n
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


@compiled(error_model="numpy")
def _path_cost(
    lengths: FloatArray, curvatures: FloatArray, radius: float, change_m: float, steer_m: float
) -> float:
    cost, before, bend = 0.0, 0.0, 0.0
    for i in range(len(lengths)):
        if abs(lengths[i]) < _SHORT:
            continue
        cost += abs(lengths[i]) + steer_m * radius * abs(curvatures[i] - bend)
        if lengths[i] * before < 0.0:
            cost += change_m
        before, bend = lengths[i], curvatures[i]
    return cost


@compiled(error_model="numpy")
def _shortened(
    space: Clearance,
    start: FloatArray,
    lengths: FloatArray,
    curvatures: FloatArray,
    radius: float,
    margin: float,
    change_m: float,
    steer_m: float,
) -> tuple[FloatArray, FloatArray]:
    """The path with stretches replaced by free Reeds-Shepp words wherever that makes the whole cheaper."""
    pieces, turns = np.zeros((MOST_WORDS, PIECES)), np.zeros((MOST_WORDS, PIECES), np.int64)
    counts, costs = np.zeros(MOST_WORDS, np.int64), np.empty(MOST_WORDS)
    for _ in range(3):
        better = False
        first = 0
        while first < len(lengths) - 1:
            n = len(lengths)
            poses = np.empty((n + 1, 3))
            poses[0] = start
            for i in range(n):
                x, y, yaw = move_along(poses[i, 0], poses[i, 1], poses[i, 2], curvatures[i], lengths[i])
                poses[i + 1, 0], poses[i + 1, 1], poses[i + 1, 2] = x, y, yaw
            whole = _path_cost(lengths, curvatures, radius, change_m, steer_m)
            for end in range(n, first + 1, -1):
                stretch = _path_cost(lengths[first:end], curvatures[first:end], radius, change_m, steer_m)
                word, _ = _shot(
                    space, poses[first, 0], poses[first, 1], poses[first, 2], poses[end], radius, margin, change_m,
                    steer_m, lengths[first - 1] if first > 0 else 0.0,
                    curvatures[first - 1] * radius if first > 0 else 0.0,
                    stretch + 2.0 * change_m, pieces, turns, counts, costs,
                )  # fmt: skip
                if word < 0:
                    continue
                count = counts[word]
                new_lengths = np.concatenate((lengths[:first], pieces[word, :count] * radius, lengths[end:]))
                new_curvatures = np.concatenate(
                    (curvatures[:first], turns[word, :count] / radius, curvatures[end:])
                )
                if _path_cost(new_lengths, new_curvatures, radius, change_m, steer_m) < whole - 1e-3:
                    lengths, curvatures = new_lengths, new_curvatures
                    better = True
                    break
            first += 1
        if not better:
            break
    # Joined where arcs of one curvature and direction follow each other.
    out_lengths, out_curvatures = np.empty(len(lengths)), np.empty(len(lengths))
    k = 0
    for i in range(len(lengths)):
        if abs(lengths[i]) < _SHORT:
            continue
        same = (
            k > 0
            and abs(out_curvatures[k - 1] - curvatures[i]) < 1e-9
            and out_lengths[k - 1] * lengths[i] > 0.0
        )
        if same:
            out_lengths[k - 1] += lengths[i]
        else:
            out_lengths[k], out_curvatures[k] = lengths[i], curvatures[i]
            k += 1
    return out_lengths[:k].copy(), out_curvatures[:k].copy()
