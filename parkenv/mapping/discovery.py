"""Discover slots from the poses of detected cars, without a given map (T §6)."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, require_whole
from parkenv.world.lot import FARTHEST, ParkingLot

_TURN_M = 3.0  # m, distance equivalent to a quarter turn when cars are compared
_REACH = 1.0  # m, from the middle of a slot's cars to each
_WIDTH = 0.7  # m, standard deviation of the density kernel
_WITHIN, _TURNED = 1.0, math.radians(15.0)  # largest distance, m, and turn of a found slot from the true one
_ROOM = (4.2, 1.9)  # m, least distance between slot centres along and across a slot: a car's length and width


class FoundSlots(NamedTuple):
    xy: FloatArray  # (n, 2) m, centres
    yaw: FloatArray  # (n,) rad, along the slot, in [0, π)
    cars: NDArray[np.int64]  # (n,) int64, number of cars detected there


class DiscoveryScore(NamedTuple):
    precision: float  # fraction of the discovered slots that are true slots
    recall: float  # fraction of the true slots that were discovered
    error: float  # m, mean distance of matched slots
    yaw_error: float  # rad, mean


def discover(cars: FloatArray, least: int = 3) -> FoundSlots:
    """Find slots in the poses of cars from many sessions: dense clusters are slots, single cars are not.

    The densest position becomes a slot, then the densest one outside all slots so far, and so on. Cars cannot overlap,
    so neighbouring slots stay separate however many sessions there are; a chaining method would merge their clusters
    once poses scatter by more than the gap between cars. Directions count as well, with a quarter turn equivalent to
    3 m; nose-in and nose-out are the same. A slot's position is the median of the cars within 1 m.

    Cars are (n, 3) x, y in m and yaw in rad; `least` of them make a slot.

    Examples:
        >>> slots = discover(np.array([[0.0, 0.1, 1.6], [0.1, 0.0, 4.7], [-0.1, 0.0, 1.5], [2.5, 0.0, 1.6]]))
        >>> slots.xy.round(1).tolist(), slots.cars.tolist()
        ([[0.0, 0.0]], [3])
    """
    if cars.ndim != 2 or cars.shape[1] != 3 or not (np.abs(cars) <= FARTHEST).all():
        raise InputError(
            f"cars have shape {cars.shape}, want (n, 3) of finite numbers, at most {FARTHEST:.0e}"
        )
    require_whole("least", least, least=1)
    # Twice the angle is the same for nose-in and nose-out.
    turn = _TURN_M / 2.0 * np.stack([np.cos(2.0 * cars[:, 2]), np.sin(2.0 * cars[:, 2])], axis=1)
    poses = np.column_stack([cars[:, :2], turn])
    tree = cKDTree(poses)
    density, near = _density(tree)
    within = cKDTree(cars[:, :2])
    open_to_slots = near >= least
    xy, yaw, count = [], [], []
    for k in np.argsort(-density, kind="stable").tolist():
        if not open_to_slots[k]:
            continue
        middle = np.median(poses[tree.query_ball_point(poses[k], _REACH)], axis=0)
        # Repeat from the median, which also has the cars on its other side within reach.
        these = tree.query_ball_point(middle, _REACH) or [k]
        middle = np.median(poses[these], axis=0)
        direction = 0.5 * math.atan2(middle[3], middle[2]) % math.pi
        around = np.array(within.query_ball_point(middle[:2], math.hypot(*_ROOM)), dtype=np.int64)
        open_to_slots[around[_inside(cars[around, :2] - middle[:2], direction)]] = False
        open_to_slots[k] = False
        xy.append(middle[:2])
        yaw.append(direction)
        count.append(len(these))
    return FoundSlots(np.array(xy).reshape(-1, 2), np.array(yaw), np.array(count, dtype=np.int64))


def _density(tree: cKDTree) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return the density of poses at each pose, and the number of poses within reach, including itself."""
    pairs = tree.query_pairs(2.0 * _WIDTH, output_type="ndarray")
    away = np.linalg.norm(tree.data[pairs[:, 0]] - tree.data[pairs[:, 1]], axis=1)
    weight = np.exp(-0.5 * (away / _WIDTH) ** 2)
    density, near = np.ones(tree.n), np.ones(tree.n, dtype=np.int64)
    for side in (0, 1):
        density += np.bincount(pairs[:, side], weight, minlength=tree.n)
        near += np.bincount(pairs[away <= _REACH, side], minlength=tree.n)
    return density, near


def _inside(away: FloatArray, direction: float) -> NDArray[np.bool_]:
    c, s = math.cos(direction), math.sin(direction)
    along, across = c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]
    return np.asarray((np.abs(along) < _ROOM[0]) & (np.abs(across) < _ROOM[1]))


def score_discovery(slots: FoundSlots, lot: ParkingLot) -> DiscoveryScore:
    """Match discovered slots to the lot's slots one to one, nearest pairs first, and compute the errors."""
    away = np.hypot(*(slots.xy[:, None] - lot.slot_xy[None]).transpose(2, 0, 1))
    turn = np.abs((slots.yaw[:, None] - lot.slot_yaw[None] + math.pi / 2) % math.pi - math.pi / 2)
    pairs = np.argwhere((away <= _WITHIN) & (turn <= _TURNED))
    pairs = pairs[np.argsort(away[pairs[:, 0], pairs[:, 1]], kind="stable")]
    left, right = set(range(len(slots.xy))), set(range(lot.n_slots))
    chosen = []
    for a, b in pairs.tolist():
        if a in left and b in right:
            left.remove(a)
            right.remove(b)
            chosen.append((a, b))
    rows, columns = np.array(chosen, dtype=np.int64).reshape(-1, 2).T
    return DiscoveryScore(
        len(chosen) / max(len(slots.xy), 1),
        len(chosen) / lot.n_slots,
        float(away[rows, columns].mean()) if chosen else math.nan,
        float(turn[rows, columns].mean()) if chosen else math.nan,
    )
