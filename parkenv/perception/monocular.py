"""Distance of detected cars from one picture alone: from the ground below a box, and from a car's usual size.

Three measurements of how far ahead a car's nearest side is:

1. the lower edge of its box is on the ground, which the camera sees from a known height under a known pitch;
2. from the lower to the upper edge the box spans a car's usual height;
3. from the left to the right edge it spans the usual width of the view: end, oblique or side.

They share errors, as that of the lower edge, so their covariance comes from the errors of edges, mount and sizes by
linear propagation, and the fused distance is the best linear unbiased estimate with it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, FloatArray
from parkenv.perception.box_fit import CAR_LENGTH, CAR_WIDTH
from parkenv.perception.detector import PROBABILITY, Detections, DetectorErrors
from parkenv.perception.ranging import MARGIN, LocatedCars
from sim_sensors.camera.models import PinholeCamera
from sim_sensors.ground_truth import View
from sim_sensors.rig import Mount

HEIGHT, HEIGHT_STD = 1.54, 0.12  # height of a car, m, and its standard deviation


class UsualCars(NamedTuple):
    """Where usual cars are behind their nearest side, (n,) m each, in the middle of which a laser's beams end.

    | field | what |
    |---|---|
    | `foot`, `foot_std` | how far behind that side its tyres stand, where its box ends, and the standard deviation |
    | `roof` | how far behind that side the edge of its roof is |
    | `width`, `width_std` | how wide its box is, as if it stood at that side, and the standard deviation |
    | `corner` | how far its nearest corner is before that side |
    """

    foot: FloatArray
    foot_std: FloatArray
    roof: FloatArray
    width: FloatArray
    width_std: FloatArray
    corner: FloatArray

    @classmethod
    def seen_as(cls, view: NDArray[np.integer]) -> UsualCars:
        """Return those of each `View`, (n,): means over simulated drives."""
        return cls(*_BY_VIEW[view].T)


_BY_VIEW = np.array(
    [
        [0.55, 0.25, 1.2, 1.95, 0.9, 0.25],  # end
        [0.0, 0.25, 0.6, 3.4, 1.1, 1.0],  # oblique
        [0.1, 0.2, 0.4, 4.1, 0.7, 0.1],  # side
    ]
)
REACH = 15.0  # m, beyond which cars are dropped: their distance is worth little
_NEAREST = 0.5  # m
_CUT = 0.8  # m, further standard deviation of the distance of a car that the left or right border cuts
_EDGE = 0.5  # px, standard deviation of the edge of the smallest box
_LENGTH_STD = 0.3  # m, standard deviation of how far a car's centre is behind its nearest side
_MIDDLE = 0.05  # standard deviation between the middles of box and car, as a fraction of the box's width
_UNKNOWN = 1e6  # m², variance of a measurement that the picture's border prevents
_AGREE = 3.0  # standard deviations up to which measurements agree
STREET_PITCH = math.radians(0.7)  # of a camera against the kerb; a cross fall of 2.5 % is 0.6 at 10 m
_COMMON_PITCH = math.radians(0.2)  # that the usual height and all boxes of a drive may be wrong by
_SURE, _LEVEL_REACH = 0.5, 25.0  # probability and distance, m, of the cars that tell the pitch
_OF_ONE_CAR = 0.2  # weight of a box: those of one car, about five, err alike
_HIDDEN = 0.5  # fraction of a box's lower edge that nearer boxes cover, from which it is not the car's own


class RangingErrors(NamedTuple):
    detector: DetectorErrors = DetectorErrors()
    pitch: float = math.radians(0.5)  # rad, of the camera
    heading: float = math.radians(0.5)  # rad, of the vehicle and of the mount
    position: float = 0.1  # m, of the vehicle, in x and in y

    @classmethod
    def of_poses(cls, position: float, heading: float) -> RangingErrors:
        """Return the errors of poses beside those of mount and map, which remain: m and rad."""
        usual = cls()
        return cls(position=math.hypot(position, usual.position), heading=math.hypot(heading, usual.heading))


class GroundView(NamedTuple):
    camera: PinholeCamera
    mount: Mount

    def slope(self, row: FloatArray) -> FloatArray:
        return np.asarray(np.tan(self.mount.pitch - np.arctan((row - self.camera.cy) / self.camera.fy)))

    def aside(self, column: FloatArray, row: FloatArray) -> FloatArray:
        across = (column - self.camera.cx) / self.camera.fx
        down = (row - self.camera.cy) / self.camera.fy
        return np.asarray(across / (math.cos(self.mount.pitch) + down * math.sin(self.mount.pitch)))

    def pixels(self, ahead: FloatArray, aside: FloatArray, height: FloatArray) -> FloatArray:
        """Return the pixels, (..., 2), of points ahead of the camera, to its right, and above the ground, m."""
        c, s, up = math.cos(self.mount.pitch), math.sin(self.mount.pitch), height - self.mount.z
        depth = ahead * c + up * s
        u = self.camera.cx + self.camera.fx * aside / depth
        return np.stack([u, self.camera.cy + self.camera.fy * (ahead * s - up * c) / depth], axis=-1)


def distances_ahead(
    boxes: FloatArray, view: NDArray[np.int8], ground: GroundView, errors: RangingErrors
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return how far ahead of the camera the nearest sides of cars are, (n,) m, and their standard deviations.

    And whether ground and height agree, on ground within `REACH`, (n,) bool.
    """
    camera, mount = ground.camera, ground.mount
    usual, none = UsualCars.seen_as(view), np.zeros(len(boxes))
    foot, roof, width = usual.foot, usual.roof, usual.width
    low, high = np.minimum(ground.slope(boxes[:, 3]), -1e-3), ground.slope(boxes[:, 1])
    across = ground.aside(boxes[:, 2], boxes[:, 3]) - ground.aside(boxes[:, 0], boxes[:, 3])
    by_ground, by_width = -mount.z / low - foot, width / across
    # Tyres and roof at low = -z / (d + foot) and high = (HEIGHT - z) / (d + roof) span high - low: the greater root of
    # span d² + (span (foot + roof) - HEIGHT) d + span foot roof - z roof - (HEIGHT - z) foot = 0.
    span, over = np.maximum(high - low, 1e-3), HEIGHT - mount.z
    half = 0.5 * (span * (foot + roof) - HEIGHT)
    root = np.sqrt(np.maximum(half**2 - span * (span * foot * roof - mount.z * roof - over * foot), 1e-9))
    by_height = (root - half) / span
    # Derivatives of the three by each source of error, times its standard deviation.
    edge = np.hypot((boxes[:, 3] - boxes[:, 1])[:, None] * errors.detector.std, _EDGE)
    per_px = (1.0 + np.stack([low, high], 1) ** 2) / (
        1.0 + ((boxes[:, [3, 1]] - camera.cy) / camera.fy) ** 2
    ) / camera.fy  # fmt: skip
    low_std, high_std = (per_px * edge[:, [3, 1]]).T
    low_by_pitch = (1.0 + low**2) * errors.pitch
    by_low = (by_ground + foot) / low
    by_span = -(by_height + foot) * (by_height + roof) / (2.0 * root)
    height_by_foot = -(span * (by_height + roof) - over) / (2.0 * root)
    left_std, right_std = by_width / across / camera.fx * edge[:, [0, 2]].T
    jacobian = {
        "lower edge": (by_low * low_std, by_span * low_std, none),
        "upper edge": (none, -by_span * high_std, none),
        "left edge": (none, none, left_std),
        "right edge": (none, none, right_std),
        "pitch": (-by_low * low_by_pitch, by_span * (high**2 - low**2) * errors.pitch, none),
        "foot": (-usual.foot_std, height_by_foot * usual.foot_std, none),
        "height": (none, (by_height + foot) / (2.0 * root) * HEIGHT_STD, none),
        "width": (none, none, by_width * usual.width_std / width),
    }
    by = np.array(list(jacobian.values())).transpose(2, 1, 0)
    below = boxes[:, 3] >= (1.0 - MARGIN) * camera.height
    above = boxes[:, 1] <= MARGIN * camera.height
    beside = (boxes[:, 0] <= MARGIN * camera.width) | (boxes[:, 2] >= (1.0 - MARGIN) * camera.width)
    unknown = np.stack([below, below | above, beside], axis=1) * _UNKNOWN + 1e-8
    covariance = by @ by.transpose(0, 2, 1) + unknown[:, :, None] * np.eye(3)
    weight = np.linalg.inv(covariance).sum(axis=2)
    variance = 1.0 / weight.sum(axis=1)
    estimates = np.stack([by_ground, by_height, by_width], axis=1)
    apart = covariance[:, 0, 0] + covariance[:, 1, 1] - 2.0 * covariance[:, 0, 1]
    agree = np.abs(by_ground - by_height) <= _AGREE * np.sqrt(apart)
    # Towards the horizon `apart` grows without bound, and everything would agree.
    agree &= ground.slope(boxes[:, 3]) < 0.0
    agree &= low - _AGREE * np.hypot(low_std, low_by_pitch) < -mount.z / REACH
    return variance * (weight * estimates).sum(axis=1), np.sqrt(variance), agree


def street_pitch(seen: Sequence[tuple[Detections, GroundView]], errors: RangingErrors) -> tuple[float, float]:
    """Return how much higher than its mount says a camera looks over the ground of parked cars, rad, and the error.

    Streets fall towards their kerbs, and a load tilts the vehicle: in all pictures of a drive cars stand lower than on
    a level plane. The heights of all its cars together tell by how much.
    """
    weights, sums = 0.0, 0.0
    for detections, (camera, mount) in seen:
        boxes, sure = errors.detector.corrected(detections.boxes), detections.probability >= _SURE
        margin = MARGIN * np.array([camera.width, camera.height])
        inside = (boxes[:, :2] > margin) & (boxes[:, 2:] < [camera.width, camera.height] - margin)
        boxes = boxes[sure & inside.all(axis=1) & ~_is_hidden(boxes, sure)]
        low, high = (mount.pitch - np.arctan((boxes[:, [3, 1]] - camera.cy) / camera.fy)).T
        ahead = HEIGHT / (np.tan(high) - np.tan(low))
        pitch = np.arctan(-mount.z / ahead) - low
        edges = np.hypot(
            (boxes[:, 3] - boxes[:, 1])[:, None] * [errors.detector.std[k] for k in (1, 3)], _EDGE
        )
        std = np.hypot(mount.z / ahead * HEIGHT_STD / HEIGHT, np.hypot(*edges.T) / camera.fy)
        fits = (ahead < _LEVEL_REACH) & (np.abs(pitch) < _AGREE * np.hypot(std, STREET_PITCH))
        weights += _OF_ONE_CAR * (std[fits] ** -2).sum()
        sums += _OF_ONE_CAR * (pitch[fits] / std[fits] ** 2).sum()
    if not weights:
        return 0.0, STREET_PITCH
    variance = 1.0 / weights + _COMMON_PITCH**2
    left = 1.0 / (STREET_PITCH**-2 + 1.0 / variance)
    return sums / weights * left / variance, math.sqrt(left)


def localize_boxes(
    detections: Detections,
    ground: GroundView,
    vehicle: FloatArray,
    errors: RangingErrors,
    heading_near: Callable[[FloatArray], FloatArray] | None = None,
) -> LocatedCars:
    """Locate the detected cars from their boxes alone, with the covariance of each.

    The function drops boxes that reach from the picture's left border to the right one, boxes whose lower edge a
    nearer one hides, those that end above the horizon, and those whose height and lower edge do not agree: a car on
    the ground in front of the camera has no such box.

    Cars have the headings, rad, that `heading_near` returns for (n, 2) points; where it returns NaN, or is None, that
    of the view, along or across the line of sight.
    """
    boxes, camera = errors.detector.corrected(detections.boxes), ground.camera
    if not len(boxes):
        return LocatedCars.none()
    ahead, std, agree = distances_ahead(boxes, detections.view, ground, errors)
    sure = detections.probability >= PROBABILITY
    margin = MARGIN * camera.width + 2.0 * errors.detector.std[0] * (boxes[:, 3] - boxes[:, 1])
    cut_left, cut_right = boxes[:, 0] <= margin, boxes[:, 2] >= camera.width - margin
    whole = ~(cut_left & cut_right)
    rows = np.flatnonzero(
        sure & whole & agree & (ahead > _NEAREST) & (ahead < REACH) & ~_is_hidden(boxes, sure)
    )
    boxes, ahead, std, view = boxes[rows], ahead[rows], std[rows], detections.view[rows]
    usual = UsualCars.seen_as(view)
    left, right = (ground.aside(boxes[:, side], boxes[:, 3]) for side in (0, 2))
    # A car that the picture's border cuts goes on there to its usual width.
    left = np.where(cut_left[rows], np.minimum(left, right - usual.width / ahead), left)
    right = np.where(cut_right[rows], np.maximum(right, left + usual.width / ahead), right)
    cut, aside = (cut_left | cut_right)[rows], 0.5 * (left + right)
    std = np.hypot(std, _CUT * cut)
    x, y, yaw = ground.mount.in_world(vehicle)
    bearing = yaw - np.arctan(aside)

    def centres(heading: FloatArray) -> FloatArray:
        """Return the centres, (n, 2), of cars whose nearest corner is so far ahead and which fill the boxes' middle."""
        along, across = corners_of_cars(heading - yaw)
        depth = ahead - usual.corner - along.min(axis=1)
        shift = aside * depth
        for _ in range(5):
            slope = (shift[:, None] + across) / np.maximum(depth[:, None] + along, _NEAREST)
            shift += (aside - 0.5 * (slope.min(axis=1) + slope.max(axis=1))) * ahead
        c, s = math.cos(yaw), math.sin(yaw)
        return np.stack([x + depth * c + shift * s, y + depth * s - shift * c], axis=1)

    heading = np.where(view == View.END, bearing, bearing + math.pi / 2)
    if heading_near is not None:
        parked = heading_near(centres(heading))
        heading = np.where(np.isnan(parked), heading, parked)
    xy, stretch = centres(heading), np.hypot(1.0, aside)
    along = np.hypot(std * stretch, _LENGTH_STD)
    edges = 0.5 * math.hypot(errors.detector.std[0], errors.detector.std[2]) * (boxes[:, 3] - boxes[:, 1])
    sideways = np.hypot(edges, _MIDDLE * (boxes[:, 2] - boxes[:, 0])) / camera.fx
    across = np.hypot(
        np.hypot(*(xy - [x, y]).T) * np.hypot(sideways, errors.heading), 0.8 * usual.width_std * cut
    )
    c, s = np.cos(bearing), np.sin(bearing)
    scaled = np.stack([c * along, -s * across, s * along, c * across], axis=1).reshape(-1, 2, 2)
    return LocatedCars(
        xy, heading % math.pi, np.tile([CAR_LENGTH, CAR_WIDTH], (len(rows), 1)), ahead * stretch,
        detections.probability[rows], rows.astype(np.int64), std * stretch,
        scaled @ scaled.transpose(0, 2, 1) + errors.position**2 * np.eye(2),
    )  # fmt: skip


def corners_of_cars(heading: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far the corners of usual cars, (n, 4), are ahead of their centres and to the right of them, m."""
    c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
    length, width = 0.5 * CAR_LENGTH * np.array([1, 1, -1, -1]), 0.5 * CAR_WIDTH * np.array([1, -1, 1, -1])
    return c * length - s * width, -s * length - c * width


def _is_hidden(boxes: FloatArray, sure: BoolArray) -> BoolArray:
    """Return which boxes' lower edge nearer ones hide, of those that are `sure` to show cars."""
    common = np.minimum(boxes[:, None, 2], boxes[:, 2]) - np.maximum(boxes[:, None, 0], boxes[:, 0])
    lower = boxes[:, 3] > boxes[:, None, 3]
    above = boxes[:, 1] < boxes[:, None, 3]
    hidden = np.where(lower & above & sure, common, 0.0).max(axis=1, initial=0.0)
    return np.asarray(hidden > _HIDDEN * (boxes[:, 2] - boxes[:, 0]))
