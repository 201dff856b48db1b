"""The scan by its definition: every beam against every segment, in float64. Slow; what the fast path is held to."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim_sensors.laser.footprints import NO_RETURN, WALL, ScanPlane
from sim_sensors.laser.scanner import LaserScanner


def scan(
    scanner: LaserScanner, plane: ScanPlane, pose: Sequence[float], *, exclude: int | None = None
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """An exact scan: the nearest crossing of each beam with an edge of a footprint or with a wall.

    Args:
        scanner: its beams and its range are used, its noise is not.
        plane: what stands there.
        pose: (3,) x, y (m) and yaw (rad) of the sensor in the world frame.
        exclude: id of footprints to look through.

    Returns:
        ranges: (n_beams,) float64, m, `inf` for no return, 0 if the sensor is inside a footprint.
        ids: (n_beams,) int64, the id hit, `WALL` or `NO_RETURN`.
    """
    origin, yaw = np.array(pose[:2], float), pose[2]
    corners, n_corners = plane.footprints
    starts, ends, labels = [], [], []
    for polygon, k, label in zip(corners, n_corners, plane.ids.tolist(), strict=True):
        if k == 0 or label == exclude:
            continue
        outline = polygon[:k]
        following = np.roll(outline, -1, 0)
        if (_cross(following - outline, origin - outline) >= 0).all():
            return np.zeros(scanner.n_beams), np.full(scanner.n_beams, label)
        starts.append(outline)
        ends.append(following)
        labels.append(np.full(k, label))
    starts.append(plane.walls[:, 0])
    ends.append(plane.walls[:, 1])
    labels.append(np.full(plane.n_walls, WALL))

    # origin + r d = start + t (end - start), solved for the range r and the part t of the segment.
    p = np.concatenate(starts) - origin
    e = np.concatenate(ends) - np.concatenate(starts)
    angle = yaw + scanner.angles
    d = np.column_stack([np.cos(angle), np.sin(angle)])[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        r = _cross(p, e) / _cross(d, e)
        t = _cross(p, d) / _cross(d, e)
    r = np.where((t >= 0) & (t <= 1) & (r > 0) & (r < scanner.max_range), r, np.inf)
    if r.shape[1] == 0:
        return np.full(scanner.n_beams, np.inf), np.full(scanner.n_beams, NO_RETURN)
    nearest = r.argmin(1)
    ranges = r[np.arange(scanner.n_beams), nearest]
    return ranges, np.where(np.isfinite(ranges), np.concatenate(labels)[nearest], NO_RETURN)


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
