"""The folder that a command writes its results into."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from parkenv.cli.tables import make_console
from parkenv.files.folder_lock import only_writer


@contextmanager
def writing_into(out: Path, resumed_by: str | None = None) -> Iterator[None]:
    """Be the only writer of a folder; after an interruption, say what is in it.

    Args:
        out: the folder.
        resumed_by: what the user enters to resume the run, if that is possible.

    Raises:
        InputError: the folder cannot be made or written, or another process writes into it.
    """
    try:
        with only_writer(out):
            yield
    except KeyboardInterrupt:
        rest = f" What was finished is in {out}; {resumed_by} goes on." if resumed_by else ""
        make_console().print(f"Interrupted.{rest}")
        raise
