"""Goals of `parkenv/Drive-v1`: goal errors, and when a car counts as parked."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled
from parkenv.driving.parking_task import ParkingTask

POSITION_TOLERANCE = 0.25  # largest distance, m, of a parked car's centre from the goal
ANGLE_TOLERANCE = math.radians(5.0)  # largest angle, rad, between a parked car's yaw and the goal's
STANDING = 0.05  # speed, m/s, up to which a car counts as standing


def goal_errors(
    achieved: NDArray[np.float32], desired: NDArray[np.float32], half: FloatArray
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Errors of n achieved goals.

    Args:
        achieved: (n, 7) float32; see `DriveEnv`.
        desired: (n, 7) float32.
        half: (2,) half the car's length and width, m.

    Returns:
        (n,) distance, m; (n,) angle, rad; (n,) bool, parked.
    """
    errors = np.array([goal_error(a, d, half) for a, d in zip(achieved, desired, strict=True)]).reshape(-1, 3)
    return errors[:, 0], errors[:, 1], errors[:, 2] > 0.5


def goal_of(task: ParkingTask) -> NDArray[np.float32]:
    """Return the desired goal of a task, (7,) float32; see `DriveEnv`."""
    turned = float(task.target[2] - task.slot[2])
    still = [0.0, 0.0, round(math.cos(turned), 9), round(math.sin(turned), 9), 0.0, *task.room.tolist()]
    return np.array(still, dtype=np.float32)


@compiled(error_model="numpy")
def goal_error(
    achieved: NDArray[np.float32], desired: NDArray[np.float32], half: FloatArray
) -> tuple[float, float, float]:
    """Distance, m, angle, rad, and 1.0 if parked else 0.0, of one achieved goal."""
    dx, dy = float(achieved[0]) - float(desired[0]), float(achieved[1]) - float(desired[1])
    c, s = float(desired[2]), float(desired[3])
    cosine = float(achieved[2]) * c + float(achieved[3]) * s
    sine = float(achieved[3]) * c - float(achieved[2]) * s
    ahead, aside = abs(c * dx + s * dy), abs(c * dy - s * dx)
    distance, angle = math.hypot(dx, dy), abs(math.atan2(sine, cosine))
    long = half[0] * math.cos(angle) + half[1] * math.sin(angle)
    wide = half[0] * math.sin(angle) + half[1] * math.cos(angle)
    inside = ahead + long <= half[0] + float(desired[5]) and aside + wide <= half[1] + float(desired[6])
    near = distance <= POSITION_TOLERANCE and angle <= ANGLE_TOLERANCE
    stands = abs(float(achieved[4]) - float(desired[4])) <= STANDING
    return distance, angle, 1.0 if (near and inside and stands) else 0.0
