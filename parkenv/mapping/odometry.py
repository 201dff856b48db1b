"""Localisation errors of the car: drifting odometry corrected by satellite fixes (T §3.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class PoseNoise:
    """Errors of the estimated pose.

    The errors of position and heading are Ornstein-Uhlenbeck processes over the distance driven: a fused filter
    follows its odometry from metre to metre and its fixes from minute to minute.

    Raises:
        InputError: a number below 0, or a length of 0.
    """

    position: float = 0.0  # m, stationary standard deviation of each coordinate
    heading: float = 0.0  # rad, stationary standard deviation
    length: float = 30.0  # m driven, over which the autocorrelation falls to 1/e

    def __post_init__(self) -> None:
        for name in ("position", "heading"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise InputError(f"{name} is {getattr(self, name)}, want a finite number of at least 0")
        if not self.length > 0.0:
            raise InputError(f"length is {self.length} m, want above 0")

    def estimated(self, poses: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return estimated poses, (n, 3), for true poses along a path, (n, 3) x, y in m and yaw in rad."""
        scale = np.array([self.position, self.position, self.heading])
        step = np.hypot(*np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2]).T)
        kept = np.exp(-step / self.length)
        error = np.empty((len(poses), 3))
        now = rng.normal(size=3)
        for i, keep in enumerate(kept.tolist()):
            now = keep * now + math.sqrt(max(0.0, 1.0 - keep * keep)) * rng.normal(size=3)
            error[i] = now
        return np.asarray(poses + scale * error)
