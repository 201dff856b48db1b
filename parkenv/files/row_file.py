"""SQLite files of rows in JSON: opened so that a stranger's does no harm, and written in transactions."""

import json
import os
import sqlite3
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self
from zlib import crc32

from parkenv.errors import InputError
from parkenv.files.limited_reading import parse_json

MAX_BYTES = 1_000_000_000  # maximum size of a file
_PATIENCE_S = 30.0
_APPLICATION_ID = 0x7061726B  # "park"
_VERSION = 3
_HEAD = "head"
SYNC_S = 1.0  # least time between two flushes to disk of a writer that is alone, s
_TABLE = (
    "CREATE TABLE row (name TEXT NOT NULL, key TEXT NOT NULL, value TEXT NOT NULL, crc32 INTEGER NOT NULL, "
    "PRIMARY KEY (name, key)) STRICT"
)
# Begins a journal of SQLite's; at its end, the magic follows the name of a file that SQLite removes in the end.
_JOURNAL_MAGIC = bytes.fromhex("d9d505f920a163d7")

Row = dict[str, Any]


class RowFile:
    """A file of rows, each of which has a name of its kind and a key.

    Args:
        path: the file.
        what: what such a file is, for messages and in its head.
        made_by: who makes one, for messages.
        create: whether to write, and to create a missing file; False opens it for reading only.
        alone: whether no other process opens it meanwhile: each transaction is fast, and its rows survive the end of
            this process, but only those of the second before that of the machine.
        about: what the head of a new file also says.
        views: statements that make views of a new file's rows, for people with SQL; none is read here.
    """

    def __init__(
        self,
        path: Path,
        what: str,
        made_by: str,
        *,
        create: bool = True,
        alone: bool = False,
        about: Row | None = None,
        views: Sequence[str] = (),
    ) -> None:
        self._views = views
        self.what, self.made_by, self._alone, self._synced = what, made_by, alone and create, 0.0
        self.head: Row = {"what": what, **(about or {})}
        self.path = path
        is_new = not path.exists()
        if is_new and not create:
            raise InputError(f"{path}: no such {self.what}; {self.made_by} makes one")
        if not is_new and not path.is_file():
            raise InputError(f"{path}: is not a file")  # SQLite would wait for the writer of a pipe
        if not is_new and path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path}: has more than {MAX_BYTES:,} bytes, the most that is read")
        journals = [Path(f"{os.path.realpath(path)}-{ending}") for ending in ("journal", "wal")]
        for journal in journals:
            if journal.exists() and (not journal.is_file() or _names_another_file(journal)):
                raise InputError(
                    f"{journal}: is not the journal of a {self.what}; SQLite might delete another file instead"
                )
        # What a killed writer has left is rolled back, or taken over, before reading, which takes writing.
        mode = "rwc" if create else "rw" if any(journal.exists() for journal in journals) else "ro"
        address = f"{path.absolute().as_uri()}?mode={mode}"
        with self._errors_in_words():
            self._db = sqlite3.connect(address, timeout=_PATIENCE_S, isolation_level=None, uri=True)
            try:
                self._db.execute("PRAGMA trusted_schema = OFF")  # one of somebody else's calls no functions
                self._open(create)
                if self._alone:
                    # Rows are appended to a log, which needs no flush to disk.
                    self._db.executescript("PRAGMA locking_mode = EXCLUSIVE; PRAGMA journal_mode = WAL")
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
        if self._alone:
            with self._errors_in_words():
                self._db.execute("PRAGMA journal_mode = DELETE")
        self._db.close()

    def has(self, name: str, key: Any) -> bool:
        query = "SELECT 1 FROM row WHERE name = ? AND key = ?"
        with self._errors_in_words():
            return self._db.execute(query, (name, to_json(key))).fetchone() is not None

    def read(self, name: str) -> Iterator[Row]:
        with self._errors_in_words():
            query = "SELECT value, crc32 FROM row WHERE name = ? ORDER BY rowid"
            for text, check in self._db.execute(query, (name,)):
                sound = crc32(text.encode()) == check
                row = parse_json(text, f"{self.path}: a row of {name}") if sound else None
                if not isinstance(row, dict):
                    raise InputError(f"{self.path}: a row of {name} is damaged")
                yield row

    def write(self, rows: Iterable[tuple[str, Any, Row]], *, replaces: Iterable[str] = ()) -> None:
        """Write names, keys and rows in one transaction, in place of those of these keys and of names it `replaces`."""
        due = time.monotonic() >= self._synced + SYNC_S
        with self._errors_in_words():
            if self._alone:
                self._db.execute(f"PRAGMA synchronous = {'FULL' if due else 'NORMAL'}")
            with self._transaction("IMMEDIATE"):
                self._db.executemany("DELETE FROM row WHERE name = ?", [(name,) for name in replaces])
                self._insert(rows, "OR REPLACE")
        self._synced = time.monotonic() if due else self._synced

    def add(self, name: str, key: str, row: Row) -> None:
        """Write a row with a new key in one transaction; several processes may write at the same time."""
        with self._errors_in_words():
            try:
                with self._transaction("IMMEDIATE"):
                    self._insert([(name, key, row)])
            except sqlite3.IntegrityError as error:
                raise InputError(f"{self.path}: holds a {name} {key!r} already") from error

    def _insert(self, rows: Iterable[tuple[str, Any, Row]], otherwise: str = "") -> None:
        texts = ((name, to_json(key), to_json(row)) for name, key, row in rows)
        self._db.executemany(
            f"INSERT {otherwise} INTO row VALUES (?, ?, ?, ?)",
            ((name, key, value, crc32(value.encode())) for name, key, value in texts),
        )

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
        try:
            yield
        except sqlite3.DatabaseError as error:
            raise InputError(f"{self.path}: {self._reason(error)}") from error
        except UnicodeDecodeError as error:  # SQLite quotes a damaged schema in its message
            raise InputError(f"{self.path}: is damaged: its tables' names are no UTF-8") from error

    def _open(self, create: bool) -> None:
        # One transaction, so that a file that another process is creating is either empty or complete.
        with self._transaction():
            empty = self._is_empty()
            if not empty:
                self._check()
        if empty and not create:
            raise InputError(f"{self.path}: is empty, no {self.what}; {self.made_by} makes one")
        if empty:
            with self._transaction("IMMEDIATE"):
                # Another process may have been faster.
                if self._is_empty():
                    for statement in (_TABLE, *self._views):
                        self._db.execute(statement)
                    self._insert([(_HEAD, "", self.head)])
                    self._db.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
                    self._db.execute(f"PRAGMA user_version = {_VERSION}")
                self._check()

    def _check(self) -> None:
        if self._pragma("application_id") != _APPLICATION_ID:
            raise InputError(f"{self.path}: is a database, but no {self.what} of parkenv")
        if (version := self._pragma("user_version")) != _VERSION:
            raise InputError(
                f"{self.path}: was written by another parkenv (schema {version}, want {_VERSION})"
            )
        # A view in place of a table could have rows without end.
        tables = "SELECT count(*) FROM sqlite_master WHERE type = 'table' AND sql LIKE 'CREATE TABLE%' AND name = 'row'"
        if self._db.execute(tables).fetchone() != (1,):
            raise InputError(f"{self.path}: is no complete {self.what}: its table is missing")
        self.head = next(self.read(_HEAD), {})
        if self.head.get("what") != self.what:
            raise InputError(f"{self.path}: is a {self.head.get('what')!s:.80}, but no {self.what}")

    def _is_empty(self) -> bool:
        return bool(self._db.execute("SELECT count(*) FROM sqlite_master").fetchone() == (0,))

    def _pragma(self, name: str) -> int:
        return int(self._db.execute(f"PRAGMA {name}").fetchone()[0])

    def _reason(self, error: sqlite3.DatabaseError) -> str:
        no_space = f"cannot be written: {error}; is the disk full, or the size of files limited?"
        reasons = {
            "not a database": f"is no {self.what} (no SQLite file at all)",
            "readonly": "cannot be written; want a file in a folder that you may write to",
            "unable to open": "cannot be written; want a file in a folder that you may write to",
            "locked": f"is in use by others for more than {_PATIENCE_S:g} s",
            "disk I/O": no_space,
            "is full": no_space,
        }
        known = (reason for text, reason in reasons.items() if text in str(error))
        return next(known, f"cannot be used as a {self.what}: {error}")


def to_json(value: Any) -> str:
    return json.dumps(value, default=lambda array: array.tolist())


def _names_another_file(journal: Path) -> bool:
    """Whether a journal is part of a transaction over several databases, of which ours have none."""
    with journal.open("rb") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - len(_JOURNAL_MAGIC)))
        return file.read() == _JOURNAL_MAGIC
