"""What lies around the car at bumper height: a laser's scan, or the same made of a stereo pair."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from sim_sensors.camera.models import StereoCamera, StereoFrame
from sim_sensors.compilation import compiled
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.rig import Mount

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]

STEREO_REACH = 12.0
"""m; beyond, half a pixel of disparity is a metre."""
_NEAREST = 1.0  # m, that the matcher looks for
_BAND = (0.35, 1.1)  # m above ground: bumpers and doors, below the windows
_LEAST_PIXELS = 6


@dataclass(frozen=True, eq=False)
class Sweep:
    """Distances in many directions from one point.

    Args:
        x, y: m, of the point, world frame.
        angle: (k,) float64, rad, world frame, ascending: counter-clockwise.
        distance: (k,) float64, m; inf where nothing is met within reach, NaN where nothing is known.
        reach: m.
    """

    x: float
    y: float
    angle: FloatArray
    distance: FloatArray
    reach: float

    def points(self, beams: NDArray[np.int64]) -> FloatArray:
        """(k, 2) float64, m, world frame: where some beams end that do end."""
        angle, distance = self.angle[beams], self.distance[beams]
        return np.stack([self.x + distance * np.cos(angle), self.y + distance * np.sin(angle)], axis=1)


def laser_sweep(laser: LaserScanner, mount: Mount, vehicle: FloatArray, scan: Float32Array) -> Sweep:
    """A laser's scan as a sweep.

    Args:
        laser: that measured.
        mount: where it sits.
        vehicle: (3,) x, y, yaw, world frame: where the car takes itself to be.
        scan: (n_beams,) float32, m; inf where nothing was met.

    Raises:
        InputError: another number of beams, NaN, or a range below 0.
    """
    if scan.shape != (laser.n_beams,):
        raise InputError(f"scan has shape {scan.shape}, want ({laser.n_beams},)")
    if np.isnan(scan).any() or (scan < 0.0).any():
        bad = int(np.flatnonzero(np.isnan(scan) | (scan < 0.0))[0])
        raise InputError(f"scan[{bad}] is {scan[bad]} m, want at least 0, or inf where nothing was met")
    x, y, yaw = mount.in_world(vehicle)
    return Sweep(x, y, yaw + laser.angles.astype(np.float64), scan.astype(np.float64), laser.max_range)


def stereo_sweep(
    stereo: StereoCamera, mount: Mount, vehicle: FloatArray, disparity_px: Float32Array, columns: int = 2
) -> Sweep:
    """The nearest thing at bumper height in every few columns of a disparity image.

    A direction in which the ground is seen farther than anything stands is free as far; one without matches is unknown.

    Args:
        stereo: that took the pair.
        mount: where its left camera sits; level.
        vehicle: (3,) x, y, yaw, world frame.
        disparity_px: (h, w) float32, NaN where nothing matches; see `disparity`.
        columns: how many columns share a direction.
    """
    camera = stereo.camera
    x, y, yaw = mount.in_world(vehicle)
    depth = _column_depths(
        disparity_px,
        columns,
        camera.fx * stereo.baseline,
        camera.fy,
        camera.cy,
        mount.z,
        *_BAND,
        STEREO_REACH,
    )
    middle = columns * (np.arange(len(depth)) + 0.5) - camera.cx
    aside = np.arctan2(middle, camera.fx)
    distance = depth / np.cos(aside)
    return Sweep(x, y, (yaw - aside)[::-1], distance[::-1], STEREO_REACH)


def disparity(pair: StereoFrame, stereo: StereoCamera, nearest: float = _NEAREST) -> Float32Array:
    """Disparity, (h, w) float32 px, by OpenCV's semi-global matching; NaN where it finds no match.

    Args:
        pair: rectified.
        stereo: that took it.
        nearest: m, of what is looked for.
    """
    most = 16 * math.ceil(stereo.camera.fx * stereo.baseline / nearest / 16)
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
    # The matcher does not look within `most` px of the left border: carry the border on, and cut it off again.
    left, right = (cv2.copyMakeBorder(i, 0, 0, most, 0, cv2.BORDER_REPLICATE) for i in (left, right))
    found = matcher.compute(left, right)[:, most:].astype(np.float32) / 16.0
    return np.where(found > 0.0, found, np.nan).astype(np.float32)


@compiled
def _column_depths(
    disparity_px: Float32Array,
    columns: int,
    focal_baseline: float,
    fy: float,
    cy: float,
    height: float,
    low: float,
    high: float,
    reach: float,
) -> FloatArray:
    rows, width = disparity_px.shape
    out = np.full(width // columns, np.nan)
    found = np.empty(rows * columns)
    for c in range(len(out)):
        standing = 0
        ground = 0.0
        for v in range(rows):
            down = (v + 0.5 - cy) / fy
            for u in range(c * columns, (c + 1) * columns):
                d = disparity_px[v, u]
                if not d > 0.0:
                    continue
                z = focal_baseline / d
                level = height - down * z
                if low <= level <= high and z <= reach:
                    found[standing] = z
                    standing += 1
                elif abs(level) < 0.15 and z <= reach:
                    ground = max(ground, z)
        if standing >= _LEAST_PIXELS:
            out[c] = np.sort(found[:standing])[standing // 4]
        elif ground > 0.0:
            # Free as far as its ground is seen; what stands farther away is not known.
            out[c] = np.inf if ground > 0.8 * reach else np.nan
    return out
