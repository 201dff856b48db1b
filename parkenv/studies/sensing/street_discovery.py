"""Map an unknown street: a lot of the parked cars that recorded drives have passed, and the map of its slots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, naming, require
from parkenv.files.atomic_write import make_folder, write_together
from parkenv.files.limited_reading import read_json
from parkenv.files.spec_file import Several, Spec
from parkenv.lots.draft import Provenance
from parkenv.lots.formats.geojson import write_lot
from parkenv.lots.generators import Slots
from parkenv.lots.local_frame import LocalFrame
from parkenv.lots.lot_files import read_lot
from parkenv.mapping.car_tracks import ParkedCars
from parkenv.mapping.recordings.located_drive import LocatedDrive, MappedDrive, map_drive
from parkenv.mapping.store import MapStore, Session
from parkenv.mapping.street_lanes import driven_lanes, mapped_lanes, street_lot
from parkenv.mapping.street_slots import CAR, GAP, LONE_CAR, ONCE, StreetSlots, discover_street
from parkenv.perception.slot_filter import SlotFilter
from parkenv.studies.results import Row
from parkenv.studies.sensing.recorded_session import DriveReader, drive_row, write_drives
from parkenv.studies.sensing.sessions import MAP_FILE
from parkenv.world.lot import Lane, ParkingLot

LOT_FILE = "lot.geojson"
_SAME_M = 1.5  # m, within which a slot of an earlier map is the same
_FREE = 0.3  # P(taken) below which scans show a place to be free


@dataclass(frozen=True, eq=False)
class _Earlier:
    """The map of earlier drives past the same street."""

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
    recordings: Sequence[Path],
    folder: Path,
    reader: DriveReader,
    *,
    streets: Path | None = None,
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
    if streets is not None and frame is None:
        raise InputError(f"{streets}: is in degrees, and the poses are in metres; want poses in degrees")
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
