"""Make the drive of a real car, or a recorded one, a session of a map file."""

from __future__ import annotations

from pathlib import Path

from parkenv.errors import InputError
from parkenv.files.atomic_write import make_folder
from parkenv.files.known_names import LocaliserName
from parkenv.mapping.drive_calibration import DriveCalibration
from parkenv.mapping.inference import predict
from parkenv.mapping.recorded_drive import RecordedDrive, map_drive
from parkenv.mapping.store import MapStore
from parkenv.perception.detector_registry import make_detector
from parkenv.show.figures.survey import save_map
from parkenv.studies.results import Row
from parkenv.studies.sensing.sessions import MAP_FILE
from parkenv.studies.study import Progress, counted
from parkenv.world.scenario import Scenario


def add_recording(
    recording: Path,
    scenario: Scenario,
    folder: Path,
    *,
    calibration: DriveCalibration | None = None,
    detector: str = "hog",
    every: float = 0.0,
    localise: LocaliserName = "none",
    progress: Progress = lambda *_: None,
) -> Row:
    """Add a recorded drive to the map in a folder, and draw the map.

    Args:
        recording: an MCAP file or a rosbag.
        scenario: the lot that was driven through.
        folder: holds the map, and gets the picture.
        calibration: sensors, mounts and topics; None for those of the recording.
        detector: what looks at the images.
        every: least distance between captures, m.
        localise: what corrects the poses.
        progress: called as captures are mapped; how many there will be is not known.

    Returns:
        What was found: captures, slots seen and taken, cars, and the largest correction of a pose, m.

    Raises:
        InputError: the recording cannot be read, or the map holds it already.
    """
    finder = make_detector(detector)
    progress("Reading", 0, 0)
    drive = RecordedDrive(recording, calibration)
    make_folder(folder)
    with MapStore(folder / MAP_FILE, scenario.lot) as store:
        if store.has(drive.key):
            raise InputError(f"{folder / MAP_FILE}: holds the drive {drive.key!r} already")
        found = map_drive(drive, scenario.lot, finder, every, counted(progress, "Mapping"), localise)
        store.add(found.session)
        log = store.log()
    save_map(
        scenario.lot,
        predict(log, found.session.time),
        None,
        f"{scenario.name}: {drive.key}",
        folder / "map.png",
    )
    states = found.states
    return {
        "recording": str(recording),
        "key": drive.key,
        "captures": found.frames,
        "slots": scenario.lot.n_slots,
        "seen": int(states.in_view.sum()),
        "taken": int((states.occupied & states.in_view).sum()),
        "cars_located": len(found.session.cars),
        "corrected_m": round(found.corrected_m, 3),
    }
