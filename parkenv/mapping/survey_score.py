"""Errors of detection and localisation in a survey session, measured against the simulated truth."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.perception.pipeline import CameraView, PerceptionResult
from parkenv.perception.ranging import LocatedCars
from sim_sensors.ground_truth import VehicleBoxes, vehicle_boxes
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.rig import Capture, SensorRig
from sim_sensors.scene import Scene

MATCH = 0.3  # intersection over union from which a detection matches a car
CLEAR = 0.6  # visible fraction of a car in an image from which a frame without its detection counts as a miss
# m, from the camera to a car's centre: upper ends of the bins in which detections are counted.
DISTANCE_ENDS = (4.0, 6.0, 8.0, 10.0, 12.0, 15.0)
# Localisation methods: `localize_cars`, and the median range as in the thesis (`localize_as_thesis`).
METHODS = ("fitted", "thesis")
_GLIMPSE = 0.05  # visible fraction from which a box can match a car
_TRUTH = LaserScanner()
_LEAST_BEAMS = 3

TrueBoxes = dict[str, VehicleBoxes]  # the vehicles in the image of each camera, by its name


def true_boxes(rig: SensorRig, scene: Scene, capture: Capture) -> TrueBoxes:
    """Return the vehicles in a capture's images, of stereo cameras in the left ones."""
    views = [(name, camera, mount, capture.images[name]) for name, camera, mount in rig.cameras]
    views += [
        (name, pair.camera, mount, capture.pairs[name].left) for name, pair, mount in rig.stereo_cameras
    ]
    return {
        name: vehicle_boxes(camera, scene, mount.camera_pose(capture.pose), frame)
        for name, camera, mount, frame in views
    }


class SurveyScore:
    """Counts over the captures of a session.

    `found`, (n_slots,), says whether the car in a slot was detected and assigned to a slot; `right` of the `detections`
    match a vehicle; `in_frame`, (bins, 2), has by distance (`DISTANCE_ENDS`) how often a parked car was completely
    inside a frame and mostly visible (`CLEAR`), and how often it was detected then.
    """

    def __init__(self, n_slots: int) -> None:
        self.found = np.zeros(n_slots, dtype=np.bool_)
        self.detections = self.right = 0
        self.in_frame = np.zeros((len(DISTANCE_ENDS), 2), dtype=np.int64)
        self._errors: dict[str, list[tuple[float, float, float]]] = {method: [] for method in METHODS}
        self._distance_std: list[float] = []

    def errors(self, method: str) -> FloatArray:
        """Return the errors of parked cars located by one of `METHODS`, (k, 3): distance, m; position, m; heading, rad.

        Distances are compared with the median of the noise-free beams that end on the car.
        """
        return np.array(self._errors[method]).reshape(-1, 3)

    @property
    def within_std(self) -> tuple[float, float]:
        """Fractions of distances with an error of at most one and two of their stated standard deviations, or NaN."""
        std = np.array(self._distance_std)
        if not len(std):
            return math.nan, math.nan
        off = self.errors("fitted")[:, 0] / std
        return float((off <= 1.0).mean()), float((off <= 2.0).mean())

    def add(
        self, scene: Scene, result: PerceptionResult, by_median: Sequence[LocatedCars], true: TrueBoxes
    ) -> None:
        """Count one capture, with its `true_boxes` and each view's cars located by the thesis's method."""
        pose = result.captured.capture.pose
        for view, median_cars in zip(result.views, by_median, strict=True):
            boxes = true[view.name]
            matched = _matched(view.detections.boxes, boxes)
            self.detections += len(matched)
            self.right += int((matched > 0).sum())
            slots = view.slots[view.slots >= 0]
            self.found[slots[np.isin(slots, scene.present)]] = True
            self._count(boxes, view, scene.n_vehicles, matched)
            if (matched > 0).any():
                exact, ids = _TRUTH.scan_with_ids(scene.scan_plane, view.mount.in_world(pose))
                for method, cars in zip(METHODS, (view.cars, median_cars), strict=True):
                    self._add_errors(method, cars, matched, scene, exact, ids)

    def _count(self, boxes: VehicleBoxes, view: CameraView, n_parked: int, matched: IntArray) -> None:
        clear = (boxes.visible_fraction >= CLEAR) & (boxes.ids <= n_parked)
        clear &= (boxes.box[:, 0] > 0) & (boxes.box[:, 2] < view.camera.width)
        clear &= boxes.distance < DISTANCE_ENDS[-1]
        distance_bin = np.searchsorted(DISTANCE_ENDS, boxes.distance[clear], side="right")
        detected = np.isin(boxes.ids[clear], matched)
        self.in_frame[:, 0] += np.bincount(distance_bin, minlength=len(DISTANCE_ENDS))
        self.in_frame[:, 1] += np.bincount(distance_bin[detected], minlength=len(DISTANCE_ENDS))

    def _add_errors(
        self,
        method: str,
        cars: LocatedCars,
        matched: IntArray,
        scene: Scene,
        exact: NDArray[np.float32],
        ids: NDArray[np.int32],
    ) -> None:
        for k, car in enumerate(matched[cars.detection].tolist()):
            on_it = np.isfinite(exact) & (ids == car)
            if not 0 < car <= scene.n_vehicles or on_it.sum() < _LEAST_BEAMS:
                continue
            x, y, yaw = scene.vehicle_pose[car - 1]
            if cars.distance_std is not None:
                self._distance_std.append(float(cars.distance_std[k]))
            turned = (cars.yaw[k] - yaw + math.pi / 2) % math.pi - math.pi / 2
            self._errors[method].append(
                (
                    abs(float(cars.distance[k]) - float(np.median(exact[on_it]))),
                    math.hypot(cars.xy[k, 0] - x, cars.xy[k, 1] - y),
                    abs(turned),
                )
            )


def _matched(found: NDArray[np.float32], boxes: VehicleBoxes) -> NDArray[np.int64]:
    match = np.zeros(len(found), dtype=np.int64)
    best = np.full(len(found), MATCH)
    area = (found[:, 2] - found[:, 0]) * (found[:, 3] - found[:, 1])
    for k in np.flatnonzero(boxes.visible_fraction > _GLIMPSE):
        for true in (boxes.box[k].astype(np.float64), boxes.visible_box[k].astype(np.float64)):
            inner = np.minimum(found[:, 2:], true[2:]) - np.maximum(found[:, :2], true[:2])
            common = np.clip(inner, 0.0, None).prod(axis=1)
            overlap = common / (area + (true[2] - true[0]) * (true[3] - true[1]) - common)
            better = overlap > best
            match[better], best[better] = boxes.ids[k], overlap[better]
    return match
