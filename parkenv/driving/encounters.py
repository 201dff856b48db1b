"""Predict encounters of a car with moving road users, at constant velocity."""

from __future__ import annotations

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.driving.vehicle import VehicleParameters

PREDICTION_TIMES_S = np.array([0.0, 0.4, 0.8, 1.2, 1.6, 2.0])
"""Times, s from now, at which positions are predicted."""
MOVING_CLEARANCE_M, STANDING_CLEARANCE_M = 0.5, 0.05
"""Clearance, m, to road users that move, and to those that stand and wait."""
MOVES = 0.1  # speed, m/s, above which a road user counts as moving
START_SPEED = 0.7  # speed, m/s, at which a standing car is assumed to start

_NEAR_M = 20.0


def to_car_frame(poses: FloatArray, points: FloatArray) -> FloatArray:
    """Transform points, (..., k, 2) m, into the frame of a car at poses, (..., 3) m and rad: forward and left."""
    c, s = np.cos(poses[..., 2, None]), np.sin(poses[..., 2, None])
    offset = points - poses[..., None, :2]
    return np.stack([c * offset[..., 0] + s * offset[..., 1], c * offset[..., 1] - s * offset[..., 0]], -1)


def encounter_times(
    vehicle: VehicleParameters, own: FloatArray, outlines: FloatArray, velocity: FloatArray
) -> FloatArray:
    """Return the time until each road user comes too close to the car, at constant velocity.

    Args:
        vehicle: the car.
        own: (6, 3) x, y in m and yaw in rad of its middle after `PREDICTION_TIMES_S`.
        outlines: (n, k, 2) m, current outline of each road user; shorter ones repeat their last corner.
        velocity: (n, 2) velocity of each road user, m/s.

    Returns:
        (n,) s, one of `PREDICTION_TIMES_S`; infinity for road users that stay far enough away.
    """
    when = np.full(len(outlines), np.inf)
    near = np.hypot(*(outlines.mean(axis=1) - own[0, :2]).T) < _NEAR_M
    # Overlap with the car's box, enlarged by the clearance; (n, 6, k, 2).
    moved = PREDICTION_TIMES_S[:, None, None] * velocity[near, None, None]
    local = to_car_frame(own, outlines[near, None] + moved)
    moves = np.hypot(*velocity[near].T) > MOVES
    clearance = np.where(moves, MOVING_CLEARANCE_M, STANDING_CLEARANCE_M)
    margin = 0.5 * np.array([vehicle.length, vehicle.width]) + clearance[:, None, None]
    meets = ((local.min(axis=2) < margin) & (local.max(axis=2) > -margin)).all(axis=2)
    when[near] = np.where(meets.any(axis=1), PREDICTION_TIMES_S[meets.argmax(axis=1)], np.inf)
    return when
