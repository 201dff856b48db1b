"""Point clouds as scans of the obstacles above the road, with their heights, and the road's plane below the sensor."""

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from parkenv.compiled.arrays import BoolArray, Float32Array, FloatArray
from parkenv.errors import InputError
from sim_sensors.laser.scanner import LaserScanner

BAND_M = 0.3, 0.8  # m above the road, of the returns that make a scan
BAND_MIDDLE_M = 0.55
SCANNER = LaserScanner(900, -math.pi, math.radians(0.4), 40.0)
_MIN_RANGE_M = 0.5
_OVER_M, _HIGHEST_M = 1.0, 2.0  # what is so much nearer, and no higher, hides what is in the band
_TOP_M = 4.0  # what is higher hangs over the road
_TOP_DEPTH_M = 0.3, 1.2  # before and behind the range of a beam, of what may be the same obstacle
_ROAD_M = 2.5, 15.0, 3.0  # ahead or behind from, to, and aside: where the road is that the plane is fitted to
_ROAD_TOLERANCE_M = 0.08
_STEEPEST = 0.1
_LEAST_ROAD = 40  # returns
_LEAST_HEIGHT_M = 0.2  # of a sensor above the road
_UPSIDE_DOWN = 3  # times as many returns in a road above the sensor as in one below it
_FLOATS = {7: "f4", 8: "f8"}  # datatypes of `PointField`


class Road(NamedTuple):
    """The plane z = a·x + b·y + c of the road, m, in axes that are parallel to the vehicle's, origin at the sensor."""

    a: float
    b: float
    c: float

    @property
    def tilt(self) -> tuple[float, float]:
        """Roll (to the right) and pitch (upwards) of the vehicle against the road, rad."""
        return -math.atan(self.b), -math.atan(self.a)


class CloudScan(NamedTuple):
    ranges: Float32Array  # (n_beams,) m, of `SCANNER`; inf without a return, NaN where it is not known
    tops: Float32Array  # (n_beams,) m above the road; NaN without a return
    tilt: tuple[float, float]  # roll and pitch of the vehicle against the road, rad


def points_of(message: Any) -> Float32Array:
    """Return the points of a `PointCloud2`, (n, 3) m, sensor frame; returns that are not finite are left out."""
    if hasattr(message, "xyz"):
        points = np.asarray(message.xyz, dtype=np.float32)
    else:
        fields = {field.name: field for field in message.fields}
        size, height, width = int(message.point_step), int(message.height), int(message.width)
        order = ">" if message.is_bigendian else "<"
        try:
            kind = np.dtype({
                "names": list("xyz"), "formats": [order + _FLOATS[int(fields[n].datatype)] for n in "xyz"],
                "offsets": [int(fields[n].offset) for n in "xyz"], "itemsize": size,
            })  # fmt: skip
        except (KeyError, ValueError) as error:
            names = ", ".join(fields) or "none"
            raise InputError(
                f"a cloud has the fields {names}, want x, y and z of float32 or float64"
            ) from error
        data, row = bytes(message.data), int(message.row_step) or size * width
        if row < size * width or height * row > len(data):
            raise InputError(f"a cloud has {len(data):,} bytes for {width}×{height} points of {size} bytes")
        stored = np.ndarray((height, width), kind, data, strides=(row, size)).ravel()
        points = np.column_stack([stored[n] for n in "xyz"]).astype(np.float32)
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def fit_road(points: FloatArray | Float32Array) -> Road | None:
    """Fit the road's plane to points, (n, 3) m in the vehicle's axes around the sensor; None where there are too few.

    Of level planes through three points each (RANSAC) the one with most points and fewest below it, then least squares.
    """
    ahead, aside = np.abs(points[:, 0]), np.abs(points[:, 1])
    near = points[(ahead > _ROAD_M[0]) & (ahead < _ROAD_M[1]) & (aside < _ROAD_M[2])].astype(np.float64)
    if len(near) < _LEAST_ROAD:
        return None
    sample = near[:: max(1, len(near) // 1500)]
    corners = sample[np.random.default_rng(0).integers(len(sample), size=(250, 3))]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = -normal[:, :2] / normal[:, 2:]
    level = (np.abs(slope) < _STEEPEST).all(axis=1)
    slope, corner = slope[level].astype(np.float32), corners[level, 0].astype(np.float32)
    height = corner[:, 2] - (slope * corner[:, :2]).sum(axis=1)
    few = sample.astype(np.float32)
    above = few[:, 2] - slope @ few[:, :2].T - height[:, None]
    count = (np.abs(above) < _ROAD_TOLERANCE_M).sum(axis=1)
    # Nearly nothing is below a road, and nearly nothing above that of a sensor upside down.
    lower = np.where(height < -_LEAST_HEIGHT_M, count - (above < -2.0 * _ROAD_TOLERANCE_M).sum(axis=1), 0)
    upper = np.where(height > _LEAST_HEIGHT_M, count - (above > 2.0 * _ROAD_TOLERANCE_M).sum(axis=1), 0)
    if upper.max(initial=0) > _UPSIDE_DOWN * lower.max(initial=0) + _LEAST_ROAD:
        raise InputError(
            f"a cloud has the road {height[np.argmax(upper)]:.1f} m above its sensor; want one that stands upright, or "
            "`mount.roll = 180.0`"
        )
    if lower.max(initial=0) * len(near) < _LEAST_ROAD * len(few):
        return None
    best = int(np.argmax(lower))
    plane = np.array([*slope[best], height[best]], np.float64)
    terms = np.column_stack([near[:, :2], np.ones(len(near))])
    for _ in range(3):
        road = np.abs(near[:, 2] - terms @ plane) < _ROAD_TOLERANCE_M
        if road.sum() < 3:
            break
        part = terms[road]
        plane = np.linalg.lstsq(part.T @ part, part.T @ near[road, 2], rcond=None)[0]
    return Road(*plane.tolist())


def scan_of_cloud(points: FloatArray | Float32Array, road: Road) -> CloudScan:
    """Return in each direction around the vertical axis the nearest return in a band above the road, and its top."""
    normal = np.array([-road.a, -road.b, 1.0]) / math.sqrt(road.a**2 + road.b**2 + 1.0)
    to_level = Rotation.align_vectors([0.0, 0.0, 1.0], normal)[0].as_matrix().astype(np.float32)
    x, y, up = (points.astype(np.float32) @ to_level.T).T
    height = up - np.float32(road.c * normal[2])
    distance = np.hypot(x, y)
    kept = (height > BAND_M[0]) & (height < _TOP_M) & (distance >= _MIN_RANGE_M)
    kept &= distance < SCANNER.max_range
    x, y, height, distance = x[kept], y[kept], height[kept], distance[kept]
    n = SCANNER.n_beams
    beam = np.rint((np.arctan2(y, x) - SCANNER.start) / SCANNER.step).astype(np.int64) % n
    ranges = np.full(n, np.inf, np.float32)
    over = np.full(n, np.inf, np.float32)
    band: BoolArray = height <= BAND_M[1]
    np.minimum.at(ranges, beam[band], distance[band])
    np.minimum.at(over, beam[height <= _HIGHEST_M], distance[height <= _HIGHEST_M])
    tops = np.full(n, -np.inf, np.float32)
    for aside in (-1, 0, 1):
        other = (beam + aside) % n
        deeper = distance - ranges[other]
        same = (deeper >= -_TOP_DEPTH_M[0]) & (deeper <= _TOP_DEPTH_M[1])
        np.maximum.at(tops, other[same], height[same])
    tops[~np.isfinite(ranges)] = np.nan
    # Near the sensor its lowest layer is above the band: what stands there may be met only higher up.
    ranges[over + _OVER_M < ranges] = np.nan
    return CloudScan(ranges, tops, road.tilt)
