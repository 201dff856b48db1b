"""Reeds-Shepp curves: shortest paths without obstacles of a car that drives forward and backward.

After Reeds and Shepp, "Optimal paths for a car that goes both forwards and backwards", Pacific Journal of
Mathematics 145 (1990): such a path is one of 48 words of at most five pieces: left or right turns of the smallest
radius, or straight lines. The words follow from eight formulas (their section 8) by reversing time, mirroring left and
right, and reversing the order of the pieces.
"""

import math
from typing import NamedTuple

import numpy as np

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.driving.vehicle import move_along
from planners.driving.car_path import SHORTEST_ARC
from planners.driving.clearance import Clearance, arc_is_free

RIGHT, STRAIGHT, LEFT = -1, 0, 1
PIECES = 5
MOST_WORDS = 96
"""Rows needed for all words between two poses: some of the 48 words have two versions."""


class Words(NamedTuple):
    """Buffer for all words between two poses, a row each."""

    piece: FloatArray  # (MOST_WORDS, 5) signed length of each piece, negative backward
    turn: IntArray  # (MOST_WORDS, 5) `LEFT`, `STRAIGHT` or `RIGHT`
    n_pieces: IntArray  # (MOST_WORDS,)
    cost: FloatArray  # (MOST_WORDS,) scratch for the caller


_EDGE = 1e-9
_HALF = 0.5 * math.pi
# By formula: the words in order; in the middle pieces, how many times u, and how many quarter turns; signs of u and of
# the last piece, 0 for either.
_TURN = np.array(
    [
        [LEFT, STRAIGHT, LEFT, 0, 0], [LEFT, STRAIGHT, RIGHT, 0, 0], [LEFT, RIGHT, LEFT, 0, 0],
        [LEFT, RIGHT, LEFT, RIGHT, 0], [LEFT, RIGHT, LEFT, RIGHT, 0], [LEFT, RIGHT, STRAIGHT, LEFT, 0],
        [LEFT, RIGHT, STRAIGHT, RIGHT, 0], [LEFT, RIGHT, STRAIGHT, LEFT, RIGHT],
    ]
)  # fmt: skip
_COUNT = np.array([3, 3, 3, 4, 4, 4, 4, 5])
_SHARE = np.array([[0, 1, 0, 0]] * 3 + [[0, 1, -1, 0], [0, 1, 1, 0]] + [[0, 0, 1, 0]] * 3, float)
_QUARTERS = np.array([[0, 0, 0, 0]] * 5 + [[0, -1, 0, 0]] * 2 + [[0, -1, 0, -1]], float)
_SIGN = np.array([[0, 1], [0, 1], [-1, 0], [0, -1], [0, 1], [-1, -1], [-1, -1], [-1, 1]], float)


@compiled(error_model="numpy")
def words_buffer() -> tuple[FloatArray, IntArray, IntArray, FloatArray]:
    shape = (MOST_WORDS, PIECES)
    return np.zeros(shape), np.zeros(shape, np.int64), np.zeros(MOST_WORDS, np.int64), np.zeros(MOST_WORDS)


@compiled(error_model="numpy")
def _turned(angle: float) -> float:
    """Normalise an angle to [-π, π)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@compiled(error_model="numpy")
def _outer(u: float, v: float, xi: float, eta: float, phi: float) -> tuple[float, float]:
    """Return the first and last turn of a word of four turns with inner turns u and v (their section 8, τ and ω)."""
    delta = _turned(u - v)
    a, b = math.sin(u) - math.sin(delta), math.cos(u) - math.cos(delta) - 1.0
    tau = math.atan2(eta * a - xi * b, xi * a + eta * b)
    if 2.0 * (math.cos(delta) - math.cos(v) - math.cos(u)) + 3.0 < 0.0:
        tau += math.pi
    tau = _turned(tau)
    return tau, _turned(tau - u + v - phi)


@compiled(error_model="numpy")
def _formula(number: int, x: float, y: float, phi: float, piece: FloatArray, turn: IntArray) -> int:
    """Evaluate one of the eight formulas for a pose; fill lengths and turns, return the number of pieces or 0.

    Lengths are signed, in turning radii. A minus in the names below marks a piece driven backward.
    """
    ahead, left = x - math.sin(phi), y - 1.0 + math.cos(phi)  # for words that end in a left turn
    across, down = x + math.sin(phi), y - 1.0 - math.cos(phi)  # for words that end in a right turn
    if number == 0:  # L S L
        u, t = math.hypot(ahead, left), math.atan2(left, ahead)
        v = _turned(phi - t)
    elif number == 1:  # L S R
        square = across * across + down * down
        if square < 4.0:
            return 0
        u = math.sqrt(square - 4.0)
        t = _turned(math.atan2(down, across) + math.atan2(2.0, u))
        v = _turned(t - phi)
    elif number == 2:  # L R- L, with the last turn in either direction
        far = math.hypot(ahead, left)
        if far > 4.0:
            return 0
        u = -2.0 * math.asin(0.25 * far)
        t = _turned(math.atan2(left, ahead) + 0.5 * u + math.pi)
        v = _turned(phi - t + u)
    elif number == 3:  # L R L- R-
        share = 0.25 * (2.0 + math.hypot(across, down))
        if share > 1.0:
            return 0
        u = math.acos(share)
        t, v = _outer(u, -u, across, down, phi)
    elif number == 4:  # L R- L- R
        share = (20.0 - across * across - down * down) / 16.0
        if share < 0.0 or share > 1.0:
            return 0
        u = -math.acos(share)
        t, v = _outer(u, u, across, down, phi)
        if u < -_HALF:
            return 0
    elif number == 5:  # L R- S- L-
        far = math.hypot(ahead, left)
        if far < 2.0:
            return 0
        r = math.sqrt(far * far - 4.0)
        u = 2.0 - r
        t = _turned(math.atan2(left, ahead) + math.atan2(r, -2.0))
        v = _turned(phi - _HALF - t)
    elif number == 6:  # L R- S- R-
        far = math.hypot(across, down)
        if far < 2.0:
            return 0
        t = math.atan2(across, -down)
        u = 2.0 - far
        v = _turned(t + _HALF - phi)
    else:  # L R- S- L- R
        far = math.hypot(across, down)
        if far < 2.0:
            return 0
        u = 4.0 - math.sqrt(far * far - 4.0)
        t = _turned(math.atan2((4.0 - u) * across - 2.0 * down, -2.0 * across + (u - 4.0) * down))
        v = _turned(t - phi)
    if t < -_EDGE or _SIGN[number, 0] * u < -_EDGE or _SIGN[number, 1] * v < -_EDGE:
        return 0
    count = _COUNT[number]
    for i in range(count):
        piece[i], turn[i] = _SHARE[number, i] * u + _QUARTERS[number, i] * _HALF, _TURN[number, i]
    piece[0], piece[count - 1] = t, v
    return int(count)


@compiled(error_model="numpy")
def words_between(x: float, y: float, phi: float, words: Words) -> int:
    """Fill the buffer with all words from the origin to a pose, in turning radii; return their number, at least 1."""
    n, pieces, turns = 0, words.piece, words.turn
    back_x, back_y = x * math.cos(phi) + y * math.sin(phi), x * math.sin(phi) - y * math.cos(phi)
    for number in range(8):
        # Reversing the order gives a new word only for these.
        orders = 2 if number in (2, 5, 6) else 1
        for order in range(orders):
            ox, oy = (back_x, back_y) if order else (x, y)
            for flip in range(2):  # reverse time: every piece in the other direction
                for mirror in range(2):  # mirror: swap left and right
                    fx = -ox if flip else ox
                    fy = -oy if mirror else oy
                    angle = -phi if flip != mirror else phi
                    count = _formula(number, fx, fy, angle, pieces[n], turns[n])
                    if count == 0:
                        continue
                    if order:
                        for i in range(count // 2):
                            j = count - 1 - i
                            pieces[n, i], pieces[n, j] = pieces[n, j], pieces[n, i]
                            turns[n, i], turns[n, j] = turns[n, j], turns[n, i]
                    for i in range(count):
                        if flip:
                            pieces[n, i] = -pieces[n, i]
                        if mirror:
                            turns[n, i] = -turns[n, i]
                    words.n_pieces[n] = count
                    n += 1
    return n


@compiled(error_model="numpy")
def word_cost(piece: FloatArray, count: int, radius: float, change_m: float) -> float:
    """Return the length, m, of a word plus `change_m` for every change of direction within it."""
    cost, direction = 0.0, 0.0
    for i in range(count):
        cost += abs(piece[i]) * radius
        if abs(piece[i]) < _EDGE:
            continue
        if piece[i] * direction < 0.0:
            cost += change_m
        direction = piece[i]
    return cost


@compiled(error_model="numpy")
def distance_between(x: float, y: float, phi: float, radius: float, change_m: float, words: Words) -> float:
    """Return the lowest `word_cost` of all words to a pose, m."""
    best = math.inf
    for k in range(words_between(x / radius, y / radius, phi, words)):
        best = min(best, word_cost(words.piece[k], words.n_pieces[k], radius, change_m))
    return best


def reeds_shepp(
    start: FloatArray, end: FloatArray, radius: float, change_m: float = 0.0
) -> tuple[FloatArray, IntArray]:
    """Return the shortest path between two poses of a car that drives forward and backward.

    Args:
        start: (3,) x, y in m and yaw in rad of the rear axle.
        end: (3,) likewise.
        radius: m, radius of the smallest turning circle.
        change_m: m, cost of a change of direction.

    Returns:
        (k,) signed lengths in m, negative backward, and (k,) turns, `LEFT`, `STRAIGHT` or `RIGHT`.

    Examples:
        >>> length, turn = reeds_shepp(np.zeros(3), np.array([0.0, 2.0, np.pi]), radius=1.0)
        >>> bool(np.isclose(np.abs(length).sum(), np.pi))
        True
    """
    step = np.asarray(end, dtype=np.float64) - start
    c, s = math.cos(start[2]), math.sin(start[2])
    x, y = (c * step[0] + s * step[1]) / radius, (c * step[1] - s * step[0]) / radius
    words = Words(*words_buffer())
    n = words_between(float(x), float(y), float(step[2]), words)
    costs = [word_cost(words.piece[k], int(words.n_pieces[k]), radius, change_m) for k in range(n)]
    best = int(np.argmin(costs))
    kept = np.flatnonzero(np.abs(words.piece[best, : words.n_pieces[best]]) > _EDGE)
    return words.piece[best, kept] * radius, words.turn[best, kept]


# ---- shots: the cheapest collision-free word between two poses; paths shortened by them


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
    space: Clearance, start: FloatArray, lengths: FloatArray, curvatures: FloatArray, costs: DriveCosts
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
