"""How far away a detected car is, and where it stands (T §3.2.3).

The thesis takes the median of what a sensor measures within a detection's box, and places the car straight behind it:
`locate_plainly` from a laser, `locate_by_disparity` from a stereo camera. Both are there to compare with. `locate` is
better on either sensor's `Sweep`: it tells the beams that end on the car from those that pass it or meet a neighbour,
and fits a rectangle to them, so that the car's heading does not depend on where it was seen from (T §4.2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.perception.box_fit import CAR_LENGTH, CAR_WIDTH, LONG_SIDE, fit_box
from parkenv.perception.sweeps import Sweep
from sim_sensors.camera.models import PinholeCamera, StereoCamera
from sim_sensors.rig import Mount

if TYPE_CHECKING:
    from parkenv.perception.detector import Detections

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]

GAP = 0.5
"""m, between the ends of neighbouring beams that belong to different things."""
WHOLE_END = 1.2
"""m; an end of which so much is seen is a car's, and not a glimpse of its flank."""
OFF_GROUND = 0.7
"""m, that the lower edge of a box may lie above or below the ground."""
CAR_HEIGHT = (0.8, 3.2)
"""m, between which the upper edge of a box lies."""
_LEAST_BEAMS = 3
_MARGIN = 0.02  # of an image's width; boxes that come as close to its margin are taken to end there
_SAME_AXIS = 0.1  # m, between a camera and the sweep that stands for it
_BIN = 0.05


@dataclass(frozen=True, eq=False)
class CarSightings:
    """Detected cars in the world.

    Args:
        xy: (n, 2) float64, m, centres, world frame.
        yaw: (n,) float64, rad, along the car, in [0, π): nose and tail are not told apart.
        size: (n, 2) float64, m, length and width.
        distance: (n,) float64, m, from the sensor to what it met of the car.
        probability: (n,) float32, of the detection.
        detection: (n,) int64, which detection each is of; some are of none that stands anywhere.

    Raises:
        InputError: columns of different lengths, or a place that is not finite.
    """

    xy: FloatArray
    yaw: FloatArray
    size: FloatArray
    distance: FloatArray
    probability: Float32Array
    detection: NDArray[np.int64]

    def __post_init__(self) -> None:
        n = len(self.yaw)
        shapes = {"xy": (n, 2), "size": (n, 2)} | dict.fromkeys(
            ("yaw", "distance", "probability", "detection"), (n,)
        )
        for name, want in shapes.items():
            value = getattr(self, name)
            if value.shape != want or not np.isfinite(value).all():
                raise InputError(f"{name} of car sightings is {value.shape}, want {want} finite numbers")

    def __len__(self) -> int:
        return len(self.yaw)

    @classmethod
    def none(cls) -> CarSightings:
        """No car."""
        return cls(
            np.empty((0, 2)), np.empty(0), np.empty((0, 2)), np.empty(0), np.empty(0, dtype=np.float32),
            np.empty(0, dtype=np.int64),
        )  # fmt: skip

    @property
    def poses(self) -> FloatArray:
        """(n, 3) float64, x, y, yaw."""
        return np.column_stack([self.xy, self.yaw])


def bearings(camera: PinholeCamera, mount: Mount, vehicle: FloatArray, boxes: Float32Array) -> FloatArray:
    """World directions, (n, 2) rad, of the left and right margins of boxes (the β of eq. 3.2)."""
    _, _, yaw = mount.in_world(vehicle)
    columns = np.clip(boxes[:, [0, 2]], 0.0, camera.width)
    return np.asarray(yaw - np.arctan2(columns - camera.cx, camera.fx))


def beams_between(sweep: Sweep, left: float, right: float) -> NDArray[np.int64]:
    """Which beams point between two world directions, rad, left one first (eq. 3.2)."""
    middle, half = 0.5 * (left + right), 0.5 * (left - right)
    return np.flatnonzero(np.abs(_turned(sweep.angle - middle)) < half)


def median_distance(sweep: Sweep, beams: NDArray[np.int64]) -> float:
    """The thesis's distance: the median of the beams that meet something; NaN where none does."""
    met = sweep.distance[beams]
    met = met[np.isfinite(met)]
    return float(np.median(met)) if len(met) else math.nan


class CarBeams(NamedTuple):
    """The beams that end on a car.

    Attributes:
        beams: (k,) int64, counter-clockwise; empty where nothing was met.
        cut: whether the car goes on before the first and behind the last of them, hidden by something nearer or out
            of the sensor's view.
    """

    beams: NDArray[np.int64]
    cut: tuple[bool, bool]


def car_beams(
    sweep: Sweep, beams: NDArray[np.int64], clipped: tuple[bool, bool] = (False, False)
) -> CarBeams:
    """Those beams of a box that end on its car: the run of neighbouring ends that best fills the box's middle.

    Where two neighbouring beams end more than `GAP` apart they met different things: a car and what stands behind it
    or before its edge. Beams near the middle of the box count more, since what is beside the car fills its margins.

    Args:
        sweep: of the surroundings.
        beams: of the box, counter-clockwise.
        clipped: whether the box ends at the image's margin before its first and behind its last beam: there the
            laser still sees the car where the camera no longer does, and the run goes on.
    """
    met = np.flatnonzero(np.isfinite(sweep.distance))
    inside = np.flatnonzero(np.isin(met, beams))
    if len(inside) < _LEAST_BEAMS:
        return CarBeams(met[:0], (False, False))
    step = np.diff(sweep.points(met), axis=0)
    run = np.r_[0, np.cumsum(np.hypot(step[:, 0], step[:, 1]) > GAP)]
    middle = 0.5 * (sweep.angle[beams[0]] + sweep.angle[beams[-1]])
    off = np.abs(_turned(sweep.angle[met[inside]] - middle))
    weight = np.bincount(run[inside], 1.0 - off / (off.max() + 1e-9))
    ends = np.flatnonzero(run == weight.argmax())
    # Boxes are not exact: what goes on a little way outside is the car's still, and its end is seen.
    slack = 2 + len(inside) // 10
    goes_on = (clipped[0] or ends[0] >= inside[0] - slack, clipped[1] or ends[-1] <= inside[-1] + slack)
    first = ends[0] if goes_on[0] else inside[0]
    last = ends[-1] if goes_on[1] else inside[-1]
    if last - first + 1 < _LEAST_BEAMS:
        return CarBeams(met[:0], (False, False))
    cut = (
        goes_on[0] and _hidden(sweep.distance[: met[first] + 1][::-1]),
        goes_on[1] and _hidden(sweep.distance[met[last] :]),
    )
    return CarBeams(met[first : last + 1], cut)


def median_depth(disparity_px: Float32Array, box: Float32Array, stereo: StereoCamera) -> float:
    """The thesis's depth of a box, m: the median of fB/d in it (eq. 3.1); NaN where nothing matches."""
    depth = _depths(disparity_px, box, stereo, (0.0, 1.0), (0.0, 1.0))
    return float(np.median(depth)) if len(depth) else math.nan


def body_depth(disparity_px: Float32Array, box: Float32Array, stereo: StereoCamera) -> float:
    """A depth that windows, ground and background do not spoil, m: the mode in the lower middle of the box.

    NaN where nothing matches.
    """
    depth = _depths(disparity_px, box, stereo, (0.25, 0.75), (0.5, 0.85))
    if not len(depth):
        return math.nan
    # In equal steps of the logarithm the matcher's error is as wide near as far.
    step = np.log(depth) / _BIN
    step -= step.min()
    # Two neighbouring bins at a time, so that a mode on their border is not cut in two.
    pairs = np.convolve(np.bincount(step.astype(int)), [1, 1])
    return float(np.median(depth[np.abs(step - pairs.argmax()) <= 1.0]))


def locate(
    detections: Detections, sweep: Sweep, camera: PinholeCamera, mount: Mount, vehicle: FloatArray
) -> CarSightings:
    """Where the detected cars stand: `car_beams` of each box, and a car fitted to them.

    Detections without a thing at bumper height are dropped, those that at its distance would not stand on the ground
    or be no car's height, and cars of which too little is seen to tell how they lie:
    neither a flank nor an end, or not all of them at the image's margin. Who drives on sees them better from elsewhere.

    Args:
        detections: in the camera's image.
        sweep: from the same vehicle pose.
        camera: that took the image.
        mount: where it sits: on one vertical axis with the sweep's sensor.
        vehicle: (3,) x, y, yaw, world frame.

    Raises:
        InputError: a sweep from another place.
    """
    _require_same_axis(sweep, mount, vehicle)
    rows, cars, distances = [], [], []
    for i, (left, right) in enumerate(bearings(camera, mount, vehicle, detections.boxes)):
        # Counter-clockwise, the box's right margin comes first.
        clipped = (
            bool(detections.boxes[i, 2] >= (1.0 - _MARGIN) * camera.width),
            bool(detections.boxes[i, 0] <= _MARGIN * camera.width),
        )
        beams, cut = car_beams(sweep, beams_between(sweep, left, right), clipped)
        if not len(beams):
            continue
        if not _stands(detections.boxes[i], float(np.median(sweep.distance[beams])), camera, mount):
            continue
        car = fit_box(
            sweep.points(beams), np.array([sweep.x, sweep.y]), end_on=bool(detections.ends[i]), cut=cut
        )
        if car.seen_length < LONG_SIDE and (car.seen_width < WHOLE_END or (any(clipped) and any(cut))):
            continue
        rows.append(i)
        cars.append(car)
        distances.append(float(np.median(sweep.distance[beams])))
    if not rows:
        return CarSightings.none()
    return CarSightings(
        np.array([[c.x, c.y] for c in cars]),
        np.array([c.yaw for c in cars]),
        np.array([[c.length, c.width] for c in cars]),
        np.array(distances),
        detections.probability[rows],
        np.array(rows, dtype=np.int64),
    )


def locate_plainly(
    detections: Detections, sweep: Sweep, camera: PinholeCamera, mount: Mount, vehicle: FloatArray
) -> CarSightings:
    """As `locate`, the thesis's way: the median of all beams (eq. 3.2), and the car straight behind it.

    Raises:
        InputError: a sweep from another place.
    """
    _require_same_axis(sweep, mount, vehicle)
    margins = bearings(camera, mount, vehicle, detections.boxes)
    distance = [median_distance(sweep, beams_between(sweep, left, right)) for left, right in margins]
    return _straight_behind(detections, np.array(distance), margins, sweep.x, sweep.y)


def locate_by_disparity(
    detections: Detections,
    disparity_px: Float32Array,
    stereo: StereoCamera,
    mount: Mount,
    vehicle: FloatArray,
) -> CarSightings:
    """The thesis's way with a stereo camera: the median depth in each box, and the car straight behind it.

    Args:
        detections: in the left camera's image.
        disparity_px: (h, w) float32, NaN where nothing matches.
        stereo: that took the pair.
        mount: where its left camera sits.
        vehicle: (3,) x, y, yaw, world frame.
    """
    x, y, yaw = mount.in_world(vehicle)
    margins = bearings(stereo.camera, mount, vehicle, detections.boxes)
    depth = np.array([median_depth(disparity_px, box, stereo) for box in detections.boxes])
    distance = depth / np.cos(margins.mean(axis=1) - yaw)
    return _straight_behind(detections, distance, margins, x, y)


def _straight_behind(
    detections: Detections, distance: FloatArray, margins: FloatArray, x: float, y: float
) -> CarSightings:
    """Cars behind what was measured in the middle of their boxes; those without a measurement are dropped."""
    rows = np.flatnonzero(np.isfinite(distance.reshape(-1)))
    ends, middle, distance = detections.ends[rows], margins[rows].mean(axis=1), distance[rows]
    depth = distance + 0.5 * np.where(ends, CAR_LENGTH, CAR_WIDTH)
    return CarSightings(
        np.stack([x + depth * np.cos(middle), y + depth * np.sin(middle)], axis=1),
        np.where(ends, middle, middle + math.pi / 2) % math.pi,
        np.tile([CAR_LENGTH, CAR_WIDTH], (len(rows), 1)),
        distance,
        detections.probability[rows],
        rows.astype(np.int64),
    )


def _require_same_axis(sweep: Sweep, mount: Mount, vehicle: FloatArray) -> None:
    x, y, _ = mount.in_world(vehicle)
    apart = math.hypot(sweep.x - x, sweep.y - y)
    if apart > _SAME_AXIS:
        raise InputError(f"camera and sweep are {apart:.2f} m apart, want both on one vertical axis (T §4.1)")


def _stands(box: Float32Array, distance: float, camera: PinholeCamera, mount: Mount) -> bool:
    """Whether a box is as low and as high as that of a car on the ground at a distance, m."""
    left, top, right, bottom = box.tolist()
    aside = math.atan((0.5 * (left + right) - camera.cx) / camera.fx)
    depth = distance * math.cos(aside)
    low, high = (
        mount.z + depth * math.tan(mount.pitch - math.atan((row - camera.cy) / camera.fy))
        for row in (bottom, top)
    )
    at_margin = bottom >= (1.0 - _MARGIN) * camera.height
    return (at_margin or abs(low) <= OFF_GROUND) and CAR_HEIGHT[0] <= high <= CAR_HEIGHT[1]


def _hidden(distance: FloatArray) -> bool:
    """Whether a car may go on behind what the beams after its last one meet, or where there is no beam.

    Args:
        distance: (k,) m, of its last beam and of those after it, outwards.
    """
    # The next beam may have dropped out; the one after it tells, too.
    after = distance[1:3]
    if not len(after) or np.isnan(after).any():
        return True
    met = after[np.isfinite(after)]
    return bool(len(met) and met[0] < distance[0])


def _turned(angle: FloatArray) -> FloatArray:
    """The same angles, in [-π, π)."""
    return np.asarray((angle + math.pi) % (2.0 * math.pi) - math.pi)


def _depths(
    disparity_px: Float32Array,
    box: Float32Array,
    stereo: StereoCamera,
    across: tuple[float, float],
    down: tuple[float, float],
) -> FloatArray:
    """Depths of the matches in a part of a box, given as shares of its width and height."""
    left, top, right, bottom = box.astype(np.float64)
    rows, columns = disparity_px.shape
    u = np.clip(np.round(left + np.array(across) * (right - left)), 0, columns).astype(int)
    v = np.clip(np.round(top + np.array(down) * (bottom - top)), 0, rows).astype(int)
    found = disparity_px[v[0] : v[1], u[0] : u[1]]
    return np.asarray(stereo.camera.fx * stereo.baseline / found[np.isfinite(found)], dtype=np.float64)
