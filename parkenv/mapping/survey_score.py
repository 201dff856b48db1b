"""Errors of detection and localisation in a survey session, measured against the simulated truth."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.mapping.distance_bins import DISTANCE_ENDS
from parkenv.perception.pipeline import CameraView, PerceptionResult
from parkenv.perception.ranging import LocatedCars
from sim_sensors.ground_truth import VehicleBoxes, vehicle_boxes
from sim_sensors.laser.scanner import LaserScanner
from sim_sensors.rig import Capture, SensorRig
from sim_sensors.scene import Scene

MATCH = 0.3  # intersection over union from which a detection matches a car
CLEAR = 0.6  # visible fraction of a car in an image from which a frame without its detection counts as a miss
METHODS = ("fitted", "thesis")
"""Localisation methods: `localize_cars`, and the median range as in the thesis (`localize_as_thesis`)."""
SIDES = ("left", "top", "right", "bottom")
_GLIMPSE = 0.05  # visible fraction from which a box can match a car
_TRUTH = LaserScanner()
_LEAST_BEAMS = 3

SIGHTING = np.dtype(
    [
        ("capture", np.int64),
        ("camera", np.int64),  # its number in the rig
        ("slot", np.int64),  # the slot in which the car is parked; -1 for a moving car, and without a car
        (
            "distance",
            np.float64,
        ),  # m, from the camera to the car's centre; of a box without a car as measured, or NaN
        ("visible", np.float64),  # visible fraction of the car; 0 without a car
        *((side, np.int64) for side in SIDES),  # px, the box of the whole car within the picture, or the box
        ("view", np.int64),  # a `View`
        ("boxes", np.int64),  # number of boxes that match the car: 0 if it is missed
        ("placed", np.int64),  # 1 if a car was located in its slot, or by the box without a car in any slot
    ]
)
"""A car in a picture, at least `_GLIMPSE` of it visible, or a box without a car."""
TrueBoxes = dict[str, VehicleBoxes]
"""The vehicles in the image of each camera, by its name."""


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

    Args:
        n_slots: number of slots of the lot.

    Attributes:
        found: (n_slots,) bool, whether the car in a slot was detected and assigned to a slot.
        detections: number of detections; `right`: how many of them match a vehicle.
        in_frame: (bins, 2) int64, by distance (`DISTANCE_ENDS`): how often a parked car was completely inside a frame
            and mostly visible (`CLEAR`), and how often it was detected then.
    """

    def __init__(self, n_slots: int) -> None:
        self.found = np.zeros(n_slots, dtype=np.bool_)
        self.detections = self.right = 0
        self.in_frame = np.zeros((len(DISTANCE_ENDS), 2), dtype=np.int64)
        self._errors: dict[str, list[tuple[float, float, float]]] = {method: [] for method in METHODS}
        self._distance_std: list[float] = []
        self._sightings: list[NDArray[np.void]] = []

    @property
    def sightings(self) -> NDArray[np.void]:
        """A record (`SIGHTING`) for each car in each picture, and for each box without a car."""
        return np.concatenate([np.empty(0, SIGHTING), *self._sightings])

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
        self,
        i: int,
        scene: Scene,
        result: PerceptionResult,
        by_median: Sequence[LocatedCars],
        true: TrueBoxes,
    ) -> None:
        """Count one capture.

        Args:
            i: its number in the drive.
            scene: the true scene.
            result: pipeline result for the capture.
            by_median: for each view, its cars located by the thesis's method.
            true: `true_boxes` of the capture.
        """
        pose = result.captured.capture.pose
        for k, (view, median_cars) in enumerate(zip(result.views, by_median, strict=True)):
            boxes = true[view.name]
            matched = _matched(view.detections.boxes, boxes)
            self.detections += len(matched)
            self.right += int((matched > 0).sum())
            slots = view.slots[view.slots >= 0]
            self.found[slots[np.isin(slots, scene.present)]] = True
            self._count(boxes, view, scene.n_vehicles, matched)
            self._sightings.append(_sightings(i, k, boxes, view, scene.n_vehicles, matched))
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


def _sightings(
    i: int, camera: int, boxes: VehicleBoxes, view: CameraView, n_parked: int, matched: IntArray
) -> NDArray[np.void]:
    """Return the `SIGHTING` records of one picture."""
    seen, false = np.flatnonzero(boxes.visible_fraction > _GLIMPSE), np.flatnonzero(matched == 0)
    rows = np.zeros(len(seen) + len(false), SIGHTING)
    cars, others = rows[: len(seen)], rows[len(seen) :]
    ids = boxes.ids[seen]
    rows["capture"], rows["camera"] = i, camera
    cars["slot"], others["slot"] = np.where(ids <= n_parked, ids - 1, -1), -1
    cars["visible"], cars["view"] = boxes.visible_fraction[seen], boxes.view[seen]
    cars["boxes"], others["boxes"] = (matched[:, None] == ids).sum(axis=0), 1
    cars["placed"] = np.isin(cars["slot"], view.slots[view.slots >= 0])
    for k, side in enumerate(SIDES):
        cars[side], others[side] = boxes.box[seen, k], np.round(view.detections.boxes[false, k])
    measured, slot = np.full(len(matched), np.nan), np.full(len(matched), -1)
    away = view.cars.xy - [view.scan.x, view.scan.y]
    measured[view.cars.detection], slot[view.cars.detection] = np.hypot(*away.T), view.slots
    cars["distance"], others["distance"] = boxes.distance[seen], measured[false]
    others["placed"] = slot[false] >= 0
    return rows


def _matched(found: NDArray[np.float32], boxes: VehicleBoxes) -> NDArray[np.int64]:
    """Return the id of the vehicle that each detection matches, (n,); 0 for none."""
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
