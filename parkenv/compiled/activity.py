"""What the processes of this machine compile at the moment."""

from __future__ import annotations

from contextlib import suppress

from parkenv.compiled.code_files import cache_folder


def compiling_now(since_s: float) -> tuple[list[str], int]:
    """Return the functions that are being compiled, and how many are finished, since a time of `time.time`."""
    names, n_finished = [], 0
    for path in cache_folder().glob("*/*"):
        with suppress(OSError):  # deleted meanwhile
            if path.stat().st_mtime > since_s:
                names += [path.stem.rpartition("-")[0].strip("_")] if path.suffix == ".lock" else []
                n_finished += path.suffix == ".nbc"
    return names, n_finished
