"""Laser scans of a recording, each read with the angles and limits that its message states."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from parkenv.compiled.arrays import Float32Array, FloatArray
from parkenv.errors import InputError
from sim_sensors.errors import SensorError
from sim_sensors.laser.scanner import LaserScanner

_TURN = 2.0 * math.pi
_STEP_TOLERANCE = 1e-4
_MOST_REPEATED = 2  # beams beyond a full turn, such as the last one where it equals the first


class Scan(NamedTuple):
    start: float  # rad, of the first beam
    step: float  # rad, above 0
    max_range: float  # m
    ranges: Float32Array  # (n,) m; inf without a hit
    delay: float = 0.0  # s between two beams; below 0 if the last one is the first in time


def scan_of(message: Any) -> Scan:
    """Return the scan of a `LaserScan`, counter-clockwise and within a turn.

    No hits are ranges that are not finite or 0, below `range_min`, and from `range_max` on. Beams beyond a full turn
    are left out if they repeat the first ones or have no hit.
    """
    ranges = np.array(message.ranges, dtype=np.float32)
    start, step = float(message.angle_min), float(message.angle_increment)
    low, high = float(message.range_min), float(message.range_max)
    if not (np.isfinite([start, step, low, high]).all() and step and high > 0.0 and len(ranges)):
        raise InputError(
            f"a scan of {len(ranges)} beams has angle_min {start:g}, angle_increment {step:g}, range_min {low:g} and "
            f"range_max {high:g}, want numbers, an increment other than 0 and a range_max above 0"
        )
    with np.errstate(invalid="ignore"):
        hit = (ranges > 0.0) & (ranges >= low) & (ranges < high)
    ranges = np.where(hit, ranges, np.float32(np.inf))
    most = math.floor(_TURN / abs(step) + 0.5)  # beams in a full turn, to half a beam
    beyond = ranges[most:]
    if len(beyond) > _MOST_REPEATED and np.isfinite(beyond).any():
        raise InputError(
            f"a scan has {len(ranges)} beams {abs(step):g} rad apart, want {most} at most, a full turn"
        )
    ranges = ranges[:most]
    delay = float(getattr(message, "time_increment", 0.0))
    if step < 0.0:
        delay = -delay
        start, step, ranges = start + (len(ranges) - 1) * step, -step, ranges[::-1]
    return Scan(start, step, high, np.ascontiguousarray(ranges), delay)


def mirrored(scan: Scan) -> Scan:
    """Return the scan of a scanner that hangs upside down, as one that stands upright measures it."""
    end = scan.start + (len(scan.ranges) - 1) * scan.step
    return scan._replace(start=-end, ranges=np.ascontiguousarray(scan.ranges[::-1]), delay=-scan.delay)


def without_motion(scan: Scan, moved: FloatArray) -> Scan:
    """Return the scan as measured from where the scanner was at its begin.

    `moved`, (n, 3), is where it was at each beam: x, y and yaw in its frame at the begin. Each beam takes the range of
    the return that is next in angle, at most a step away.
    """
    hit = np.isfinite(scan.ranges)
    if not hit.any():
        return scan
    beams = scan.start + scan.step * np.arange(len(scan.ranges))
    angle = beams[hit] + moved[hit, 2]
    x = moved[hit, 0] + scan.ranges[hit] * np.cos(angle)
    y = moved[hit, 1] + scan.ranges[hit] * np.sin(angle)
    middle = 0.5 * (beams[0] + beams[-1])
    place = (np.arctan2(y, x) - middle + math.pi) % _TURN + middle - math.pi
    off, near = cKDTree(place[:, None]).query(beams[:, None])
    ranges = np.where(off <= scan.step, np.hypot(x, y)[near], np.inf)
    return scan._replace(ranges=ranges.astype(np.float32))


def common_scanner(scans: Sequence[Scan]) -> tuple[LaserScanner, list[Float32Array]]:
    """Return a scanner for all scans, and the ranges of its beams in each: of the scan's own beam next in angle.

    Scans of equal angles stay as they are. Else the scanner has the finest step and all angles of any scan.
    """
    first = scans[0]
    start, step, n = first.start, first.step, len(first.ranges)
    shapes = {(scan.start, scan.step, len(scan.ranges)) for scan in scans}
    for _, other, _ in shapes:
        if abs(other - step) > _STEP_TOLERANCE * step:
            raise InputError(
                f"scans have beams {step:g} and {other:g} rad apart, want one angular resolution"
            )
    if len(shapes) > 1:
        step = min(step for _, step, _ in shapes)
        start = min(start for start, _, _ in shapes)
        end = max(start + (n - 1) * step for start, step, n in shapes)
        n = min(math.floor((end - start) / step + 1e-3) + 1, math.floor(_TURN / step + 0.5))
    try:
        scanner = LaserScanner(n, start, step, max(scan.max_range for scan in scans))
    except SensorError as error:
        raise InputError(str(error)) from error
    angles, ranges = scanner.angles, []
    for scan in scans:
        place = (angles - scan.start) % _TURN / scan.step
        beam = np.rint(place).astype(np.int64)
        beam[beam >= _TURN / scan.step - 0.5] = 0  # the end of a turn is its begin
        known = (beam < len(scan.ranges)) & (np.abs(place - np.rint(place)) * scan.step <= 0.5 * step + 1e-9)
        ranges.append(np.where(known, scan.ranges[np.where(known, beam, 0)], np.float32(np.inf)))
    return scanner, ranges
