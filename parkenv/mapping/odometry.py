"""Localisation errors of the car: odometry that drifts, and the wandering error of a fused estimate (T §3.3)."""

import math
from dataclasses import dataclass

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, require_number

DRIFT_M = 100.0  # distance straight ahead, m, after which the error of drifting odometry is stated
MOST_DRIFT = 0.5


@dataclass(frozen=True)
class PoseNoise:
    """Errors of the estimated pose.

    `position` and `heading` are of a fused estimate: Ornstein-Uhlenbeck processes over the distance driven, as a filter
    follows its odometry from metre to metre and its satellite fixes from minute to minute.

    `drift` is of odometry alone, which nothing corrects: the root mean square of the error of position after 100 m
    straight ahead, as a share of the distance. A third of its variance each is a wrong scale, a heading that turns
    evenly, and one that wanders; scale and turn are drawn once for a drive. The first pose is right.
    """

    position: float = 0.0  # m, stationary standard deviation of each coordinate
    heading: float = 0.0  # rad, stationary standard deviation
    length: float = 30.0  # m driven, over which the autocorrelation falls to 1/e
    drift: float = 0.0  # share of the distance driven

    def __post_init__(self) -> None:
        for name in ("position", "heading", "drift"):
            require_number(name, getattr(self, name), least=0.0)
        require_number("length", self.length, above=0.0, finite=False)
        if self.drift > MOST_DRIFT:
            raise InputError(f"drift is {self.drift}, want at most {MOST_DRIFT}; 0.02 is 2 % of the distance")

    def estimated(self, poses: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return estimated poses, (n, 3), for true poses along a path, (n, 3) x, y in m and yaw in rad."""
        if self.drift > 0.0:
            poses = _drifting(poses, self.drift, rng)
        scale = np.array([self.position, self.position, self.heading])
        step = np.hypot(*np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2]).T)
        correlation = np.exp(-step / self.length)
        error = np.empty((len(poses), 3))
        now = rng.normal(size=3)
        for i, keep in enumerate(correlation.tolist()):
            error[i] = now = keep * now + math.sqrt(max(0.0, 1.0 - keep * keep)) * rng.normal(size=3)
        return np.asarray(poses + scale * error)


def between(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return other poses, (..., 3), in the frame of one, (3,): forward, left, m, and turn, rad."""
    c, s = math.cos(start[2]), math.sin(start[2])
    x, y, turn = np.moveaxis(end - start, -1, 0)
    return np.stack([c * x + s * y, c * y - s * x, (turn + math.pi) % (2.0 * math.pi) - math.pi], axis=-1)


def moved(start: FloatArray, motion: FloatArray) -> FloatArray:
    """Return the pose, (3,), after a motion as `between` returns it."""
    forward, left, turn = motion
    c, s = math.cos(start[2]), math.sin(start[2])
    return np.array([start[0] + c * forward - s * left, start[1] + s * forward + c * left, start[2] + turn])


def _drifting(poses: FloatArray, drift: float, rng: np.random.Generator) -> FloatArray:
    part = drift / math.sqrt(3.0)
    scale = 1.0 + part * rng.normal()
    bend = 2.0 * part / DRIFT_M * rng.normal()  # rad/m; times half the squared distance it is the error
    wander = drift / math.sqrt(DRIFT_M) * rng.normal(size=len(poses))  # rad per square root of a metre
    out = np.array(poses, dtype=np.float64)
    for i in range(1, len(poses)):
        forward, left, turn = between(poses[i - 1], poses[i])
        step = math.hypot(forward, left)
        off = bend * step + math.sqrt(step) * wander[i]
        # The heading errs evenly along the step.
        c, s = math.cos(0.5 * off), math.sin(0.5 * off)
        motion = np.array([scale * (c * forward - s * left), scale * (s * forward + c * left), turn + off])
        out[i] = moved(out[i - 1], motion)
    return out
