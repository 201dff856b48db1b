"""The perception pipeline: from a rig's measurements to slot occupancy (T §3.2, §3.3.2)."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.threads import ahead_in_threads, in_threads
from parkenv.errors import InputError
from parkenv.perception.detector import PROBABILITY, Detections, Detector, DetectorErrors, detect_in
from parkenv.perception.detector_registry import make_detector
from parkenv.perception.ground_detector import ground_band
from parkenv.perception.monocular import GroundView, RangingErrors, localize_boxes, street_pitch
from parkenv.perception.range_scan import RangeScan, disparity, scan_from_laser, scan_from_stereo
from parkenv.perception.ranging import LocatedCars, localize_cars, localize_disparity, localize_median
from parkenv.perception.slot_filter import OCCLUDED, SlotFilter, SlotObservation
from parkenv.world.lot import ParkingLot
from sim_sensors.camera.models import PinholeCamera, StereoCamera
from sim_sensors.rig import Capture, Mount, SensorRig, TimedCapture


@dataclass(frozen=True, eq=False)
class CameraView:
    """One camera's image with its detections and located cars.

    Attributes:
        name: name of the camera in the rig.
        camera, mount: its model, and its pose on the vehicle.
        image: (h, w, 3) uint8, RGB.
        detections: the cars in the image.
        scan: the ranges used to locate them; without a beam where there is no ranging sensor.
        stereo: without a laser, the stereo camera and its disparity, (h, w) float32 px; else None.
        cars: the detections that could be located.
        slots: (n,) int64, the slot that each of `cars` stands in; -1 for none.
        hiding: without a ranging sensor, (k, 4) px, all boxes behind which slots are not seen.
    """

    name: str
    camera: PinholeCamera
    mount: Mount
    image: NDArray[np.uint8]
    detections: Detections
    scan: RangeScan
    stereo: tuple[StereoCamera, NDArray[np.float32]] | None
    cars: LocatedCars
    slots: NDArray[np.int64]
    hiding: FloatArray | None = None


class Seen(NamedTuple):
    """What the pictures of a capture show, wherever the vehicle is."""

    detections: dict[str, Detections]  # by camera
    disparities: dict[str, tuple[StereoCamera, NDArray[np.float32]]]  # by stereo camera, eq. 3.1


@dataclass(frozen=True, eq=False)
class PerceptionResult:
    captured: TimedCapture  # the capture and its time
    vehicle: FloatArray  # (3,) estimated x, y in m and yaw in rad of the vehicle, world frame
    views: tuple[CameraView, ...]  # one for each camera and stereo camera of the rig
    scans: tuple[RangeScan, ...]  # one for each laser and stereo camera of the rig that has measured anew

    @property
    def n_cars(self) -> int:
        return sum(len(view.cars) for view in self.views)


class PerceptionPipeline:
    """Detects cars, measures their distance, and estimates which slots are taken, with the sensors of one rig.

    A laser measures the distances for all cameras; in a rig without a laser each stereo camera measures its own; and
    without any, distances follow from the boxes alone (`parkenv.perception.monocular`).

    Args:
        rig: with at least one camera or stereo camera.
        lot: the lot with the slots; None: cars are located only.
        detector: a detector, or its name (see `make_detector`); None: the packaged HOG detector.
        errors: of poses and mount, where distances follow from boxes; those of the boxes are the detector's own.
        on_streets: whether the pictures are of real streets, of which detectors miss more cars.

    Raises:
        InputError: a rig without a camera, or an unknown detector.
    """

    def __init__(
        self,
        rig: SensorRig,
        lot: ParkingLot | None,
        detector: str | Detector | None = None,
        errors: RangingErrors | None = None,
        *,
        on_streets: bool = False,
    ) -> None:
        if not (rig.cameras or rig.stereo_cameras):
            raise InputError("the rig has no camera, want at least one")
        self.rig = rig
        self.lot = lot
        self.detector = make_detector(detector)
        own = getattr(self.detector, "errors", DetectorErrors())
        self.errors = (errors or RangingErrors())._replace(detector=own.on_streets if on_streets else own)
        # On streets much resembles a car a little: hedges, walls, cars behind others.
        self._hides_from, self._occluded = (PROBABILITY, 0.2) if on_streets else (0.0, OCCLUDED)
        self._concurrent = getattr(self.detector, "concurrent", False)

    def process(
        self,
        captured: TimedCapture,
        slots: SlotFilter,
        vehicle: FloatArray | Callable[[Sequence[RangeScan]], FloatArray] | None = None,
    ) -> PerceptionResult:
        """Process one capture, and update the slots from its observations.

        Args:
            captured: capture of the pipeline's rig.
            slots: the filter to update.
            vehicle: (3,) estimated x, y, yaw of the vehicle, or a function that estimates it from the scans in the
                vehicle's frame; None: the true pose.
        """
        return self.update_slots(slots, self.locate(captured, vehicle, slots.headings_near))

    def locate(
        self,
        captured: TimedCapture,
        vehicle: FloatArray | Callable[[Sequence[RangeScan]], FloatArray] | None = None,
        headings_near: Callable[[FloatArray], FloatArray] | None = None,
        seen: Seen | None = None,
    ) -> PerceptionResult:
        """Find and locate the cars of one capture, without slots; see `process` and `localize_boxes`.

        What a capture has `seen` already is not looked for again.
        """
        seen = seen or self.look(captured)
        vehicle = captured.capture.pose if vehicle is None else vehicle
        views = []
        at = np.zeros(3) if callable(vehicle) else vehicle
        scans = self._range_scans(captured.capture, seen.disparities, at)  # T §3.2.3
        if callable(vehicle):
            vehicle = vehicle(tuple(scans.values()))
            scans = {name: scan.placed(vehicle) for name, scan in scans.items()}
        sensors = [name for name, *_ in self.rig.lasers or self.rig.stereo_cameras]
        for name, camera, mount, image in self._images(captured.capture):
            detections = seen.detections[name]
            hiding = None
            if scans:
                scan = scans[name if name in sensors else sensors[0]]
                scan = scan.seen_from(*mount.in_world(vehicle)[:2])
                cars = localize_cars(detections, scan, camera, mount, vehicle)  # eq. 3.2
            else:
                x, y, _ = mount.in_world(vehicle)
                scan, ground = RangeScan(x, y, np.empty(0), np.empty(0), 0.0), GroundView(camera, mount)
                cars = localize_boxes(detections, ground, vehicle, self.errors, headings_near)
                hides = detections.probability >= self._hides_from
                hiding = self.errors.detector.corrected(detections.boxes[hides])
            confirmed = detections.probability >= PROBABILITY
            confirmed[cars.detection] = True
            cars = dataclasses.replace(cars, detection=np.cumsum(confirmed)[cars.detection] - 1)
            detections = detections.select(confirmed)
            stereo = None if self.rig.lasers else seen.disparities.get(name)
            nowhere = np.full(len(cars), -1, dtype=np.int64)
            views.append(
                CameraView(name, camera, mount, image, detections, scan, stereo, cars, nowhere, hiding)
            )
        fresh = (scan for name, scan in scans.items() if name not in captured.capture.again)
        return PerceptionResult(captured, vehicle, tuple(views), tuple(fresh))

    def update_slots(self, slots: SlotFilter, result: PerceptionResult) -> PerceptionResult:
        """Update the slots from a located capture (T §3.3.2); return it with the slots of its cars."""
        for scan in result.scans:
            slots.update_from_scan(scan)
        views = []
        for view in result.views:
            if view.hiding is not None:
                ground = GroundView(view.camera, view.mount)
                slots.update_from_picture(ground, result.vehicle, view.hiding, self.errors, self._occluded)
            views.append(dataclasses.replace(view, slots=slots.update_from_cars(view.cars)))
        return dataclasses.replace(result, views=tuple(views))

    def observe(
        self, captures: Sequence[TimedCapture]
    ) -> tuple[tuple[PerceptionResult, ...], SlotObservation]:
        """Process the captures of one step together, without evidence from earlier steps.

        Returns:
            The result of each capture, and the observed slots with their states.
        """
        if self.lot is None:
            raise InputError("the pipeline has no lot, want one with the slots to observe")
        slots = SlotFilter(self.lot)
        every = in_threads(self.look, captures) if self._concurrent else map(self.look, captures)
        results = tuple(
            self.update_slots(slots, self.locate(captured, None, slots.headings_near, seen))
            for captured, seen in zip(captures, every, strict=True)
        )
        return results, slots.observation()

    def look_ahead(self, captures: Iterable[TimedCapture]) -> Iterator[tuple[TimedCapture, Seen]]:
        """Yield captures and what they have seen, in order; the next ones are looked at in threads meanwhile."""
        return (
            ahead_in_threads(self.look, captures)
            if self._concurrent
            else ((c, self.look(c)) for c in captures)
        )

    def levelled(self, looked: Sequence[tuple[TimedCapture, Seen]]) -> PerceptionPipeline:
        """Return the pipeline with the pitch of its cameras that the cars of a drive tell; see `street_pitch`."""
        cameras, left = [], [0.0]
        for name, camera, mount in self.rig.cameras:
            views = [
                (seen.detections[name], GroundView(camera, mount.tilted(*captured.capture.tilt)))
                for captured, seen in looked
            ]
            pitch, error = street_pitch(views, self.errors)
            cameras.append((name, camera, dataclasses.replace(mount, pitch=mount.pitch + pitch)))
            left.append(error)
        pipeline = copy.copy(self)
        pipeline.rig = dataclasses.replace(self.rig, cameras=tuple(cameras))
        pipeline.errors = self.errors._replace(pitch=max(left))
        return pipeline

    def look(self, captured: TimedCapture) -> Seen:
        """Find the cars in the pictures of a capture, and the disparities of its stereo pairs."""
        capture = captured.capture
        if self._concurrent and self.rig.stereo_cameras:
            of: list[Callable[[Capture], Any]] = [self._detections, self._disparities]
            return Seen(*in_threads(lambda part: part(capture), of))
        return Seen(self._detections(capture), self._disparities(capture))

    def _detections(self, capture: Capture) -> dict[str, Detections]:
        return {
            name: detect_in(self.detector, image, ground_band(camera, mount))  # T §3.2.1, §3.2.2
            for name, camera, mount, image in self._images(capture)
        }

    def _disparities(self, capture: Capture) -> dict[str, tuple[StereoCamera, NDArray[np.float32]]]:
        return {
            name: (stereo, disparity(capture.pairs[name], stereo))
            for name, stereo, _ in self.rig.stereo_cameras
        }

    def _range_scans(
        self,
        capture: Capture,
        disparities: dict[str, tuple[StereoCamera, NDArray[np.float32]]],
        vehicle: FloatArray,
    ) -> dict[str, RangeScan]:
        lasers = {
            name: scan_from_laser(
                laser, mount, capture.vehicle_at(name, vehicle), capture.scans[name], capture.tops.get(name)
            )
            for name, laser, mount in self.rig.lasers
        }
        return lasers | {
            name: scan_from_stereo(camera, mount, vehicle, disparities[name][1])
            for name, camera, mount in self.rig.stereo_cameras
        }

    def _images(self, capture: Capture) -> list[tuple[str, PinholeCamera, Mount, NDArray[np.uint8]]]:
        tilt = capture.tilt
        return [
            *(
                (name, camera, m.tilted(*tilt), capture.images[name].image)
                for name, camera, m in self.rig.cameras
            ),
            *(
                (name, stereo.camera, m.tilted(*tilt), capture.pairs[name].left.image)
                for name, stereo, m in self.rig.stereo_cameras
            ),
        ]


def localize_as_thesis(view: CameraView, vehicle: FloatArray) -> LocatedCars:
    """Locate the detections of a view as the thesis does, by the median range in each box (T §3.2.3), to compare."""
    if view.stereo is not None:
        stereo, disparity_px = view.stereo
        return localize_disparity(view.detections, disparity_px, stereo, view.mount, vehicle)
    return localize_median(view.detections, view.scan, view.camera, view.mount, vehicle)
