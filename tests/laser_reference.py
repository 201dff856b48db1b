"""The scan by its definition: every beam against every segment, in float64. Slow; what the fast path is held to."""

import numpy as np

from sim_sensors.laser.footprints import NO_RETURN, WALL


def scan(scanner, plane, pose):
    """Ranges, m, without noise and ids: the nearest crossing of each beam with an edge of a footprint or a wall.

    The range is `inf` for no return, and 0 if the sensor is inside a footprint.
    """
    origin, yaw = np.array(pose[:2], float), pose[2]
    corners, n_corners = plane.footprints
    starts, ends, labels = [], [], []
    for polygon, k, label in zip(corners, n_corners, plane.ids.tolist(), strict=True):
        if k == 0:
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
    e, angle = np.concatenate(ends) - np.concatenate(starts), yaw + scanner.angles
    d = np.column_stack([np.cos(angle), np.sin(angle)])[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        r, t = _cross(p, e) / _cross(d, e), _cross(p, d) / _cross(d, e)
    r = np.where((t >= 0) & (t <= 1) & (r > 0) & (r < scanner.max_range), r, np.inf)
    if r.shape[1] == 0:
        return np.full(scanner.n_beams, np.inf), np.full(scanner.n_beams, NO_RETURN)
    nearest = r.argmin(1)
    ranges = r[np.arange(scanner.n_beams), nearest]
    return ranges, np.where(np.isfinite(ranges), np.concatenate(labels)[nearest], NO_RETURN)


def _cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
