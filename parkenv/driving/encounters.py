"""Who will be in a car's way: what its driver foresees of those who move."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from parkenv.driving.vehicle import VehicleParameters

FloatArray = NDArray[np.float64]

WATCHED_S = np.array([0.0, 0.4, 0.8, 1.2, 1.6, 2.0])
"""How far ahead, s, the driver looks for others on its way."""
KEPT_M, KEPT_STANDING_M = 0.5, 0.05
"""m that the driver keeps from others who move, and from those who have stopped to wait for it."""
MOVES = 0.1
"""m/s above which somebody moves."""
SLOWEST = 0.7
"""m/s at which a car that stands is taken to set off."""

_NEAR_M = 20.0


def in_frame(poses: FloatArray, points: FloatArray) -> FloatArray:
    """Points, (..., k, 2) m, as they lie before a car at poses, (..., 3) m and rad: forward and left of it."""
    c, s = np.cos(poses[..., 2, None]), np.sin(poses[..., 2, None])
    offset = points - poses[..., None, :2]
    return np.stack([c * offset[..., 0] + s * offset[..., 1], c * offset[..., 1] - s * offset[..., 0]], -1)


def encounters(
    vehicle: VehicleParameters, own: FloatArray, outlines: Sequence[FloatArray], velocity: FloatArray
) -> FloatArray:
    """When each of those about comes too near to the car, if all go on as now.

    Args:
        vehicle: the car.
        own: (6, 3) x, y in m and yaw in rad, where its middle will be after `WATCHED_S`.
        outlines: of each of the others, (k, 2) m, now.
        velocity: (n, 2) m/s, of each.

    Returns:
        (n,) s, of `WATCHED_S`; infinity where it is not soon.
    """
    when = np.full(len(outlines), np.inf)
    half = 0.5 * np.array([vehicle.length, vehicle.width])
    for i, outline in enumerate(outlines):
        if np.hypot(*(outline.mean(axis=0) - own[0, :2])) >= _NEAR_M:
            continue
        # Whoever overlaps the car's box, grown by what is to be kept.
        local = in_frame(own, outline + WATCHED_S[:, None, None] * velocity[i])
        margin = half + (KEPT_M if np.hypot(*velocity[i]) > MOVES else KEPT_STANDING_M)
        meets = ((local.min(axis=1) < margin) & (local.max(axis=1) > -margin)).all(axis=1)
        if meets.any():
            when[i] = WATCHED_S[meets.argmax()]
    return when
