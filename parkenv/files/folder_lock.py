"""One writer per folder."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from parkenv.errors import InputError
from parkenv.files.atomic_write import remove_torn

if sys.platform != "win32":
    import fcntl

LOCK = ".lock"


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder during the block, and remove what a killed writer left half-written there.

    The kernel releases the lock when this process ends, even by SIGKILL, so a lock cannot be stale. Worker processes do
    not inherit it. Windows has no such lock; there, nothing is checked.

    Raises:
        InputError: another process holds the lock; the message names the process.
    """
    if sys.platform == "win32":
        yield
        return
    path = folder / LOCK
    while True:
        file = path.open("a+", encoding="utf-8")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            owner = file.read(200) or "another process"
            file.close()
            raise InputError(
                f"{folder}: {owner}, writes there; wait for its end, or use another folder"
            ) from None
        # The previous holder removes the file: its lock would be no obstacle to the next process.
        if path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat()):
            break
        file.close()
    with file:
        file.truncate(0)
        file.write(
            f"process {os.getpid()} on {socket.gethostname()}, since {datetime.now():%Y-%m-%d %H:%M:%S}"
        )
        file.flush()
        remove_torn(folder)
        try:
            yield
        finally:
            path.unlink(missing_ok=True)
