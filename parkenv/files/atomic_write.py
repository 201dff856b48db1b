"""Write files atomically: complete or not at all."""

import errno
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from parkenv.errors import InputError


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path beside `path`; it replaces `path` at the end of the block, or is deleted on failure."""
    path = Path(path)
    beside = _temporary(path)
    try:
        yield beside
        beside.replace(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):  # also where there is no such file, on a file system that is read-only
            beside.unlink()


def write_text(path: str | os.PathLike[str], text: str) -> None:
    with atomic_write(path) as beside:
        beside.write_text(text, encoding="utf-8")


@contextmanager
def write_together(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder in `folder`; its files move there when the block ends, or are deleted on failure."""
    beside = Path(tempfile.mkdtemp(prefix=".parts-", dir=folder))
    try:
        yield beside
        for file in sorted(beside.iterdir()):
            file.replace(folder / file.name)
    except InputError as error:
        raise InputError(str(error).replace(str(beside), str(folder))) from error
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def check_writable(path: str | os.PathLike[str]) -> None:
    """Check that `atomic_write` can write a file, before any work; nothing is left behind, a previous file stays."""
    path = Path(path)
    beside = _temporary(path)
    try:
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        beside.touch()
        beside.unlink()
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error


def _temporary(path: Path) -> Path:
    if not path.name:
        raise InputError(f"{path}: cannot be written: is no name of a file")
    return path.with_name(f".{path.name}.{os.getpid()}.part")


def make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / f".probe.{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"--out {path}: cannot be written ({error.strerror})") from error


def remove_torn(folder: Path) -> None:
    """Remove the temporary files of killed processes from a folder and its subfolders, which nobody else writes."""
    for pattern in (".*.[0-9]*.part", "*/.*.[0-9]*.part"):
        for torn in folder.glob(pattern):
            torn.unlink(missing_ok=True)
