"""The whole of seeing: from what a rig measured to cars in the world and what lies around (T §3.2)."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.perception.detector import Detections, Detector
from parkenv.perception.ranging import CarSightings, locate, locate_by_disparity, locate_plainly
from parkenv.perception.sweeps import Sweep, disparity, laser_sweep, stereo_sweep
from sim_sensors.camera.models import PinholeCamera
from sim_sensors.rig import Capture, Mount, SensorRig

FloatArray = NDArray[np.float64]

THRESHOLD = 0.25
"""Probability from which the stack takes a window for a car on the picture's word alone."""
CONFIRMED = 0.08
"""The same of a window in which the beams meet a thing of a car's size that stands on the ground."""


@dataclass(frozen=True, eq=False)
class View:
    """What one camera of a rig saw.

    Attributes:
        name: of the camera.
        camera, mount: how it is built, and where it sits.
        image: (h, w, 3) uint8.
        detections: in the image.
        sweep: what the detections were ranged with.
        disparity: (h, w) float32, px, of a stereo camera; None of others.
        cars: the detections that stand somewhere.
    """

    name: str
    camera: PinholeCamera
    mount: Mount
    image: NDArray[np.uint8]
    detections: Detections
    sweep: Sweep
    disparity: NDArray[np.float32] | None
    cars: CarSightings


@dataclass(frozen=True, eq=False)
class Look:
    """What the stack makes of one capture.

    Attributes:
        vehicle: (3,) x, y in m and yaw in rad: where the car took itself to be.
        views: one for each camera.
        sweeps: one for each laser and stereo camera.
    """

    vehicle: FloatArray
    views: tuple[View, ...]
    sweeps: tuple[Sweep, ...]


class PerceptionStack:
    """Detection and ranging with the sensors of a rig.

    A laser ranges what the cameras see; a rig without one ranges with its stereo pairs.

    Args:
        rig: with at least a camera, or a stereo camera, and something to range with.
        detector: both shipped models where None. What it finds counts from `CONFIRMED` and `THRESHOLD` on.

    Raises:
        InputError: a rig that cannot see or cannot range.
    """

    def __init__(self, rig: SensorRig, detector: Detector | None = None) -> None:
        if not (rig.lasers or rig.stereo_cameras) or not (rig.cameras or rig.stereo_cameras):
            raise InputError(
                "the rig has no camera, or nothing to measure distances with; want a camera and a laser"
            )
        self.rig = rig
        self.detector = detector or Detector.load(threshold=CONFIRMED)

    def look(self, capture: Capture, vehicle: FloatArray | None = None) -> Look:
        """See what was captured.

        Args:
            capture: by the stack's rig.
            vehicle: (3,) where the car takes itself to be; where it is, if None.
        """
        here = capture.pose if vehicle is None else vehicle
        lasers = {
            name: laser_sweep(laser, mount, here, capture.scans[name])
            for name, laser, mount in self.rig.lasers
        }
        views, sweeps = [], list(lasers.values())
        for name, camera, mount in self.rig.cameras:
            image = capture.images[name].image
            views.append(self._view(name, camera, mount, image, None, next(iter(sweeps)), here))
        for name, stereo, mount in self.rig.stereo_cameras:
            pair = capture.pairs[name]
            shifts = disparity(pair, stereo)
            seen = stereo_sweep(stereo, mount, here, shifts)
            sweeps.append(seen)
            ranged = next(iter(lasers.values()), seen)
            views.append(self._view(name, stereo.camera, mount, pair.left.image, shifts, ranged, here))
        return Look(here, tuple(views), tuple(sweeps))

    def locate_plainly(self, view: View, vehicle: FloatArray) -> CarSightings:
        """Where the thesis's way puts the cars of a view: the median in each box, and the car straight behind it.

        Args:
            view: of this stack.
            vehicle: (3,) where the car took itself to be.
        """
        if view.disparity is not None and not self.rig.lasers:
            (stereo,) = (camera for name, camera, _ in self.rig.stereo_cameras if name == view.name)
            return locate_by_disparity(view.detections, view.disparity, stereo, view.mount, vehicle)
        return locate_plainly(view.detections, view.sweep, view.camera, view.mount, vehicle)

    def _view(
        self,
        name: str,
        camera: PinholeCamera,
        mount: Mount,
        image: NDArray[np.uint8],
        shifts: NDArray[np.float32] | None,
        sweep: Sweep,
        vehicle: FloatArray,
    ) -> View:
        found = self.detector.detect(image)
        cars = locate(found, sweep, camera, mount, vehicle)
        kept = found.probability >= THRESHOLD
        kept[cars.detection] = True
        cars = dataclasses.replace(cars, detection=np.cumsum(kept)[cars.detection] - 1)
        return View(name, camera, mount, image, found.chosen(kept), sweep, shifts, cars)
