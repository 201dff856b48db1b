"""The folder that a command writes its results into."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from parkenv.cli.tables import make_console
from parkenv.files.folder_lock import folder_lock


@contextmanager
def writing_into(out: Path, resumed_by: str | None = None) -> Iterator[None]:
    """Make the folder, and be its only writer during the block; after an interruption, say what is in it.

    The folder made for a command that turns out to be invalid is removed.

    Args:
        out: the folder.
        resumed_by: what the user enters to resume the run, if that is possible.

    Raises:
        InputError: the folder cannot be made or written, or another process writes into it.
    """
    from parkenv.studies.results import make_folder

    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    make_folder(out)
    try:
        with folder_lock(out):
            yield
    except KeyboardInterrupt:
        rest = f" What was finished is in {out}; {resumed_by} goes on." if resumed_by else ""
        make_console().print(f"Interrupted.{rest}")
        raise
    finally:
        with suppress(OSError):
            for folder in made:
                folder.rmdir()
