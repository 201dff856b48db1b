"""The cars of a recorded drive, located in each of its captures, and the session of a map that the drive becomes."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.mapping.car_tracks import CarTracks, ParkedCars
from parkenv.mapping.grid import OccupancyGrid
from parkenv.mapping.recordings.recorded_drive import RecordedDrive
from parkenv.mapping.scan_matching import make_locate
from parkenv.mapping.store import Session
from parkenv.mapping.survey import SessionMap
from parkenv.perception.detector import Detector
from parkenv.perception.pipeline import CameraView, PerceptionPipeline, PerceptionResult, Seen
from parkenv.perception.slot_filter import SlotFilter, SlotStates
from parkenv.world.lot import ParkingLot
from sim_sensors.camera.models import Frame, StereoFrame
from sim_sensors.rig import TimedCapture

CAR_COLUMNS = (
    "time_s", "x_m", "y_m", "yaw_rad", "length_m", "width_m", "position_std_m", "probability", "sightings",
    "distance_m", "slot",
)  # fmt: skip
_NONE = np.empty((0, 0), np.float32)
_NO_FRAME = Frame(np.empty((0, 0, 3), np.uint8), _NONE, _NONE, np.empty((0, 0), np.int32))


@dataclass(frozen=True, eq=False)
class LocatedDrive:
    drive: RecordedDrive
    pipeline: PerceptionPipeline
    results: list[PerceptionResult]  # of each capture, without pictures
    corrected_m: float  # m, greatest distance between a recorded pose and what it was corrected to

    @property
    def track(self) -> FloatArray:
        return np.array([result.vehicle[:2] for result in self.results])

    @cached_property
    def parked(self) -> ParkedCars:
        tracks = CarTracks()
        for result in self.results:
            for view in result.views:
                tracks.add(result.captured.time, view)
        return tracks.cars(self.track if self.corrected_m else self.drive.poses[:, :2])

    def update(self, slots: SlotFilter) -> Iterator[PerceptionResult]:
        """Update slots from one capture after another."""
        return (self.pipeline.update_slots(slots, result) for result in self.results)


@dataclass(frozen=True, eq=False)
class MappedDrive:
    session: Session  # the record for the map file
    states: SlotStates  # the filter's final estimate
    grid: OccupancyGrid  # the occupancy grid
    located: LocatedDrive
    cars: list[dict[str, Any]]  # of each: place, size, errors and slot
    sightings: list[dict[str, Any]]  # of each car located in a picture: the same, and the time


def locate_cars(
    drive: RecordedDrive,
    detector: Detector,
    lot: ParkingLot | None = None,
    *,
    every: float = 0.0,
    localise: str = "none",
    on_frame: Callable[[], None] = lambda: None,
) -> LocatedDrive:
    """Locate the cars in captures that are at least `every` m apart; slots of a lot tell the headings of cars.

    Without a ranging sensor the cars of the whole street first tell how high the cameras look.
    """
    on_streets = drive.head is None
    pipeline = PerceptionPipeline(drive.rig, lot, detector, drive.errors, on_streets=on_streets)
    recorded: list[FloatArray] = []

    def captures() -> Iterator[TimedCapture]:
        for captured, pose in drive.captures(every):
            recorded.append(pose)
            on_frame()
            yield captured

    ahead = pipeline.look_ahead(captures())
    looked: Iterator[tuple[TimedCapture, Seen]] = (
        (_without_pictures(captured), seen) for captured, seen in ahead
    )
    if on_streets and not (drive.rig.lasers or drive.rig.stereo_cameras):
        kept = list(looked)
        pipeline, looked = pipeline.levelled(kept), iter(kept)
    locate, results = make_locate(localise, lot), []
    headings_near = None if lot is None else SlotFilter(lot).headings_near
    for k, (captured, seen) in enumerate(looked):
        result = pipeline.locate(captured, locate(recorded[k]), headings_near, seen)
        results.append(replace(result, views=tuple(replace(view, stereo=None) for view in result.views)))
    off = [np.hypot(*(result.vehicle - pose)[:2]) for result, pose in zip(results, recorded, strict=True)]
    return LocatedDrive(drive, pipeline, results, float(max(off, default=0.0)))


def map_drive(located: LocatedDrive, lot: ParkingLot) -> MappedDrive:
    """Return what the session of a drive has mapped."""
    drive, mapped = located.drive, SessionMap(located.pipeline, lot, "none")
    sightings: list[dict[str, Any]] = []
    for result in map(mapped.record, located.update(mapped.slots)):
        for view in result.views:
            sightings += _sightings(result.captured.time, view, lot)
    rig, weather = (drive.head.rig, drive.head.weather) if drive.head else ("recorded", "unknown")
    session = mapped.session(drive.key, drive.start, rig, weather)
    cars = list(_rows_of(located.parked, lot, mapped.slots))
    return MappedDrive(session, mapped.slots.states(), mapped.grid, located, cars, sightings)


def _without_pictures(captured: TimedCapture) -> TimedCapture:
    """Return a capture of which a whole drive can be kept."""
    capture = captured.capture
    images = dict.fromkeys(capture.images, _NO_FRAME)
    pairs = dict.fromkeys(capture.pairs, StereoFrame(_NO_FRAME, _NO_FRAME))
    return captured._replace(capture=replace(capture, images=images, pairs=pairs))


def _rows_of(parked: ParkedCars, lot: ParkingLot, slots: SlotFilter) -> Iterator[dict[str, Any]]:
    numbers = (
        parked.time, parked.xy, parked.yaw, parked.size, parked.std, parked.probability, parked.sightings,
        parked.distance,
    )  # fmt: skip
    of_slots = slots.slots_of(parked.located).tolist()
    for row, slot in zip(np.column_stack(numbers).tolist(), of_slots, strict=True):
        place = [*(round(value, 3) for value in row), lot.slot_ids[slot] if slot >= 0 else ""]
        found: dict[str, Any] = dict(zip(CAR_COLUMNS, place, strict=True))
        yield found | {"sightings": int(found["sightings"])}


def _sightings(time: float, view: CameraView, lot: ParkingLot) -> Iterator[dict[str, Any]]:
    cars = view.cars
    for k, (x, y, yaw) in enumerate(cars.poses.tolist()):
        place = {"time_s": time, "camera": view.name, "x_m": x, "y_m": y, "yaw_rad": yaw}
        slot = int(view.slots[k])
        place |= {"probability": float(cars.probability[k]), "distance_m": float(cars.distance[k])}
        place |= {"slot": lot.slot_ids[slot] if slot >= 0 else ""}
        if cars.distance_std is not None and cars.covariance is not None:
            spread = math.sqrt(np.trace(cars.covariance[k]) / 2.0)
            place |= {"distance_std_m": float(cars.distance_std[k]), "position_std_m": spread}
        yield {name: round(value, 3) if isinstance(value, float) else value for name, value in place.items()}
