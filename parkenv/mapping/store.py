"""The map file: survey sessions and trips in an SQLite database, one transaction for each."""

import hashlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.files.row_file import Row, RowFile
from parkenv.mapping.inference import SessionLog
from parkenv.mapping.trips import Trip
from parkenv.world.lot import FARTHEST, ParkingLot

MAX_STATES = 50_000_000  # maximum number of sessions times slots, and of observations of trips, that are read
_OBSERVED = ("slots", "after_s", "taken", "hit_rate", "false_alarm_rate")


@dataclass(frozen=True, eq=False)
class Session:
    """One survey drive.

    Attributes:
        key: unique name; a resumed survey skips sessions already stored.
        time: start of the session, s since Monday 00:00.
        rig, weather: names.
        p_occupied: (n_slots,) float64; NaN if the slot was never in view.
        cars: (n, 3) float64, x, y in m and yaw in rad of the located cars.
    """

    key: str
    time: float
    rig: str
    weather: str
    p_occupied: FloatArray
    cars: FloatArray

    def __post_init__(self) -> None:
        if not self.key:
            raise InputError("key of a session is empty, want a word that tells it from all others")
        if not math.isfinite(self.time):
            raise InputError(f"time of session {self.key!r} is {self.time}, want finite seconds")
        seen = self.p_occupied[np.isfinite(self.p_occupied)]
        if self.p_occupied.ndim != 1 or (seen < 0.0).any() or (seen > 1.0).any():
            raise InputError(
                f"p_occupied of session {self.key!r}: want (n_slots,) from 0 to 1, NaN where not seen"
            )
        if self.cars.ndim != 2 or self.cars.shape[1] != 3 or not (np.abs(self.cars) <= FARTHEST).all():
            raise InputError(
                f"cars of session {self.key!r} have shape {self.cars.shape}, want (n, 3) of finite numbers, at most "
                f"{FARTHEST:.0e}"
            )


# What sessions saw, for people with SQL: SELECT slot, p_occupied FROM sighting.
_SIGHTINGS = """CREATE VIEW sighting AS
SELECT json_extract(row.key, '$') AS session, each.key AS slot, each.value AS p_occupied
FROM row, json_each(row.value, '$.p_occupied') AS each WHERE row.name = 'session' AND each.value IS NOT NULL"""


class MapStore:
    """A map file.

    Args:
        path: the file; created if it does not exist, unless `create` is False.
        lot: the lot that the map describes.
        create: whether to write, and to create a missing file; False opens it for reading only.

    Raises:
        InputError: the file is no map file that can be used, see `RowFile`, or belongs to another lot.
    """

    def __init__(self, path: Path, lot: ParkingLot, *, create: bool = True) -> None:
        self.path, self._lot = path, lot
        poses = np.column_stack([lot.slot_xy, lot.slot_yaw, lot.slot_length, lot.slot_width])
        # Adding 0 turns -0.0 into 0.0.
        digest = hashlib.sha256((np.round(poses, 3) + 0.0).tobytes()).hexdigest()[:16]
        about = {"lot": lot.name, "digest": digest}
        self._file = RowFile(
            path, "map file", "parkenv survey", create=create, about=about, views=[_SIGHTINGS]
        )
        head = self._file.head
        if head.get("digest") != about["digest"]:
            self.close()
            raise InputError(
                f"{path}: is a map of lot {head.get('lot')!r:.80}, not of {lot.name!r} as it is here"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def has(self, key: str) -> bool:
        """Return whether the file holds a session."""
        return self._file.has("session", key)

    def add(self, session: Session) -> None:
        """Write a session in one transaction; several processes may write at the same time.

        Raises:
            InputError: a session with this key exists, the number of slots is wrong, or the file cannot be written.
        """
        self._require_slots(session)
        known = [None if math.isnan(p) else p for p in session.p_occupied.tolist()]  # JSON has no NaN
        self._file.add("session", session.key, vars(session) | {"p_occupied": known})

    def sessions(self) -> list[Session]:
        """Return all sessions, ordered by key.

        Raises:
            InputError: the file cannot be read, or a row holds what `add` does not write.
        """
        sessions = []
        for row in self._file.read("session"):
            with self._wrong_values_named(row):
                p, cars = (np.array(row.pop(name), np.float64) for name in ("p_occupied", "cars"))
                sessions.append(Session(**row, p_occupied=p, cars=cars.reshape(-1, 3)))
                self._require_slots(sessions[-1])
            if len(sessions) * self._lot.n_slots > MAX_STATES:
                raise InputError(
                    f"{self.path}: holds more sessions than are read, {MAX_STATES // self._lot.n_slots:,}"
                )
        return sorted(sessions, key=lambda session: session.key)

    def log(self) -> SessionLog:
        """Return the sessions as a log for predictions."""
        sessions = self.sessions()
        p = np.array([s.p_occupied for s in sessions]).reshape(len(sessions), self._lot.n_slots)
        known = np.isfinite(p)
        return SessionLog(np.array([s.time for s in sessions]), np.where(known, p, 0.0) > 0.5, known)

    def has_trip(self, key: str) -> bool:
        """Return whether the file holds a trip."""
        return self._file.has("trip", key)

    def add_trip(self, trip: Trip) -> None:
        """Write the observations of a search in one transaction.

        Raises:
            InputError: a trip with this key exists, a slot is not of the lot, or the file cannot be written.
        """
        self._require_slots(trip)
        self._file.add("trip", trip.key, vars(trip))

    def trips(self) -> list[Trip]:
        """Return all trips, ordered by time and key.

        Raises:
            InputError: the file cannot be read, or a row holds what `add_trip` does not write.
        """
        trips, count = [], 0
        for row in self._file.read("trip"):
            with self._wrong_values_named(row):
                table = np.array([row.pop(name) for name in _OBSERVED], np.float64).reshape(
                    len(_OBSERVED), -1
                )
                trips.append(Trip(**row, slots=table[0].astype(np.int64), after_s=table[1], taken=table[2] == 1.0,
                                  hit_rate=table[3], false_alarm_rate=table[4]))  # fmt: skip
                self._require_slots(trips[-1])
            if (count := count + len(trips[-1].slots)) > MAX_STATES:
                raise InputError(f"{self.path}: holds more observations than are read, {MAX_STATES:,}")
        return sorted(trips, key=lambda trip: (trip.time, trip.key))

    def cars(self) -> FloatArray:
        """Return the poses of all cars of all sessions, (n, 3) x, y in m and yaw in rad."""
        return np.concatenate([np.zeros((0, 3)), *(session.cars for session in self.sessions())])

    def _require_slots(self, of_lot: Session | Trip) -> None:
        n = self._lot.n_slots
        if isinstance(of_lot, Session) and of_lot.p_occupied.shape != (n,):
            raise InputError(f"session {of_lot.key!r:.40} has {of_lot.p_occupied.shape} slots, want ({n},)")
        if isinstance(of_lot, Trip) and len(of_lot.slots) and not of_lot.slots.max() < n:
            raise InputError(f"trip {of_lot.key!r:.40}: slot {of_lot.slots.max()}, want slots 0 to {n - 1}")

    @contextmanager
    def _wrong_values_named(self, row: Row) -> Iterator[None]:
        key = str(row.get("key"))
        try:
            yield
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{self.path}: {key!r:.40}: {error}") from error
