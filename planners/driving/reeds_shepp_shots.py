"""Reeds-Shepp shots: the cheapest collision-free word between two poses, checked exactly."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from parkenv.driving.vehicle import move_along
from planners.driving.clearance import Clearance, stands_free
from planners.driving.reeds_shepp import word_cost, words_between
from sim_sensors.compilation import compiled

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CHECK_M = 0.15
"""Maximum distance, m, between checked poses."""


@compiled(error_model="numpy")
def arc_is_free(
    space: Clearance, x: float, y: float, yaw: float, curvature: float, way: float, margin: float
) -> bool:
    """Return whether the car, grown by `margin` m, is collision-free along an arc of `way` m."""
    n = max(1, math.ceil(abs(way) / CHECK_M))
    for i in range(1, n + 1):
        px, py, pyaw = move_along(x, y, yaw, curvature, way * i / n)
        if not stands_free(space, px, py, pyaw, margin):
            return False
    return True


@compiled(error_model="numpy")
def _word_is_free(
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
        if not arc_is_free(space, x, y, yaw, curvature, way, margin):
            return False
        x, y, yaw = move_along(x, y, yaw, curvature, way)
    return True


@compiled(error_model="numpy")
def _steering_cost(turn: IntArray, count: int, before: float, steer_m: float) -> float:
    """Return the cost, m, of turning the wheel along a word, after a curvature of `before` times the maximum."""
    cost = 0.0
    for i in range(count):
        cost += steer_m * abs(turn[i] - before)
        before = float(turn[i])
    return cost


@compiled(error_model="numpy")
def cheapest_shot(
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
    """Return the row, or -1, and cost, m, of the cheapest collision-free word to `end` that costs less than `below`."""
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
        if _word_is_free(space, x, y, yaw, pieces[best], turns[best], counts[best], radius, margin):
            return best, costs[best]
        costs[best] = math.inf
