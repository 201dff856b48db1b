"""Distance and pose of detected cars (T §3.2.3).

The thesis takes the median of the ranges within a detection's box and places the car directly behind that point:
`localize_median` with a laser, `localize_disparity` with a stereo camera. They are kept for comparison.
`localize_cars` is more accurate, with the `RangeScan` of either sensor: it separates the beams that end on the car
from those that pass it or end on a neighbour, and fits a rectangle to them, so that the estimated heading does not
depend on the viewpoint (T §4.2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import Float32Array, FloatArray
from parkenv.errors import InputError
from parkenv.perception.box_fit import CAR_LENGTH, CAR_WIDTH, LONG_SIDE, direction_of, fit_box
from parkenv.perception.range_scan import RangeScan
from sim_sensors.camera.models import PinholeCamera, StereoCamera
from sim_sensors.rig import Mount

if TYPE_CHECKING:
    from parkenv.perception.detector import Detections


LONGEST, WIDEST = 5.5, 2.4  # m; what is longer is a wall or a hedge
GAP = 0.5  # m; neighbouring beams whose end points are farther apart belong to different objects
WHOLE_END = 1.2  # m; a visible edge of this length is the front or rear of a car, not a part of its side
OFF_GROUND = 0.7  # m; tolerance of the height of a box's lower edge above or below the ground
CAR_HEIGHT = (0.8, 3.2)  # m; range of the height of a box's upper edge
_LEAST_BEAMS = 3
# Least height of what beams meet, as a fraction of its box's, and how much higher it may be, m.
_TOPS = 0.45, 0.6
MARGIN = 0.02  # of a picture's size; boxes that come this close to its border count as clipped by it
_EXPLAINED = 0.5  # fraction of a box's beams from which they belong to the nearer car of another box


@dataclass(frozen=True, eq=False)
class LocatedCars:
    xy: FloatArray  # (n, 2) float64, m, centres, world frame
    yaw: FloatArray  # (n,) float64, rad, along the car, in [0, π): front and rear are not distinguished
    size: FloatArray  # (n, 2) float64, m, length and width
    distance: FloatArray  # (n,) float64, m, from the sensor to the visible surface of the car
    probability: Float32Array  # (n,) float32, of the detection
    # (n,) int64, index of the detection of each car; detections that could not be located have no row
    detection: NDArray[np.int64]
    # of cars whose place is uncertain, from one picture; None where a sensor has measured the distance
    distance_std: FloatArray | None = None  # (n,) float64, m, standard deviation of the distance
    covariance: FloatArray | None = None  # (n, 2, 2) float64, m², of the centres
    points: tuple[
        FloatArray, ...
    ] = ()  # (k, 2) m, end points of the beams, of cars that a sensor has measured

    def __post_init__(self) -> None:
        n = len(self.yaw)
        shapes: dict[str, tuple[int, ...]] = {"xy": (n, 2), "size": (n, 2)} | dict.fromkeys(
            ("yaw", "distance", "probability", "detection"), (n,)
        )
        if self.covariance is not None:
            shapes |= {"distance_std": (n,), "covariance": (n, 2, 2)}
        for name, want in shapes.items():
            value = getattr(self, name)
            if value.shape != want or not np.isfinite(value).all():
                raise InputError(f"{name} of located cars is {value.shape}, want {want} finite numbers")

    def __len__(self) -> int:
        return len(self.yaw)

    @classmethod
    def none(cls) -> LocatedCars:
        return cls(
            np.empty((0, 2)), np.empty(0), np.empty((0, 2)), np.empty(0), np.empty(0, dtype=np.float32),
            np.empty(0, dtype=np.int64),
        )  # fmt: skip

    @property
    def poses(self) -> FloatArray:
        return np.column_stack([self.xy, self.yaw])


def bearings(camera: PinholeCamera, mount: Mount, vehicle: FloatArray, boxes: Float32Array) -> FloatArray:
    """Return the world directions, (n, 2) rad, of the left and right edges of boxes (β in eq. 3.2)."""
    _, _, yaw = mount.in_world(vehicle)
    columns = np.clip(boxes[:, [0, 2]], 0.0, camera.width)
    return np.asarray(yaw - np.arctan2(columns - camera.cx, camera.fx))


def beams_between(scan: RangeScan, left: float, right: float) -> NDArray[np.int64]:
    """Return the beams between two world directions, rad, the left one first (eq. 3.2)."""
    middle, half = 0.5 * (left + right), 0.5 * (left - right)
    return np.flatnonzero(np.abs(_wrapped(scan.angle - middle)) < half)


def median_distance(scan: RangeScan, beams: NDArray[np.int64]) -> float:
    """Return the thesis's distance: the median range of the beams with a return; NaN if there is none."""
    met = scan.distance[beams]
    met = met[np.isfinite(met)]
    return float(np.median(met)) if len(met) else math.nan


class CarBeams(NamedTuple):
    beams: NDArray[np.int64]  # (k,) int64, counter-clockwise; empty if none ends on a car
    # whether the car extends beyond the first and beyond the last of them, where it is occluded or outside the
    # sensor's field of view
    cut: tuple[bool, bool]
    run: NDArray[np.int64]  # (m,) int64, these and those beside the box that go on without a gap


def car_beams(
    scan: RangeScan, beams: NDArray[np.int64], clipped: tuple[bool, bool] = (False, False)
) -> CarBeams:
    """Select the beams of a box that end on its car: the run of end points that best fills the middle of the box.

    Neighbouring beams whose end points are more than `GAP` apart hit different objects: a car and its background, or an
    obstacle in front of it. Beams near the middle of the box weigh more, because other objects fill its margins.

    Beams come counter-clockwise. Where the image border clips the box before its first or after its last beam, the
    laser still sees the car where the camera does not, and the run continues beyond the box.
    """
    met = np.flatnonzero(np.isfinite(scan.distance))
    inside = np.flatnonzero(np.isin(met, beams))
    if len(inside) < _LEAST_BEAMS:
        return CarBeams(met[:0], (False, False), met[:0])
    step = np.diff(scan.points(met), axis=0)
    run = np.r_[0, np.cumsum(np.hypot(step[:, 0], step[:, 1]) > GAP)]
    off = np.abs(_wrapped(scan.angle[met[inside]] - 0.5 * (scan.angle[beams[0]] + scan.angle[beams[-1]])))
    weight = np.bincount(run[inside], 1.0 - off / (off.max() + 1e-9))
    ends = np.flatnonzero(run == weight.argmax())
    # Boxes are not exact: a run that ends a little outside the box is still the car, and its end is visible.
    slack = 2 + len(inside) // 10
    goes_on = (clipped[0] or ends[0] >= inside[0] - slack, clipped[1] or ends[-1] <= inside[-1] + slack)
    first = ends[0] if goes_on[0] else inside[0]
    last = ends[-1] if goes_on[1] else inside[-1]
    if last - first + 1 < _LEAST_BEAMS:
        return CarBeams(met[:0], (False, False), met[:0])
    cut = (
        goes_on[0] and _hidden(scan.distance[: met[first] + 1][::-1]),
        goes_on[1] and _hidden(scan.distance[met[last] :]),
    )
    return CarBeams(met[first : last + 1], cut, met[ends])


def median_depth(disparity_px: Float32Array, box: Float32Array, stereo: StereoCamera) -> float:
    """Return the thesis's depth of a box, m: the median of fB/d in it (eq. 3.1); NaN if nothing matches."""
    left, top, right, bottom = box.astype(np.float64)
    rows, columns = disparity_px.shape
    u = np.clip(np.round([left, right]), 0, columns).astype(int)
    v = np.clip(np.round([top, bottom]), 0, rows).astype(int)
    matches = disparity_px[v[0] : v[1], u[0] : u[1]]
    matches = matches[np.isfinite(matches)]
    if not len(matches):
        return math.nan
    return float(np.median(np.asarray(stereo.camera.fx * stereo.baseline / matches, dtype=np.float64)))


def localize_cars(
    detections: Detections, scan: RangeScan, camera: PinholeCamera, mount: Mount, vehicle: FloatArray
) -> LocatedCars:
    """Locate the detected cars: fit a car's rectangle to the `car_beams` of each box.

    The following detections are dropped: those without an obstacle at bumper height; those that, at its distance, would
    not be on the ground, or not have a car's height or the obstacle's, where a point cloud tells it; those whose beams
    end on the nearer car of another box, which hides them, or is the same; and cars too hidden to estimate their
    orientation, with neither a side nor an end visible, or only a part of one at the image border. Later captures show
    them better.
    """
    scan = scan.seen_from(*mount.in_world(vehicle)[:2])
    rows, cars, distances, points = [], [], [], []
    margins = bearings(camera, mount, vehicle, detections.boxes)
    explained = np.zeros(len(scan.angle), dtype=np.bool_)  # beams that end on the car of another box
    # On the ground, nearer cars reach further down in the image.
    for i in np.argsort(-detections.boxes[:, 3], kind="stable").tolist():
        left, right = margins[i]
        # Counter-clockwise, the box's right margin comes first.
        clipped = (
            bool(detections.boxes[i, 2] >= (1.0 - MARGIN) * camera.width),
            bool(detections.boxes[i, 0] <= MARGIN * camera.width),
        )
        beams, cut, run = car_beams(scan, beams_between(scan, left, right), clipped)
        if not len(beams) or explained[beams].mean() >= _EXPLAINED:
            continue
        low, high = _heights(detections.boxes[i], float(np.median(scan.distance[beams])), camera, mount)
        at_margin = detections.boxes[i, 3] >= (1.0 - MARGIN) * camera.height
        if not (at_margin or abs(low) <= OFF_GROUND) or not CAR_HEIGHT[0] <= high <= CAR_HEIGHT[1]:
            continue
        if scan.tops is not None and not _is_as_high(scan.tops[beams], high):
            continue
        ends = scan.points(beams)
        car = fit_box(ends, np.array([scan.x, scan.y]), end_on=bool(detections.end_on[i]), cut=cut)
        if car.seen_length < LONG_SIDE and (car.seen_width < WHOLE_END or (any(clipped) and any(cut))):
            continue
        explained[beams] = True
        rows.append(i)
        cars.append(car)
        points.append(_whole(ends, scan.points(run)))
        distances.append(float(np.median(scan.distance[beams])))
    if not rows:
        return LocatedCars.none()
    return LocatedCars(
        np.array([[c.x, c.y] for c in cars]),
        np.array([c.yaw for c in cars]),
        np.array([[c.length, c.width] for c in cars]),
        np.array(distances),
        detections.probability[rows],
        np.array(rows, dtype=np.int64),
        points=tuple(points),
    )


def _whole(ends: FloatArray, run: FloatArray) -> FloatArray:
    """Return the end points of a run, if they are no more than a car: its box is too small; else those in the box."""
    yaw = direction_of(run)
    sides = np.sort([np.ptp(run @ [math.cos(a), math.sin(a)]) for a in (yaw, yaw + 0.5 * math.pi)])
    return run if sides[1] <= LONGEST and sides[0] <= WIDEST else ends


def localize_median(
    detections: Detections, scan: RangeScan, camera: PinholeCamera, mount: Mount, vehicle: FloatArray
) -> LocatedCars:
    scan = scan.seen_from(*mount.in_world(vehicle)[:2])
    margins = bearings(camera, mount, vehicle, detections.boxes)
    distance = [median_distance(scan, beams_between(scan, left, right)) for left, right in margins]
    return _cars_behind(detections, np.array(distance), margins, scan.x, scan.y)


def localize_disparity(
    detections: Detections,
    disparity_px: Float32Array,
    stereo: StereoCamera,
    mount: Mount,
    vehicle: FloatArray,
) -> LocatedCars:
    """Locate the detected cars as the thesis does with a stereo camera: directly behind the median depth of the box.

    The detections are in the left camera's image; `disparity_px` is NaN where nothing matches.
    """
    x, y, yaw = mount.in_world(vehicle)
    margins = bearings(stereo.camera, mount, vehicle, detections.boxes)
    depth = np.array([median_depth(disparity_px, box, stereo) for box in detections.boxes])
    distance = depth / np.cos(margins.mean(axis=1) - yaw)
    return _cars_behind(detections, distance, margins, x, y)


def _cars_behind(
    detections: Detections, distance: FloatArray, margins: FloatArray, x: float, y: float
) -> LocatedCars:
    rows = np.flatnonzero(np.isfinite(distance.reshape(-1)))
    end_on, middle, distance = detections.end_on[rows], margins[rows].mean(axis=1), distance[rows]
    depth = distance + 0.5 * np.where(end_on, CAR_LENGTH, CAR_WIDTH)
    return LocatedCars(
        np.stack([x + depth * np.cos(middle), y + depth * np.sin(middle)], axis=1),
        np.where(end_on, middle, middle + math.pi / 2) % math.pi,
        np.tile([CAR_LENGTH, CAR_WIDTH], (len(rows), 1)),
        distance,
        detections.probability[rows],
        rows.astype(np.int64),
    )


def _heights(box: Float32Array, distance: float, camera: PinholeCamera, mount: Mount) -> tuple[float, float]:
    """Return the heights above the ground of a box's lower and upper edge, m, at a distance."""
    left, top, right, bottom = box.tolist()
    aside = math.atan((0.5 * (left + right) - camera.cx) / camera.fx)
    depth = distance * math.cos(aside)
    low, high = (
        mount.z + depth * math.tan(mount.pitch - math.atan((row - camera.cy) / camera.fy))
        for row in (bottom, top)
    )
    return low, high


def _is_as_high(tops: FloatArray, high: float) -> bool:
    """Return whether what beams meet may be as high as a box: no house behind it, and no step before it."""
    known = tops[np.isfinite(tops)]
    return not len(known) or _TOPS[0] * high <= float(np.percentile(known, 90.0)) <= high + _TOPS[1]


def _hidden(distance: FloatArray) -> bool:
    """Return whether a car may extend behind a nearer obstacle beside it, or beyond the last beam.

    `distance`, (k,) m, is of the car's last beam and of those after it, outwards.
    """
    # The next beam may have dropped out, so check the one after it, too.
    after = distance[1:3]
    if not len(after) or np.isnan(after).any():
        return True
    met = after[np.isfinite(after)]
    return bool(len(met) and met[0] < distance[0])


def _wrapped(angle: FloatArray) -> FloatArray:
    return np.asarray((angle + math.pi) % (2.0 * math.pi) - math.pi)
