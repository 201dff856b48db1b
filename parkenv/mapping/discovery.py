"""Slots found without a map of them: where cars stand again and again (T §6)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.lot import ParkingLot

FloatArray = NDArray[np.float64]

_TURN_M = 3.0  # a quarter turn counts as so many metres when cars are compared


class FoundSlots(NamedTuple):
    """Slots that cars have shown.

    Attributes:
        xy: (n, 2) m, their middles.
        yaw: (n,) rad, along them, in [0, π).
        cars: (n,) int64, how many cars were seen there.
    """

    xy: FloatArray
    yaw: FloatArray
    cars: NDArray[np.int64]


class DiscoveryScore(NamedTuple):
    """Found slots against true ones.

    Attributes:
        precision: share of the found slots that are true ones.
        recall: share of the true slots that were found.
        error: m, mean distance of the matched.
        yaw_error: rad, mean.
    """

    precision: float
    recall: float
    error: float
    yaw_error: float


def discover(cars: FloatArray, *, reach: float = 0.8, least: int = 3) -> FoundSlots:
    """Cluster the poses of cars over many sessions: dense places are slots, single cars are not.

    DBSCAN (Ester et al. 1996) on position and direction; cars that stand a quarter turn apart count as 3 m apart, and
    nose-in and nose-out are the same. The middle of a cluster is the median of its cars.

    Args:
        cars: (n, 3) x, y in m and yaw in rad, world frame, of all sessions.
        reach: m, within which cars stand in the same slot.
        least: how many cars make a slot.

    Raises:
        InputError: a wrong shape or a number that is not finite.
    """
    from sklearn.cluster import DBSCAN

    if cars.ndim != 2 or cars.shape[1] != 3 or not np.isfinite(cars).all():
        raise InputError(f"cars have shape {cars.shape}, want finite (n, 3)")
    if not len(cars):
        return FoundSlots(np.empty((0, 2)), np.empty(0), np.empty(0, dtype=np.int64))
    # Twice the angle is the same for both ways round.
    turn = _TURN_M / 2.0 * np.stack([np.cos(2.0 * cars[:, 2]), np.sin(2.0 * cars[:, 2])], axis=1)
    label = DBSCAN(eps=reach, min_samples=least).fit_predict(np.column_stack([cars[:, :2], turn]))
    xy, yaw, count = [], [], []
    for k in range(label.max() + 1):
        these = cars[label == k]
        xy.append(np.median(these[:, :2], axis=0))
        yaw.append(0.5 * math.atan2(np.sin(2 * these[:, 2]).sum(), np.cos(2 * these[:, 2]).sum()) % math.pi)
        count.append(len(these))
    return FoundSlots(np.array(xy).reshape(-1, 2), np.array(yaw), np.array(count, dtype=np.int64))


def score_discovery(
    found: FoundSlots, lot: ParkingLot, *, within: float = 1.0, turned: float = math.radians(20.0)
) -> DiscoveryScore:
    """Match found slots to the lot's, one to one, the nearest pairs first.

    Args:
        found: from `discover`.
        lot: the truth.
        within: m, that a match may be off.
        turned: rad, that it may be turned.
    """
    away = np.hypot(*(found.xy[:, None] - lot.slot_xy[None]).transpose(2, 0, 1))
    turn = np.abs((found.yaw[:, None] - lot.slot_yaw[None] + math.pi / 2) % math.pi - math.pi / 2)
    pairs = np.argwhere((away <= within) & (turn <= turned))
    pairs = pairs[np.argsort(away[pairs[:, 0], pairs[:, 1]], kind="stable")]
    left, right = set(range(len(found.xy))), set(range(lot.n_slots))
    chosen = []
    for a, b in pairs.tolist():
        if a in left and b in right:
            left.remove(a)
            right.remove(b)
            chosen.append((a, b))
    rows, columns = (np.array(c, dtype=np.int64) for c in zip(*chosen, strict=True)) if chosen else (
        np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    )  # fmt: skip
    return DiscoveryScore(
        len(chosen) / max(len(found.xy), 1),
        len(chosen) / lot.n_slots,
        float(away[rows, columns].mean()) if chosen else math.nan,
        float(turn[rows, columns].mean()) if chosen else math.nan,
    )
