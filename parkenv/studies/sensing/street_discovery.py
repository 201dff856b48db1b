"""Map an unknown street: a lot of the parked cars that recorded drives have passed, and the map of its slots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, naming, require
from parkenv.files.atomic_write import make_folder, write_together
from parkenv.files.csv_tables import write_csv
from parkenv.files.known_names import LocaliserName
from parkenv.files.limited_reading import read_json
from parkenv.lots.draft import Provenance
from parkenv.lots.formats.geojson import write_lot
from parkenv.lots.generators import Slots
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.lot_files import read_lot
from parkenv.mapping.car_tracks import CarTracks, ParkedCars
from parkenv.mapping.drive_calibration import DriveCalibration
from parkenv.mapping.map_files import write_grid, write_slots
from parkenv.mapping.photo_options import PhotoOptions
from parkenv.mapping.recorded_drive import (
    CAR_COLUMNS,
    MappedDrive,
    RecordedDrive,
    mapped_drive,
    require_ranges,
)
from parkenv.mapping.scan_matching import make_locate
from parkenv.mapping.store import MapStore, Session
from parkenv.mapping.street_lanes import driven_lanes, mapped_lanes, street_lot
from parkenv.mapping.street_slots import CAR, GAP, LONE_CAR, ONCE, StreetSlots, discover_street
from parkenv.mapping.survey import SessionMap
from parkenv.perception.detector import Detector
from parkenv.perception.detector_registry import make_detector
from parkenv.perception.pipeline import PerceptionPipeline, PerceptionResult
from parkenv.perception.slot_filter import SlotFilter
from parkenv.studies.results import Row
from parkenv.studies.sensing.recorded_session import SIGHTING_COLUMNS, drive_row, read_drive
from parkenv.studies.sensing.sessions import MAP_FILE
from parkenv.studies.study import Progress, counted
from parkenv.world.lot import Lane, ParkingLot

LOT_FILE, SLOTS_FILE = "lot.geojson", "slots.geojson"
_SAME_M = 1.5  # m, within which a slot of an earlier map is the same
_FREE = 0.3  # P(taken) below which scans show a place to be free


@dataclass(frozen=True, eq=False)
class _Located:
    """A drive with what was located in each capture."""

    drive: RecordedDrive
    pipeline: PerceptionPipeline
    results: list[tuple[PerceptionResult, FloatArray]]  # and the recorded pose

    @property
    def track(self) -> FloatArray:
        return np.array([result.vehicle[:2] for result, _ in self.results])


@dataclass(frozen=True, eq=False)
class _Earlier:
    """The map of earlier drives past the same street."""

    lot: ParkingLot
    frame: LocalFrame | None
    tracks: tuple[FloatArray, ...]
    cars: ParkedCars
    sessions: tuple[Session, ...]


def discover_recordings(
    recordings: Sequence[Path],
    folder: Path,
    *,
    calibration: DriveCalibration | None = None,
    detector: str = "hog",
    every: float = 0.0,
    localise: LocaliserName = "none",
    photos: PhotoOptions | None = None,
    streets: Path | None = None,
    progress: Progress = lambda *_: None,
) -> list[Row]:
    """Make a lot and its map from drives past an unknown street, and from those that are in the folder already.

    The arguments are those of `add_recording`; the lanes are those of the map `streets`, else the driven track. Return
    what each drive has found.
    """
    finder = make_detector(detector)
    progress("Reading", 0, 0)
    earlier = _read_earlier(folder) if (folder / LOT_FILE).exists() else None
    frame = earlier.frame if earlier else None
    drives: list[_Located] = []
    for recording in recordings:
        drive = read_drive(recording, calibration, photos, frame)
        frame = frame or drive.frame
        known = {one.drive.key for one in drives} | {one.key for one in (earlier.sessions if earlier else ())}
        require(drive.key not in known, f"{folder / MAP_FILE}: holds the drive {drive.key!r} already")
        drives.append(_located(drive, finder, every, localise, progress))
    tracks = [*(earlier.tracks if earlier else ()), *(one.track for one in drives)]
    lanes = _lanes(streets, frame, tracks)
    cars = [*([earlier.cars] if earlier else []), *(_parked_cars(one) for one in drives)]
    found = discover_street(cars, tracks, lambda slots: _shown_free(slots, lanes, drives))
    lot, found = street_lot(folder.absolute().name, found, lanes, fit=streets is None)
    same = _same_slots(lot, earlier.lot) if earlier else np.full(lot.n_slots, -1)
    lot = _with_ids(lot, same, earlier.lot if earlier else None)
    mapped = [_mapped(one, lot) for one in drives]
    sessions = [*(_of_lot(session, same) for session in (earlier.sessions if earlier else ()))]
    sessions += [one.session for one in mapped]
    make_folder(folder)
    with write_together(folder) as beside:
        _write(beside, lot, found, frame, tracks, sessions, mapped, recordings, streets)
    return [
        drive_row(one.drive, of_drive) | {"from_cars": int((found.source != GAP).sum()),
                                          "guessed": int((found.source != CAR).sum())}
        for one, of_drive in zip(drives, mapped, strict=True)
    ]  # fmt: skip


def _lanes(streets: Path | None, frame: LocalFrame | None, tracks: Sequence[FloatArray]) -> list[Lane]:
    if streets is None:
        return driven_lanes(tracks)
    if frame is None:
        raise InputError(f"{streets}: is in degrees, and the poses are in metres; want poses in degrees")
    return mapped_lanes(streets, frame, tracks)


def _located(
    drive: RecordedDrive, detector: Detector, every: float, localise: str, progress: Progress
) -> _Located:
    require_ranges(drive, localise)
    pipeline = PerceptionPipeline(drive.rig, None, detector, drive.errors, on_streets=drive.head is None)
    locate, results = make_locate(localise, None), []
    on_frame = counted(progress, "Locating cars")
    for captured, recorded in drive.captures(every):
        results.append((_light(pipeline.locate(captured, locate(recorded))), recorded))
        on_frame()
    return _Located(drive, pipeline, results)


def _light(result: PerceptionResult) -> PerceptionResult:
    """Return a result without pictures, so that those of a whole drive can be kept."""
    captured = result.captured
    captured = captured._replace(capture=replace(captured.capture, images={}, pairs={}))
    views = tuple(replace(v, image=np.empty((0, 0, 3), np.uint8), stereo=None) for v in result.views)
    return replace(result, captured=captured, views=views)


def _parked_cars(located: _Located) -> ParkedCars:
    tracks = CarTracks()
    for result, _ in located.results:
        for view in result.views:
            tracks.add(result.captured.time, view)
    return tracks.cars(located.track)


def _mapped(located: _Located, lot: ParkingLot) -> MappedDrive:
    mapped = SessionMap(located.pipeline, lot, "none")
    results = (
        (mapped.record(located.pipeline.update_slots(mapped.slots, result)), recorded)
        for result, recorded in located.results
    )
    return mapped_drive(located.drive, lot, mapped, results)


def _shown_free(slots: Slots, lanes: Sequence[Lane], drives: Sequence[_Located]) -> np.ndarray[Any, Any]:
    """Return whether the scans of the drives pass over slots, (n,) bool."""
    n = len(slots)
    of_gaps = StreetSlots(slots, np.full(n, CAR), np.zeros(n, np.int64), np.full(n, np.nan))
    try:
        lot, _ = street_lot("gaps", of_gaps, lanes)
    except InputError:
        return np.zeros(n, np.bool_)
    shown = SlotFilter(lot)
    for one in drives:
        for result, _ in one.results:
            one.pipeline.update_slots(shown, result)
    states = shown.states()
    free = lot.slot_xy[states.in_view & (states.p_occupied < _FREE)]
    return np.asarray((slots.xy[:, None] == free[None]).all(axis=2).any(axis=1))


def _same_slots(lot: ParkingLot, earlier: ParkingLot) -> np.ndarray[Any, Any]:
    """Return the slot of an earlier lot at the place of each slot, (n_slots,); -1 for a new one."""
    away = np.hypot(*(lot.slot_xy[:, None] - earlier.slot_xy[None]).transpose(2, 0, 1))
    nearest, back = away.argmin(axis=1), away.argmin(axis=0)
    is_same = (away.min(axis=1) <= _SAME_M) & (back[nearest] == np.arange(lot.n_slots))
    return np.where(is_same, nearest, -1)


def _with_ids(lot: ParkingLot, same: np.ndarray[Any, Any], earlier: ParkingLot | None) -> ParkingLot:
    """Give slots of an earlier lot their ids, and others new ones."""
    if earlier is None:
        return lot
    used = [int(name) for name in earlier.slot_ids if name.isdecimal()]
    new = iter(range(max(used, default=0) + 1, max(used, default=0) + lot.n_slots + 1))
    ids = tuple(earlier.slot_ids[k] if k >= 0 else str(next(new)) for k in same.tolist())
    return replace(lot, slot_ids=ids)


def _of_lot(session: Session, same: np.ndarray[Any, Any]) -> Session:
    return replace(session, p_occupied=np.where(same >= 0, session.p_occupied[same], np.nan))


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
    from parkenv.show.figures.street import save_street  # loads Matplotlib

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
    write_slots(folder / SLOTS_FILE, lot, log, frame, of_slots, found.kerbs)
    write_csv(folder / "cars.csv", CAR_COLUMNS, [row for one in mapped for row in one.cars])
    write_csv(folder / "sightings.csv", SIGHTING_COLUMNS, [row for one in mapped for row in one.sightings])
    grid = mapped[-1].grid
    for one in mapped[:-1]:
        grid.merge(one.grid)
    write_grid(grid, folder)
    save_street(lot, found, tracks, log, folder / "slots.png")


def _read_earlier(folder: Path) -> _Earlier:
    lot, document = read_lot(folder / LOT_FILE), read_json(folder / LOT_FILE)
    drives = document.get("drives")
    with naming(folder / LOT_FILE):
        require(isinstance(drives, dict), "is no lot of --discover; want another --out")
        try:
            origin, tracks = (
                drives["origin"],
                tuple(np.array(track, np.float64) for track in drives["tracks"]),
            )
            of_slots = [f["properties"] for f in document["features"] if f["properties"]["kind"] == "slot"]
            cars = [i for i, slot in enumerate(of_slots) if slot.get("from", GAP) != GAP]
            table = np.array([[of_slots[i][name] for name in ("std_m", "sightings")] for i in cars]).reshape(
                -1, 2
            )
            frame = None if origin is None else LocalFrame(origin[1], origin[0])
            require(
                all(track.ndim == 2 and track.shape[1] == 2 and np.isfinite(track).all() for track in tracks),
                "x",
            )
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(
                f"the member drives, or a slot, is not as --discover wrote it: {error}"
            ) from error
    size = np.column_stack([lot.slot_length[cars], lot.slot_width[cars]])
    unknown = np.zeros(len(cars))
    known = ParkedCars(
        lot.slot_xy[cars], lot.slot_yaw[cars] % np.pi, size, table[:, 0], np.ones(len(cars)),
        table[:, 1].astype(np.int64), unknown, unknown,
    )  # fmt: skip
    with MapStore(folder / MAP_FILE, lot, create=False) as store:
        require(not store.trips(), f"{folder / MAP_FILE}: holds searches in its slots; want another --out")
        return _Earlier(lot, frame, tracks, known, tuple(store.sessions()))
