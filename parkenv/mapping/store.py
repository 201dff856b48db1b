"""The map file: survey sessions and trips in an SQLite database, one transaction for each."""

from __future__ import annotations

import hashlib
import math
import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.mapping.inference import SessionLog
from parkenv.mapping.trips import Trip
from parkenv.world.lot import FARTHEST, ParkingLot

APPLICATION_ID = 0x7061726B  # "park"
VERSION = 2
_PATIENCE_S = 30.0
MAX_BYTES = 1_000_000_000
"""Maximum size of a map file."""
MAX_STATES = 50_000_000
"""Maximum number of sessions times slots, and of observations of trips, that are read."""

_JOURNAL_MAGIC = bytes.fromhex("d9d505f920a163d7")
"""Begins a journal of SQLite's; at its end, the magic follows the name of a file that SQLite removes in the end."""

_SCHEMA = """
CREATE TABLE lot (name TEXT NOT NULL, digest TEXT NOT NULL, n_slots INTEGER NOT NULL) STRICT;
CREATE TABLE session (
    id INTEGER PRIMARY KEY, key TEXT NOT NULL UNIQUE, time REAL NOT NULL, rig TEXT NOT NULL, weather TEXT NOT NULL
) STRICT;
CREATE TABLE sighting (
    session INTEGER NOT NULL REFERENCES session(id), slot INTEGER NOT NULL CHECK (slot >= 0),
    p_occupied REAL NOT NULL CHECK (p_occupied BETWEEN 0 AND 1),
    PRIMARY KEY (session, slot)
) STRICT, WITHOUT ROWID;
CREATE TABLE car (
    session INTEGER NOT NULL REFERENCES session(id), x REAL NOT NULL, y REAL NOT NULL, yaw REAL NOT NULL
) STRICT;
CREATE INDEX car_of_session ON car(session);
"""
_SCHEMA_OF_TRIPS = """
CREATE TABLE trip (
    id INTEGER PRIMARY KEY, key TEXT NOT NULL UNIQUE, time REAL NOT NULL, date TEXT NOT NULL
) STRICT;
CREATE TABLE observation (
    trip INTEGER NOT NULL REFERENCES trip(id), number INTEGER NOT NULL, slot INTEGER NOT NULL CHECK (slot >= 0),
    after_s REAL NOT NULL, taken INTEGER NOT NULL CHECK (taken IN (0, 1)),
    hit_rate REAL NOT NULL, false_alarm_rate REAL NOT NULL,
    PRIMARY KEY (trip, number)
) STRICT, WITHOUT ROWID;
"""
"""Tables that files of version 1 lack."""
_TABLES = ("lot", "session", "sighting", "car", "trip", "observation")


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


class MapStore:
    """A map file.

    Args:
        path: the file; created if it does not exist, unless `create` is False.
        lot: the lot that the map describes.
        create: whether to write, and to create a missing file; False opens it for reading only.

    Raises:
        InputError: the file does not exist, is not a map file, is too large, belongs to a newer parkenv or to another
            lot, or cannot be written.
    """

    def __init__(self, path: Path, lot: ParkingLot, *, create: bool = True) -> None:
        self.path, self._lot, self._version = path, lot, VERSION
        if not path.exists() and not create:
            raise InputError(f"{path}: no such map file; parkenv survey makes one")
        if path.exists() and not path.is_file():
            raise InputError(f"{path}: is not a file")  # SQLite would wait for the writer of a pipe
        if path.exists() and path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: has more than {MAX_BYTES:,} bytes, the most that is read")
        journal = Path(f"{os.path.realpath(path)}-journal")
        if journal.exists() and (not journal.is_file() or _names_another_file(journal)):
            raise InputError(
                f"{journal}: is not the journal of a map; SQLite might delete another file instead"
            )
        # The journal of a writer that was killed is rolled back before reading, which takes writing.
        mode = "rwc" if create else "rw" if journal.exists() else "ro"
        address = f"{path.absolute().as_uri()}?mode={mode}"
        is_new = not path.exists()
        with self._errors_in_words():
            self._db = sqlite3.connect(address, timeout=_PATIENCE_S, isolation_level=None, uri=True)
            try:
                # Constraints are checked, and a schema of somebody else's calls no functions.
                self._db.executescript("PRAGMA foreign_keys = ON; PRAGMA trusted_schema = OFF")
                self._open(create)
            except BaseException:
                self._db.close()
                if is_new and path.exists() and not path.stat().st_size:
                    path.unlink()  # nothing could be written, or somebody else writes it
                raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    def has(self, key: str) -> bool:
        """Return whether the file holds a session."""
        with self._errors_in_words():
            return self._db.execute("SELECT 1 FROM session WHERE key = ?", (key,)).fetchone() is not None

    def add(self, session: Session) -> None:
        """Write a session in one transaction; several processes may write at the same time.

        Raises:
            InputError: a session with this key exists, the number of slots is wrong, or the file cannot be written.
        """
        if session.p_occupied.shape != (self._lot.n_slots,):
            raise InputError(
                f"session {session.key!r} has {session.p_occupied.shape} slots, want ({self._lot.n_slots},)"
            )
        seen = np.flatnonzero(np.isfinite(session.p_occupied)).tolist()
        with self._errors_in_words():
            try:
                with self._transaction("IMMEDIATE"):
                    self._insert(session, seen)
            except sqlite3.IntegrityError as error:
                raise InputError(f"{self.path}: holds a session {session.key!r} already") from error

    def sessions(self) -> list[Session]:
        """Return all sessions, ordered by key.

        Raises:
            InputError: the file cannot be read, or a row holds what `add` does not write.
        """
        found = []
        with self._errors_in_words(), self._transaction():
            rows = self._db.execute("SELECT id, key, time, rig, weather FROM session ORDER BY key").fetchall()
            if len(rows) * self._lot.n_slots > MAX_STATES:
                raise InputError(
                    f"{self.path}: holds {len(rows):,} sessions, want at most {MAX_STATES // self._lot.n_slots:,}"
                )
            for number, key, time, rig, weather in rows:
                p = np.full(self._lot.n_slots, np.nan)
                for slot, value in self._db.execute(
                    "SELECT slot, p_occupied FROM sighting WHERE session = ?", (number,)
                ):
                    if not (isinstance(slot, int) and 0 <= slot < len(p) and isinstance(value, float)):
                        raise InputError(
                            f"{self.path}: session {key!r:.40}: slot {slot!r:.40} has p_occupied {value!r:.40}, "
                            f"want slots 0 to {len(p) - 1} with numbers"
                        )
                    p[slot] = value
                cars = self._db.execute("SELECT x, y, yaw FROM car WHERE session = ?", (number,)).fetchall()
                try:
                    poses = np.array(cars, dtype=np.float64).reshape(-1, 3)
                    found.append(Session(key, time, rig, weather, p, poses))
                except (TypeError, ValueError) as error:
                    raise InputError(f"{self.path}: {error}") from error
        return found

    def log(self) -> SessionLog:
        """Return the sessions as a log for predictions."""
        sessions = self.sessions()
        p = np.array([s.p_occupied for s in sessions]).reshape(len(sessions), self._lot.n_slots)
        known = np.isfinite(p)
        return SessionLog(np.array([s.time for s in sessions]), np.where(known, p, 0.0) > 0.5, known)

    def has_trip(self, key: str) -> bool:
        """Return whether the file holds a trip."""
        with self._errors_in_words():
            return self._db.execute("SELECT 1 FROM trip WHERE key = ?", (key,)).fetchone() is not None

    def add_trip(self, trip: Trip) -> None:
        """Write the observations of a search in one transaction.

        Raises:
            InputError: a trip with this key exists, a slot is not of the lot, or the file cannot be written.
        """
        self._require_slots(trip)
        head = (trip.key, trip.time, trip.date)
        columns = (
            trip.slots,
            trip.after_s,
            trip.taken.astype(np.int64),
            trip.hit_rate,
            trip.false_alarm_rate,
        )
        rows = zip(*(column.tolist() for column in columns), strict=True)
        with self._errors_in_words():
            try:
                with self._transaction("IMMEDIATE"):
                    number = self._db.execute(
                        "INSERT INTO trip (key, time, date) VALUES (?, ?, ?)", head
                    ).lastrowid
                    self._db.executemany(
                        "INSERT INTO observation VALUES (?, ?, ?, ?, ?, ?, ?)",
                        ((number, i, *row) for i, row in enumerate(rows)),
                    )
            except sqlite3.IntegrityError as error:
                raise InputError(f"{self.path}: holds a trip {trip.key!r} already") from error

    def trips(self) -> list[Trip]:
        """Return all trips, ordered by time and key.

        Raises:
            InputError: the file cannot be read, or a row holds what `add_trip` does not write.
        """
        if self._version < VERSION:
            return []
        found = []
        with self._errors_in_words(), self._transaction():
            count = self._db.execute("SELECT count(*) FROM observation").fetchone()[0]
            if count > MAX_STATES:
                raise InputError(f"{self.path}: holds {count:,} observations, want at most {MAX_STATES:,}")
            for number, key, time, date in self._db.execute(
                "SELECT id, key, time, date FROM trip ORDER BY time, key"
            ).fetchall():
                rows = self._db.execute(
                    "SELECT slot, after_s, taken, hit_rate, false_alarm_rate FROM observation WHERE trip = ? "
                    "ORDER BY number",
                    (number,),
                ).fetchall()
                try:
                    table = np.array(rows, dtype=np.float64).reshape(-1, 5).T
                    trip = Trip(
                        key, time, date, table[0].astype(np.int64), table[1], table[2] == 1.0, *table[3:]
                    )
                except (TypeError, ValueError) as error:
                    raise InputError(f"{self.path}: trip {key!r:.40}: {error}") from error
                self._require_slots(trip)
                found.append(trip)
        return found

    def _require_slots(self, trip: Trip) -> None:
        if len(trip.slots) and not trip.slots.max() < self._lot.n_slots:
            raise InputError(
                f"{self.path}: trip {trip.key!r:.40}: slot {trip.slots.max()}, want slots 0 to {self._lot.n_slots - 1}"
            )

    def cars(self) -> FloatArray:
        """Return the poses of all cars of all sessions, (n, 3) x, y in m and yaw in rad."""
        return np.concatenate([np.zeros((0, 3)), *(session.cars for session in self.sessions())])

    def _insert(self, session: Session, seen: list[int]) -> None:
        head = (session.key, session.time, session.rig, session.weather)
        number = self._db.execute(
            "INSERT INTO session (key, time, rig, weather) VALUES (?, ?, ?, ?)", head
        ).lastrowid
        self._db.executemany(
            "INSERT INTO sighting VALUES (?, ?, ?)",
            ((number, slot, float(session.p_occupied[slot])) for slot in seen),
        )
        self._db.executemany(
            "INSERT INTO car VALUES (?, ?, ?, ?)", ((number, *car) for car in session.cars.tolist())
        )

    def _open(self, create: bool) -> None:
        # One transaction, so that a file that another process is creating is either empty or complete.
        with self._transaction():
            empty = self._is_empty()
            if not empty:
                self._check()
        if empty and not create:
            raise InputError(f"{self.path}: is empty, no map file; parkenv survey makes one")
        if empty:
            with self._transaction("IMMEDIATE"):
                # Another process may have been faster.
                if self._is_empty():
                    self._make()
                self._check()
        if create and self._version < VERSION:
            with self._transaction("IMMEDIATE"):
                if self._pragma("user_version") < VERSION:
                    self._execute_all(_SCHEMA_OF_TRIPS)
                    self._db.execute(f"PRAGMA user_version = {VERSION}")
                self._version = VERSION

    def _check(self) -> None:
        if self._pragma("application_id") != APPLICATION_ID:
            raise InputError(f"{self.path}: is a database, but no map file of parkenv")
        self._version = self._pragma("user_version")
        if self._version > VERSION:
            raise InputError(
                f"{self.path}: was written by a newer parkenv (schema {self._version}, want at most {VERSION}): "
                "update it"
            )
        wanted = _TABLES if self._version == VERSION else _TABLES[:4]
        # A view in place of a table could have rows without end.
        tables = self._db.execute(
            "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND sql LIKE 'CREATE TABLE%' "
            f"AND name IN ({', '.join('?' * len(wanted))})",
            wanted,
        ).fetchone()
        lot = tables == (len(wanted),) and self._db.execute("SELECT name, digest FROM lot").fetchone()
        if not lot:
            raise InputError(f"{self.path}: is not a complete map file: a table is missing or empty")
        name, digest = lot
        if digest != lot_digest(self._lot):
            raise InputError(
                f"{self.path}: is a map of lot {name!r:.80}, not of {self._lot.name!r} as it is here"
            )

    def _make(self) -> None:
        self._execute_all(_SCHEMA + _SCHEMA_OF_TRIPS)
        head = (self._lot.name, lot_digest(self._lot), self._lot.n_slots)
        self._db.execute("INSERT INTO lot VALUES (?, ?, ?)", head)
        self._db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        self._db.execute(f"PRAGMA user_version = {VERSION}")

    def _execute_all(self, statements: str) -> None:
        # Not `executescript`, which commits first.
        for statement in statements.split(";"):
            self._db.execute(statement)

    def _is_empty(self) -> bool:
        return bool(self._db.execute("SELECT count(*) FROM sqlite_master").fetchone() == (0,))

    def _pragma(self, name: str) -> int:
        return int(self._db.execute(f"PRAGMA {name}").fetchone()[0])

    @contextmanager
    def _transaction(self, kind: str = "DEFERRED") -> Iterator[None]:
        self._db.execute(f"BEGIN {kind}")
        try:
            yield
            self._db.execute("COMMIT")
        except BaseException:
            # Some errors, such as a full disk, have rolled back already.
            if self._db.in_transaction:
                self._db.execute("ROLLBACK")
            raise

    @contextmanager
    def _errors_in_words(self) -> Iterator[None]:
        """Convert database errors to one-line InputErrors."""
        try:
            yield
        except sqlite3.DatabaseError as error:
            raise InputError(f"{self.path}: {_reason(error)}") from error
        except UnicodeDecodeError as error:  # SQLite quotes a damaged schema in its message
            raise InputError(f"{self.path}: is damaged: its tables' names are no UTF-8") from error


def lot_digest(lot: ParkingLot) -> str:
    """Return a hash of the lot's slot poses."""
    poses = np.column_stack([lot.slot_xy, lot.slot_yaw, lot.slot_length, lot.slot_width])
    # Adding 0 turns -0.0 into 0.0.
    return hashlib.sha256((np.round(poses, 3) + 0.0).tobytes()).hexdigest()[:16]


def _names_another_file(journal: Path) -> bool:
    """Whether a journal is part of a transaction over several databases, of which maps have none."""
    with journal.open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - len(_JOURNAL_MAGIC)))
        return file.read() == _JOURNAL_MAGIC


def _reason(error: sqlite3.DatabaseError) -> str:
    text = str(error)
    if "not a database" in text:
        return "is no map file (no SQLite file at all)"
    if "readonly" in text or "unable to open" in text:
        return "cannot be written; want a file in a folder that you may write to"
    if "locked" in text:
        return f"is in use by others for more than {_PATIENCE_S:g} s"
    if "disk I/O" in text or "is full" in text:
        return f"cannot be written: {text}; is the disk full, or the size of files limited?"
    return f"cannot be used as a map file: {text}"
