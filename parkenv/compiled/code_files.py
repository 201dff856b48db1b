"""Files of compiled code: one for each function and combination of argument types, shared by all processes.

A file is a pickle, and reading it can run code of its author. So only files that no one but this user and the
administrator can have written are read, wherever `NUMBA_CACHE_DIR` is.
"""

import functools
import hashlib
import itertools
import logging
import os
import pickle
import secrets
import shutil
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock
from numba.core.bytecode import FunctionIdentity
from numba.core.compiler import CompileResult
from numba.core.errors import NumbaWarning
from numba.core.registry import cpu_target
from numba.core.serialize import dumps
from platformdirs import user_cache_path

from parkenv.compiled.source_key import source_key

_KEPT_DAYS = 30  # age at which compiled code of other versions of a module is deleted
_WAIT_S = 120.0  # for another process that compiles the same; a stopped one is not waited for longer
_DIGEST_BYTES = 32
_LOGGER = logging.getLogger("parkenv")
# Numba tells functions of one name apart by how many its process has compiled before. Two processes would give one name
# to different functions, such as those of `sort` and `argsort`, and where both are loaded, the first would be called.
FunctionIdentity._unique_ids = itertools.count(secrets.randbits(48))


def cache_folder() -> Path:
    """Return the folder of compiled code: `NUMBA_CACHE_DIR`, else one in the user's cache folder or a temporary one."""
    # Numba's own setting may come from a file in the working folder.
    if configured := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(configured)
    try:
        folder = user_cache_path("parkenv", appauthor=False)
    except RuntimeError:
        folder = Path("~")
    # Where the user has no home, versions of platformdirs raise an error or leave "~" in the path.
    own = folder if folder.is_absolute() else Path(tempfile.gettempdir(), f"parkenv-{os.getuid()}")
    return own / "compiled"


class CodeFiles:
    """The compiled code of one function, in a file of its module, with its options."""

    def __init__(self, function: Any, options: dict[str, Any]) -> None:
        # A set of options, as of fastmath, has another order in each process.
        ordered = {k: sorted(v) if isinstance(v, (set, frozenset)) else v for k, v in sorted(options.items())}
        free = [cell.cell_contents for cell in function.__closure__ or ()]
        # A module may define two functions of the same name, one after the other.
        text = f"{function.__qualname__} {function.__code__.co_firstlineno} {ordered}"
        self._name, self._key = function.__qualname__.replace("<locals>.", ""), text.encode() + dumps(free)
        self._folder = cache_folder() / f"{function.__module__}-{source_key(function.__code__.co_filename)}"

    def _path(self, types: tuple[Any, ...]) -> Path:
        processor = cpu_target.target_context.codegen().magic_tuple()
        digest = hashlib.sha256(self._key + f"{types} {processor}".encode())
        return self._folder / f"{self._name}-{digest.hexdigest()[:16]}.nbc"

    @contextmanager
    def alone(self, types: tuple[Any, ...]) -> Iterator[None]:
        """Let no other process compile the same; one that does is waited for, and its code can then be loaded."""
        path = self._path(types)
        if path.exists():
            yield
            return
        _announce()
        lock = FileLock(path.with_suffix(".lock"), timeout=_WAIT_S)
        try:
            self._make_folder()
            lock.acquire()
        except (OSError, NotImplementedError):  # not writable, no locks there, or waited for too long
            pass
        try:
            yield
        finally:
            if lock.is_locked:
                # Who waits for the deleted file may compile beside a third process, which costs time and nothing else.
                Path(lock.lock_file).unlink(missing_ok=True)
                lock.release()

    def load_overload(self, types: tuple[Any, ...], context: Any) -> Any:
        """Return numba's `CompileResult` for the types, or None if there is no file, or a damaged or unsafe one."""
        try:
            content = _read_own(self._path(types))
        except OSError:
            return None
        data = content[_DIGEST_BYTES:]
        if content[:_DIGEST_BYTES] != _digest(self._path(types), data):
            return None
        context.refresh()  # numba's own functions
        try:
            return CompileResult._rebuild(context, *pickle.loads(data))
        except SystemError:  # Ctrl-C, as numba passes it on
            raise
        except Exception as error:
            _LOGGER.debug("%s is compiled again: %s", self._name, error)
            return None

    def save_overload(self, types: tuple[Any, ...], code: Any) -> None:
        """Write a `CompileResult`; warn once per process if that is not possible."""
        if code.library.has_dynamic_globals:
            warnings.warn(f"{self._name} holds addresses of this process and is not kept", NumbaWarning, 2)
            return
        path = self._path(types)
        beside = path.with_name(f"{path.name}.{os.getpid()}.part")
        try:
            self._make_folder()
            data = dumps(code._reduce())
            # New, so that it is no link of somebody else's; and readable for all, writable for this user.
            with os.fdopen(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644), "wb") as file:
                file.write(_digest(path, data) + data)
            beside.replace(path)
        except OSError as error:
            _warn_of_unwritable_cache(error.strerror or str(error))
        finally:
            with suppress(OSError):
                beside.unlink(missing_ok=True)

    def _make_folder(self) -> None:
        if not self._folder.exists():
            _delete_old_versions(self._folder)
            self._folder.mkdir(parents=True, exist_ok=True)


def _digest(path: Path, data: bytes) -> bytes:
    """Return what a file begins with; it is another if the file had another name."""
    return hashlib.sha256("/".join(path.parts[-2:]).encode() + data).digest()


def _read_own(path: Path) -> bytes:
    """Return the content of a file that nobody but this user and the administrator can have written.

    Raises:
        OSError: there is none, or others can have written it.
    """
    # A link may lead to a file that the user has from elsewhere, and opening a pipe would wait.
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    with os.fdopen(os.open(path, flags), "rb") as file:
        status = os.fstat(file.fileno())
        if sys.platform != "win32" and (status.st_uid not in (0, os.getuid()) or status.st_mode & 0o022):
            _warn_of_unsafe_cache(path.parent.parent)
            raise PermissionError(path)
        return file.read()


@functools.cache
def _warn_of_unsafe_cache(folder: Path) -> None:
    _LOGGER.warning(
        "compiled functions in %s are not read: others can write them; they are compiled again", folder
    )


@functools.cache
def _announce() -> None:
    """Report once per process that functions are being compiled, since first calls can take seconds."""
    _LOGGER.warning(
        "compiling functions for this machine, which takes some seconds the first time; kept in %s",
        cache_folder(),
    )


@functools.cache
def _warn_of_unwritable_cache(reason: str) -> None:
    """Warn once per process that the next process will compile again."""
    _LOGGER.warning(
        "compiled functions cannot be kept in %s (%s): every process compiles them again; set NUMBA_CACHE_DIR to a "
        "folder that can be written",
        cache_folder(),
        reason,
    )


def _delete_old_versions(folder: Path) -> None:
    """Delete code of earlier versions of the module that has not changed for a month."""
    oldest = time.time() - _KEPT_DAYS * 86_400
    for other in folder.parent.glob(f"{folder.name.rpartition('-')[0]}-*"):
        try:
            if other.stat().st_mtime < oldest:
                shutil.rmtree(other)
        except OSError:
            continue  # another process deletes it, too


def compiling_now(since_s: float) -> tuple[list[str], int]:
    """Return the functions that are being compiled, and how many are finished, since a time of `time.time`."""
    names, n_finished = [], 0
    for path in cache_folder().glob("*/*"):
        with suppress(OSError):  # deleted meanwhile
            if path.stat().st_mtime > since_s:
                names += [path.stem.rpartition("-")[0].strip("_")] if path.suffix == ".lock" else []
                n_finished += path.suffix == ".nbc"
    return names, n_finished
