"""One writer per folder."""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

from filelock import FileLock, Timeout

from parkenv.errors import InputError
from parkenv.files.atomic_write import make_folder, remove_torn

LOCK = ".lock"


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold a folder's lock, which the system releases when this process ends; remove what a killed writer left."""
    path = folder / LOCK
    lock = FileLock(path)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        owner = ""
        with suppress(OSError):
            owner = path.read_text(encoding="utf-8")[:200]
        raise InputError(
            f"{folder}: {owner or 'another process'}, writes there; wait for its end, or use another folder"
        ) from None
    try:
        path.write_text(
            f"process {os.getpid()} on {socket.gethostname()}, since {datetime.now():%Y-%m-%d %H:%M:%S}",
            encoding="utf-8",
        )
        remove_torn(folder)
        yield
    finally:
        # Before the release: a process that then waits for this file opens a new one.
        with suppress(OSError):
            path.unlink()
        lock.release()


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Make a folder, and be its only writer during the block; remove it again if the block leaves it empty."""
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    make_folder(folder)
    try:
        with folder_lock(folder):
            yield
    finally:
        with suppress(OSError):
            for each in made:
                each.rmdir()
