"""Ranges around the car at bumper height: from a laser scanner, or from the disparities of a stereo pair."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array, FloatArray
from parkenv.compiled.jit import compiled
from parkenv.errors import InputError
from sim_sensors.camera.models import StereoCamera, StereoFrame
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.rig import Mount

# Least and largest range of stereo measurements, m: between them, half a pixel of disparity corresponds to 1 m.
STEREO_RANGE = 12.0, 25.0
_NEAREST = 1.0  # m, the shortest depth that the matcher searches
_BAND = (0.35, 1.1)  # m above ground: bumpers and doors, below the windows
_LEAST_PIXELS = 6
_COLUMNS = 2  # of an image that share a direction
_SAME_POINT = 1e-6  # m
_NEIGHBOURS = 40  # beams to either side that may hide one, from a point near by


@dataclass(frozen=True, eq=False)
class RangeScan:
    """Ranges in many directions from one point.

    Args:
        x, y: m, position of the sensor, world frame.
        angle: (k,) float64, rad, world frame, ascending (counter-clockwise).
        distance: (k,) float64, m; inf if the beam hits nothing within `max_range`, NaN if the range is unknown.
        max_range: m.
        tops: (k,) float64, m, height above the ground of the highest return of what a beam meets, NaN where it is not
            known; None: of no beam.
    """

    x: float
    y: float
    angle: FloatArray
    distance: FloatArray
    max_range: float
    tops: FloatArray | None = None

    def points(self, beams: NDArray[np.int64]) -> FloatArray:
        """Return the end points of beams with a finite range, (k, 2) float64, m, world frame."""
        angle, distance = self.angle[beams], self.distance[beams]
        return np.stack([self.x + distance * np.cos(angle), self.y + distance * np.sin(angle)], axis=1)

    def seen_from(self, x: float, y: float) -> RangeScan:
        """Return the scan as it looks from another point near by, m: what hides there behind something is left out."""
        if math.hypot(x - self.x, y - self.y) < _SAME_POINT:
            return self
        met = np.isfinite(self.distance)
        away = self.points(np.flatnonzero(met)) - [x, y]
        angle, distance = self.angle.copy(), self.distance.copy()
        distance[met] = np.hypot(*away.T)
        turn = np.arctan2(away[:, 1], away[:, 0]) - angle[met]
        angle[met] += (turn + math.pi) % (2.0 * math.pi) - math.pi
        kept = np.flatnonzero(~_hidden_beams(angle, distance))
        kept = kept[np.argsort(angle[kept], kind="stable")]
        tops = None if self.tops is None else self.tops[kept]
        return RangeScan(x, y, angle[kept], distance[kept], self.max_range, tops)

    def placed(self, vehicle: FloatArray) -> RangeScan:
        x, y, yaw = Mount(self.x, self.y).in_world(vehicle)
        return dataclasses.replace(self, x=x, y=y, angle=self.angle + yaw)


def scan_from_laser(
    laser: LaserScanner,
    mount: Mount,
    vehicle: FloatArray,
    ranges: Float32Array,
    tops: Float32Array | None = None,
) -> RangeScan:
    """Convert the ranges of a laser scanner, (n_beams,) m, inf without a return, to the world frame; see `Capture`."""
    if ranges.shape != (laser.n_beams,):
        raise InputError(f"scan has shape {ranges.shape}, want ({laser.n_beams},)")
    if (ranges < 0.0).any():
        bad = int(np.flatnonzero(ranges < 0.0)[0])
        raise InputError(f"scan[{bad}] is {ranges[bad]} m, want at least 0, inf for no return, or NaN")
    x, y, yaw = mount.in_world(vehicle)
    angles, distance = yaw + laser.angles.astype(np.float64), ranges.astype(np.float64)
    return RangeScan(
        x, y, angles, distance, laser.max_range, None if tops is None else tops.astype(np.float64)
    )


def scan_from_stereo(
    stereo: StereoCamera, mount: Mount, vehicle: FloatArray, disparity_px: Float32Array
) -> RangeScan:
    """Find the nearest obstacle at bumper height in every few columns of a disparity image.

    A direction in which only ground is visible is free, one without matches unknown. The camera has no pitch.
    """
    camera = stereo.camera
    x, y, yaw = mount.in_world(vehicle)
    focal_baseline = camera.fx * stereo.baseline
    reach = min(max(STEREO_RANGE[0], math.sqrt(2.0 * focal_baseline)), STEREO_RANGE[1])
    depth = _column_depths(disparity_px, focal_baseline, camera.fy, camera.cy, mount.z, *_BAND, reach)
    aside = np.arctan2(_COLUMNS * (np.arange(len(depth)) + 0.5) - camera.cx, camera.fx)
    return RangeScan(x, y, (yaw - aside)[::-1], (depth / np.cos(aside))[::-1], reach)


def disparity(pair: StereoFrame, stereo: StereoCamera) -> Float32Array:
    """Compute the disparity, (h, w) float32 px, by OpenCV's semi-global matching; NaN where it finds no match."""
    most = 16 * math.ceil(stereo.camera.fx * stereo.baseline / _NEAREST / 16)
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=most,
        blockSize=5,
        P1=8 * 25,
        P2=32 * 25,
        disp12MaxDiff=1,
        uniquenessRatio=5,
        speckleWindowSize=80,
        speckleRange=2,
    )
    left, right = (cv2.cvtColor(f.image, cv2.COLOR_RGB2GRAY) for f in (pair.left, pair.right))
    # The matcher skips `most` px at the left border: pad the images there, and cut the padding off again.
    left, right = (cv2.copyMakeBorder(i, 0, 0, most, 0, cv2.BORDER_REPLICATE) for i in (left, right))
    px = matcher.compute(left, right)[:, most:].astype(np.float32) / 16.0
    return np.where(px > 0.0, px, np.nan).astype(np.float32)


@compiled
def _hidden_beams(angle: FloatArray, distance: FloatArray) -> NDArray[np.bool_]:
    """Return which beams something nearer hides: those beside which the order of directions has turned round."""
    hidden = np.zeros(len(angle), dtype=np.bool_)
    for i in range(len(angle)):
        for j in range(i + 1, min(i + 1 + _NEIGHBOURS, len(angle))):
            if angle[j] < angle[i]:
                hidden[i if distance[i] > distance[j] else j] = True
    return hidden


@compiled
def _column_depths(
    disparity_px: Float32Array,
    focal_baseline: float,
    fy: float,
    cy: float,
    height: float,
    low: float,
    high: float,
    max_range: float,
) -> FloatArray:
    rows, width = disparity_px.shape
    out = np.full(width // _COLUMNS, np.nan)
    depths = np.empty(rows * _COLUMNS)
    for c in range(len(out)):
        obstacle = 0
        ground = 0.0
        for v in range(rows):
            down = (v + 0.5 - cy) / fy
            for u in range(c * _COLUMNS, (c + 1) * _COLUMNS):
                d = disparity_px[v, u]
                if not d > 0.0:
                    continue
                z = focal_baseline / d
                level = height - down * z
                if low <= level <= high and z <= max_range:
                    depths[obstacle] = z
                    obstacle += 1
                elif abs(level) < 0.15 and z <= max_range:
                    ground = max(ground, z)
        if obstacle >= _LEAST_PIXELS:
            out[c] = np.sort(depths[:obstacle])[obstacle // 4]
        elif ground > 0.0:
            # Free if the ground is visible nearly to the maximum range; otherwise unknown.
            out[c] = np.inf if ground > 0.8 * max_range else np.nan
    return out
