"""Path shortening: replace parts of a path by collision-free Reeds-Shepp words, and merge equal arcs."""

from __future__ import annotations

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled
from parkenv.driving.vehicle import move_along
from planners.driving.car_path import SHORTEST_ARC
from planners.driving.clearance import Clearance
from planners.driving.reeds_shepp import Words, words_buffer
from planners.driving.reeds_shepp_shots import DriveCosts, cheapest_shot


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
                x, y, yaw = poses[first]
                direction = lengths[first - 1] if first > 0 else 0.0
                steering = curvatures[first - 1] * radius if first > 0 else 0.0
                below = part + 2.0 * costs.change_m
                word, _ = cheapest_shot(
                    space, x, y, yaw, poses[end], costs, direction, steering, below, words
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
