"""What the processes of this machine compile at the moment."""

from __future__ import annotations

from contextlib import suppress

from parkenv.compiled.code_files import cache_folder


def compiling_now(since_s: float) -> list[str]:
    """Return the functions that are being compiled, of those begun after a time of `time.time`."""
    locks = cache_folder().glob("*/*.lock")
    with suppress(OSError):  # one is deleted meanwhile
        return [path.stem.rpartition("-")[0].strip("_") for path in locks if path.stat().st_mtime > since_s]
    return []
