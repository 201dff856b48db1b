"""Make the drive of a real car, or a recorded one, a session of a map file: with a lot, or of an unknown street."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, require
from parkenv.files.atomic_write import make_folder
from parkenv.files.csv_tables import write_csv
from parkenv.files.known_names import SCENARIO_NAMES, LocaliserName
from parkenv.lots.formats.geojson import read_contents
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.lot_files import lot_format
from parkenv.mapping.inference import SessionLog, predict
from parkenv.mapping.map_files import week_time, write_grid, write_slots
from parkenv.mapping.recordings.calibration import DriveCalibration
from parkenv.mapping.recordings.folders import source_of
from parkenv.mapping.recordings.located_drive import (
    CAR_COLUMNS,
    LocatedDrive,
    MappedDrive,
    locate_cars,
    map_drive,
)
from parkenv.mapping.recordings.photo_options import PhotoOptions
from parkenv.mapping.recordings.recorded_drive import RecordedDrive
from parkenv.mapping.store import MapStore
from parkenv.perception.detector import Detector
from parkenv.scenarios.build import make_scenario
from parkenv.show.figures.survey import save_map
from parkenv.studies.results import Row
from parkenv.studies.sensing.sessions import MAP_FILE
from parkenv.studies.study import Progress, counted
from parkenv.world.lot import ParkingLot
from parkenv.world.scenario import Scenario

SIGHTING_COLUMNS = (
    "time_s", "camera", "x_m", "y_m", "yaw_rad", "probability", "distance_m", "distance_std_m",
    "position_std_m", "slot",
)  # fmt: skip


@dataclass(frozen=True)
class DriveReader:
    """How recordings are read, and the cars in them located.

    Without a `calibration`, a recording has sensors, mounts and topics. Captures are at least `every` m apart. What
    corrects the recorded poses is `none`, or `scan-matching`, for which they are drifting odometry. `photos` says of
    photographs or a film where the poses are, and what the camera is.
    """

    detector: Detector
    calibration: DriveCalibration | None = None
    every: float = 0.0
    localise: LocaliserName = "none"
    photos: PhotoOptions = field(default_factory=PhotoOptions)
    progress: Progress = lambda *_: None

    def read(self, recording: Path, frame: LocalFrame | None) -> RecordedDrive:
        """Read what `source_of` can; the frame says where poses in degrees are, None: around them."""
        self.progress("Reading", 0, 0)
        if self.photos.origin is not None:
            frame = LocalFrame(self.photos.origin[1], self.photos.origin[0])
        source = source_of(recording, self.calibration, self.photos, frame)
        drive = RecordedDrive(recording, self.calibration, source, frame)
        if self.localise != "none" and not (drive.rig.lasers or drive.rig.stereo_cameras):
            wanted = f"want none: {recording} has no laser nor stereo camera"
            raise InputError(f"localise is {self.localise!r}, {wanted}")
        return drive

    def locate(self, drive: RecordedDrive, lot: ParkingLot | None = None) -> LocatedDrive:
        on_frame = counted(self.progress, "Locating cars")
        return locate_cars(
            drive, self.detector, lot, every=self.every, localise=self.localise, on_frame=on_frame
        )


def add_recording(
    recording: Path,
    scenario: Scenario | None,
    folder: Path,
    reader: DriveReader,
    *,
    lot_file: Path | None = None,
) -> Row:
    """Add a recorded drive to the map in a folder, and write its tables, pictures and files for other programs.

    A lot file in degrees says where poses in degrees are. Without a scenario, the drive is one of `parkenv survey`,
    which names its own. Return what was found: captures, slots seen and taken, cars, and the errors and largest
    correction of poses, m.
    """
    is_geographic = lot_file is not None and lot_format(lot_file) == "native"
    frame = read_contents(lot_file).frame if lot_file is not None and is_geographic else None
    drive = reader.read(recording, frame)
    scenario = scenario or _scenario_of(drive)
    drive.require_near(scenario.lot)
    make_folder(folder)
    with MapStore(folder / MAP_FILE, scenario.lot) as store:
        require(not store.has(drive.key), f"{folder / MAP_FILE}: holds the drive {drive.key!r} already")
        found = map_drive(reader.locate(drive, scenario.lot), scenario.lot)
        store.add(found.session)
        log = store.log()
    title = f"{scenario.name}, {week_time(found.session.time)}"
    save_map(scenario.lot, predict(log, found.session.time), None, title, folder / "slots.png")
    write_drives(folder, scenario.lot, log, frame, [found])
    return drive_row(found)


def write_drives(
    folder: Path,
    lot: ParkingLot,
    log: SessionLog,
    frame: LocalFrame | None,
    drives: Sequence[MappedDrive],
    of_slots: Sequence[dict[str, Any]] = (),
    kerbs: Sequence[FloatArray] = (),
) -> None:
    """Write the slots of a map, and the cars and the occupancy grid of its new drives."""
    write_slots(folder / "slots.geojson", lot, log, frame, of_slots, kerbs)
    write_csv(folder / "cars.csv", CAR_COLUMNS, [row for one in drives for row in one.cars])
    write_csv(folder / "sightings.csv", SIGHTING_COLUMNS, [row for one in drives for row in one.sightings])
    grid = drives[-1].grid
    for one in drives[:-1]:
        grid.merge(one.grid)
    write_grid(grid, folder)


def _scenario_of(drive: RecordedDrive) -> Scenario:
    """Return the scenario that a drive of `parkenv survey` was recorded in."""
    name = drive.head.key.partition("/")[0] if drive.head else ""
    if name not in SCENARIO_NAMES:
        raise InputError(
            f"{drive.path}: was not made by parkenv survey; want --lot FILE with its slots, or --discover to find them"
        )
    return make_scenario(name)


def drive_row(found: MappedDrive) -> Row:
    """Return what a drive has found, for tables."""
    located, drive = found.located, found.located.drive
    states, std = found.states, [car["distance_std_m"] for car in found.sightings if "distance_std_m" in car]
    return {
        "recording": str(drive.path),
        "key": drive.key,
        "begins": week_time(found.session.time),
        "captures": len(located.results),
        "pictures_without_pose": drive.without_pose,
        **({"pictures_without_partner": partly} if (partly := drive.without_partner) else {}),
        "slots": len(states.in_view),
        "seen": int(states.in_view.sum()),
        "taken": int((states.occupied & states.in_view).sum()),
        "cars_sighted": len(found.session.cars),
        "sighted_in_slots": sum(car["slot"] != "" for car in found.sightings),
        "cars": len(found.cars),
        "corrected_m": round(located.corrected_m, 3),
        **({"pose_error_m": round(drive.errors.position, 3)} if drive.errors else {}),
        **({"distance_std_m": round(float(np.median(std)), 3)} if std else {}),
    }
