"""Reeds-Shepp shots: the cheapest collision-free word between two poses, checked exactly; paths shortened by them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled
from parkenv.driving.vehicle import move_along
from planners.driving.car_path import SHORTEST_ARC
from planners.driving.clearance import Clearance, is_collision_free
from planners.driving.reeds_shepp import Words, word_cost, words_between, words_buffer

CHECK_M, FINE_M = 0.15, 0.015  # maximum distance, m, between checked poses, and that without any clearance
ROOMY_M = 0.045  # clearance, m, from which on the first one is enough


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


class DriveCosts(NamedTuple):
    """How the car drives: radius of its turns and clearance to obstacles; costs of changes of direction and steering.

    All in m; the cost of steering is that of turning the wheel from straight to its stop.
    """

    radius: float
    margin: float
    change_m: float
    steer_m: float


@compiled(error_model="numpy")
def _word_is_free(
    space: Clearance, x: float, y: float, yaw: float, words: Words, word: int, costs: DriveCosts
) -> bool:
    for i in range(words.n_pieces[word]):
        curvature, way = words.turn[word, i] / costs.radius, words.piece[word, i] * costs.radius
        if not arc_is_free(space, x, y, yaw, curvature, way, costs.margin):
            return False
        x, y, yaw = move_along(x, y, yaw, curvature, way)
    return True


@compiled(error_model="numpy")
def cheapest_shot(
    space: Clearance,
    start: FloatArray,
    end: FloatArray,
    costs: DriveCosts,
    direction: float,
    steering: float,
    below: float,
    words: Words,
) -> tuple[int, float]:
    """Return the row, or -1, and cost, m, of the cheapest collision-free word to `end` that costs less than `below`.

    The car arrives with a direction, 1 or -1 (0 at a standstill), and a curvature of `steering` times the maximum.
    """
    x, y, yaw = start[0], start[1], start[2]
    dx, dy = end[0] - x, end[1] - y
    c, s = math.cos(yaw), math.sin(yaw)
    along, across = (c * dx + s * dy) / costs.radius, (c * dy - s * dx) / costs.radius
    n = words_between(along, across, end[2] - yaw, words)
    for k in range(n):
        turned, before = 0.0, steering
        for i in range(words.n_pieces[k]):
            turned += costs.steer_m * abs(words.turn[k, i] - before)
            before = float(words.turn[k, i])
        words.cost[k] = word_cost(words.piece[k], words.n_pieces[k], costs.radius, costs.change_m) + turned
        if words.piece[k, 0] * direction < 0.0:
            words.cost[k] += costs.change_m
    while True:
        best = -1
        for k in range(n):
            if words.cost[k] < below and (best < 0 or words.cost[k] < words.cost[best]):
                best = k
        if best < 0:
            return -1, math.inf
        if _word_is_free(space, x, y, yaw, words, best, costs):
            return best, words.cost[best]
        words.cost[best] = math.inf


@compiled(error_model="numpy")
def shorten_path(
    space: Clearance,
    start: FloatArray,
    lengths: FloatArray,
    curvatures: FloatArray,
    costs: DriveCosts,
) -> tuple[FloatArray, FloatArray]:
    """Replace parts of a path by collision-free Reeds-Shepp words where that lowers its cost."""
    words, radius = Words(*words_buffer()), costs.radius
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
            whole = _path_cost(lengths, curvatures, costs)
            for end in range(n, first + 1, -1):
                part = _path_cost(lengths[first:end], curvatures[first:end], costs)
                direction = lengths[first - 1] if first > 0 else 0.0
                steering = curvatures[first - 1] * radius if first > 0 else 0.0
                below = part + 2.0 * costs.change_m
                word, _ = cheapest_shot(
                    space, poses[first], poses[end], costs, direction, steering, below, words
                )
                if word < 0:
                    continue
                count = words.n_pieces[word]
                new_lengths = np.concatenate(
                    (lengths[:first], words.piece[word, :count] * radius, lengths[end:])
                )
                new_curvatures = np.concatenate(
                    (curvatures[:first], words.turn[word, :count] / radius, curvatures[end:])
                )
                if _path_cost(new_lengths, new_curvatures, costs) < whole - 1e-3:
                    lengths, curvatures = new_lengths, new_curvatures
                    better = True
                    break
            first += 1
        if not better:
            break
    # Merge consecutive arcs of equal curvature and direction.
    out_lengths, out_curvatures = np.empty(len(lengths)), np.empty(len(lengths))
    k = 0
    for i in range(len(lengths)):
        if abs(lengths[i]) < SHORTEST_ARC:
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


@compiled(error_model="numpy")
def _path_cost(lengths: FloatArray, curvatures: FloatArray, costs: DriveCosts) -> float:
    cost, before, bend = 0.0, 0.0, 0.0
    for i in range(len(lengths)):
        if abs(lengths[i]) < SHORTEST_ARC:
            continue
        cost += abs(lengths[i]) + costs.steer_m * costs.radius * abs(curvatures[i] - bend)
        if lengths[i] * before < 0.0:
            cost += costs.change_m
        before, bend = lengths[i], curvatures[i]
    return cost
