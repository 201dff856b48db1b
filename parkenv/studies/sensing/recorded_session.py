"""Make the drive of a real car, or a recorded one, a session of a map file: with a lot, or of an unknown street."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, naming, require
from parkenv.files.atomic_write import make_folder, write_together
from parkenv.files.csv_tables import write_csv
from parkenv.files.known_names import SCENARIO_NAMES, LocaliserName
from parkenv.files.limited_reading import read_json
from parkenv.files.spec_file import Several, Spec
from parkenv.lots.draft import Provenance
from parkenv.lots.formats.geojson import read_contents, write_lot
from parkenv.lots.generators import Slots
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.lot_files import lot_format, read_lot
from parkenv.mapping.car_tracks import ParkedCars
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
from parkenv.mapping.store import MapStore, Session
from parkenv.mapping.street_lanes import driven_lanes, mapped_lanes, street_lot
from parkenv.mapping.street_slots import CAR, GAP, LONE_CAR, ONCE, StreetSlots, discover_street
from parkenv.perception.detector import Detector
from parkenv.perception.slot_filter import SlotFilter
from parkenv.scenarios.build import make_scenario
from parkenv.show.figures.survey import save_map
from parkenv.studies.results import Row
from parkenv.studies.sensing.sessions import MAP_FILE
from parkenv.studies.study import Progress, counted
from parkenv.world.lot import Lane, ParkingLot
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
    require(
        name in SCENARIO_NAMES,
        f"{drive.path}: was not made by parkenv survey; want --lot FILE with its slots, or --discover to find them",
    )
    return make_scenario(name)


def drive_row(found: MappedDrive) -> Row:
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


LOT_FILE = "lot.geojson"
_SAME_M = 1.5  # m, within which a slot of an earlier map is the same
_FREE = 0.3  # P(taken) below which scans show a place to be free


@dataclass(frozen=True, eq=False)
class _Earlier:
    lot: ParkingLot | None = None
    frame: LocalFrame | None = None
    tracks: tuple[FloatArray, ...] = ()
    cars: tuple[ParkedCars, ...] = ()
    sessions: tuple[Session, ...] = ()


class _Drives(Spec):
    """What a lot's file says of the drives that it was made of."""

    origin: Several[float] | None = Field(min_length=2, max_length=2)  # latitude and longitude
    tracks: Several[Several[Several[float]]]


def discover_recordings(
    recordings: Sequence[Path], folder: Path, reader: DriveReader, *, streets: Path | None = None
) -> list[Row]:
    """Make a lot and its map from drives past an unknown street, and from those that are in the folder already.

    The lanes are those of the map `streets`, else the driven track. Return what each drive has found.
    """
    earlier = _read_earlier(folder) if (folder / LOT_FILE).exists() else _Earlier()
    frame = earlier.frame
    drives: list[LocatedDrive] = []
    for recording in recordings:
        drive = reader.read(recording, frame)
        frame = frame or drive.frame
        known = {one.drive.key for one in drives} | {one.key for one in earlier.sessions}
        require(drive.key not in known, f"{folder / MAP_FILE}: holds the drive {drive.key!r} already")
        drives.append(reader.locate(drive))
    tracks = [*earlier.tracks, *(one.track for one in drives)]
    require(
        streets is None or frame is not None,
        f"{streets}: is in degrees, and the poses are in metres; want poses in degrees",
    )
    lanes = driven_lanes(tracks) if streets is None or frame is None else mapped_lanes(streets, frame, tracks)
    cars = [*earlier.cars, *(one.parked for one in drives)]
    found = discover_street(cars, tracks, lambda slots: _shown_free(slots, lanes, drives))
    lot, found = street_lot(folder.absolute().name, found, lanes, fit=streets is None)
    lot, sessions = _continued(lot, earlier)
    mapped = [map_drive(one, lot) for one in drives]
    sessions += [one.session for one in mapped]
    make_folder(folder)
    with write_together(folder) as beside:
        _write(beside, lot, found, frame, tracks, sessions, mapped, recordings, streets)
    return [
        drive_row(one)
        | {"from_cars": int((found.source != GAP).sum()), "guessed": int((found.source != CAR).sum())}
        for one in mapped
    ]


def _shown_free(slots: Slots, lanes: Sequence[Lane], drives: Sequence[LocatedDrive]) -> np.ndarray[Any, Any]:
    """Return whether the scans of the drives pass over slots, (n,) bool."""
    n = len(slots)
    of_gaps = StreetSlots(slots, np.full(n, CAR), np.zeros(n, np.int64), np.full(n, np.nan))
    try:
        lot, _ = street_lot("gaps", of_gaps, lanes)
    except InputError:
        return np.zeros(n, np.bool_)
    shown = SlotFilter(lot)
    for one in drives:
        for _ in one.update(shown):
            pass
    states = shown.states()
    free = lot.slot_xy[states.in_view & (states.p_occupied < _FREE)]
    return np.asarray((slots.xy[:, None] == free[None]).all(axis=2).any(axis=1))


def _continued(lot: ParkingLot, earlier: _Earlier) -> tuple[ParkingLot, list[Session]]:
    """Give slots at the place of an earlier one its id and sessions, and others new ids."""
    if earlier.lot is None:
        return lot, []
    away = np.hypot(*(lot.slot_xy[:, None] - earlier.lot.slot_xy[None]).transpose(2, 0, 1))
    nearest, back = away.argmin(axis=1), away.argmin(axis=0)
    is_same = (away.min(axis=1) <= _SAME_M) & (back[nearest] == np.arange(lot.n_slots))
    names = earlier.lot.slot_ids
    new = count(1 + max((int(name) for name in names if name.isdecimal()), default=0))
    ids = [names[k] if same else str(next(new)) for k, same in zip(nearest, is_same, strict=True)]
    sessions = [replace(one, p_occupied=np.where(is_same, one.p_occupied[nearest], np.nan))
                for one in earlier.sessions]  # fmt: skip
    return replace(lot, slot_ids=tuple(ids)), sessions


def _write(
    folder: Path,
    lot: ParkingLot,
    found: StreetSlots,
    frame: LocalFrame | None,
    tracks: Sequence[FloatArray],
    sessions: Sequence[Session],
    mapped: Sequence[MappedDrive],
    recordings: Sequence[Path],
    streets: Path | None,
) -> None:
    from parkenv.show.figures.lots import save_street  # loads Matplotlib

    of_slots = [
        {"from": source} | ({"sightings": n, "std_m": round(std, 3)} if source != GAP else {})
        for source, n, std in zip(
            found.source.tolist(), found.sightings.tolist(), found.std.tolist(), strict=True
        )
    ]
    counts = {kind: int((found.source == kind).sum()) for kind in (GAP, ONCE, LONE_CAR)}
    provenance = Provenance(
        ", ".join(path.name for path in recordings),
        (
            f"slots: {counts[GAP]} from gaps between parked cars, {counts[ONCE] + counts[LONE_CAR]} from cars that "
            "were seen once or stand alone; driveways and rules of parking are unknown",
            "lanes: where the drives went, open to both directions"
            if streets is None
            else "lanes: those of the map",
            "entry: the ends of the lanes",
            "goal: the middle of the slots",
        ),
        caution="slots without a car, or beyond the ends of a row, are missing",
    )
    drives = {
        "origin": None if frame is None else [frame.lat, frame.lon],
        "tracks": [np.round(track, 2).tolist() for track in tracks],
    }
    write_lot(lot, folder / LOT_FILE, provenance, members={"drives": drives}, of_slots=of_slots)
    with MapStore(folder / MAP_FILE, lot) as store:
        for session in sessions:
            store.add(session)
        log = store.log()
    write_drives(folder, lot, log, frame, mapped, of_slots, found.kerbs)
    save_street(lot, found, tracks, log, folder / "slots.png")


def _read_earlier(folder: Path) -> _Earlier:
    file = folder / LOT_FILE
    lot, document = read_lot(file), read_json(file)
    with naming(file):
        require(isinstance(document.get("drives"), dict), "is no lot of --discover; want another --out")
    drives = _Drives.parse(document["drives"], f"{file}: drives")
    of_slots = [f["properties"] for f in document["features"] if f["properties"]["kind"] == "slot"]
    cars = [i for i, slot in enumerate(of_slots) if slot.get("from", GAP) != GAP]
    try:
        std, sightings = (
            np.array([float(of_slots[i][name]) for i in cars]) for name in ("std_m", "sightings")
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{file}: a slot is not as --discover wrote it: {error}") from error
    size, unknown = np.column_stack([lot.slot_length[cars], lot.slot_width[cars]]), np.zeros(len(cars))
    known = ParkedCars(
        lot.slot_xy[cars], lot.slot_yaw[cars] % np.pi, size, std, unknown + 1.0, sightings.astype(np.int64), unknown,
        unknown,
    )  # fmt: skip
    frame = LocalFrame(drives.origin[1], drives.origin[0]) if drives.origin else None
    tracks = tuple(np.array(track).reshape(-1, 2) for track in drives.tracks)
    with MapStore(folder / MAP_FILE, lot, create=False) as store:
        require(not store.trips(), f"{folder / MAP_FILE}: holds searches in its slots; want another --out")
        return _Earlier(lot, frame, tracks, (known,), tuple(store.sessions()))
