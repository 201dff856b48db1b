"""Make the drive of a real car, or a recorded one, a session of a map file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from parkenv.errors import InputError, require
from parkenv.files.atomic_write import make_folder
from parkenv.files.csv_tables import write_csv
from parkenv.files.known_names import LocaliserName
from parkenv.lots.formats.geojson import read_contents
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.lot_files import lot_format
from parkenv.mapping.drive_calibration import DriveCalibration
from parkenv.mapping.drive_formats import source_of
from parkenv.mapping.inference import predict
from parkenv.mapping.photo_options import PhotoOptions
from parkenv.mapping.recorded_drive import RecordedDrive, map_drive
from parkenv.mapping.store import MapStore
from parkenv.perception.detector_registry import make_detector
from parkenv.show.figures.survey import save_map
from parkenv.studies.results import Row
from parkenv.studies.sensing.sessions import MAP_FILE
from parkenv.studies.study import Progress, counted
from parkenv.world.occupancy.arrival_window import DAY_NAMES
from parkenv.world.scenario import Scenario
from parkenv.world.week import DAY_S

CAR_COLUMNS = (
    "time_s", "camera", "x_m", "y_m", "yaw_rad", "distance_m", "distance_std_m", "position_std_m", "slot",
)  # fmt: skip


def add_recording(
    recording: Path,
    scenario: Scenario,
    folder: Path,
    *,
    calibration: DriveCalibration | None = None,
    detector: str = "hog",
    every: float = 0.0,
    localise: LocaliserName = "none",
    photos: PhotoOptions | None = None,
    lot_file: Path | None = None,
    names_lot: bool = True,
    progress: Progress = lambda *_: None,
) -> Row:
    """Add a recorded drive to the map in a folder, draw the map, and list the located cars (`cars.csv`).

    `recording` is what `source_of` reads; `photos` says of photographs or a film where the poses are, and what the
    camera is. Without a `calibration` the recording has sensors, mounts and topics. Captures are at least `every` m
    apart. A lot file in degrees says where poses in degrees are; `names_lot`, whether it was chosen for the drive.
    Return what was found: captures, slots seen and taken, cars, and the errors and largest correction of poses, m.
    """
    finder = make_detector(detector)
    progress("Reading", 0, 0)
    photos = photos or PhotoOptions()
    is_geographic = lot_file is not None and lot_format(lot_file) == "native"
    frame = read_contents(lot_file).frame if lot_file is not None and is_geographic else None
    if photos.origin is not None:
        frame = LocalFrame(photos.origin[1], photos.origin[0])
    source = source_of(recording, calibration, photos, frame)
    drive = RecordedDrive(recording, calibration, source, frame)
    if drive.head is None and not names_lot:
        raise InputError(
            f"{recording}: was not made by parkenv survey; want --lot FILE with its slots, or --discover to find them"
        )
    drive.require_near(scenario.lot)
    make_folder(folder)
    with MapStore(folder / MAP_FILE, scenario.lot) as store:
        require(not store.has(drive.key), f"{folder / MAP_FILE}: holds the drive {drive.key!r} already")
        found = map_drive(drive, scenario.lot, finder, every, counted(progress, "Mapping"), localise)
        store.add(found.session)
        log = store.log()
    day, second = divmod(round(found.session.time), DAY_S)
    begins = f"{DAY_NAMES[int(day) % 7]} {int(second) // 3600:02d}:{int(second) // 60 % 60:02d}"
    map_then = predict(log, found.session.time)
    save_map(scenario.lot, map_then, None, f"{scenario.name}, {begins}", folder / "map.png")
    write_csv(folder / "cars.csv", CAR_COLUMNS, found.cars)
    states, std = found.states, [car["distance_std_m"] for car in found.cars if "distance_std_m" in car]
    return {
        "recording": str(recording),
        "key": drive.key,
        "begins": begins,
        "captures": found.frames,
        "pictures_without_pose": drive.without_pose,
        **({"pictures_without_partner": partly} if (partly := drive.without_partner) else {}),
        "slots": scenario.lot.n_slots,
        "seen": int(states.in_view.sum()),
        "taken": int((states.occupied & states.in_view).sum()),
        "cars_sighted": len(found.session.cars),
        "sighted_in_slots": sum(car["slot"] != "" for car in found.cars),
        "corrected_m": round(found.corrected_m, 3),
        **({"pose_error_m": round(drive.errors.position, 3)} if drive.errors else {}),
        **({"distance_std_m": round(float(np.median(std)), 3)} if std else {}),
    }
