"""Files of compiled code: one for each function and combination of argument types, shared by all processes.

A file is a pickle, and reading one can run code of whoever wrote it. So the folder is the user's own, and
`NUMBA_CACHE_DIR` should not name one that others can write.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import os
import pickle
import shutil
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock
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


def cache_folder() -> Path:
    """Return the folder of compiled code: `NUMBA_CACHE_DIR`, else one in the user's cache folder."""
    # Numba's own setting may come from a file in the working folder.
    configured = os.environ.get("NUMBA_CACHE_DIR")
    return Path(configured) if configured else user_cache_path("parkenv", appauthor=False) / "compiled"


class CodeFiles:
    """The compiled code of one function.

    Args:
        function: the function, in a file of its module.
        options: the options that it is compiled with.
    """

    def __init__(self, function: Any, options: dict[str, Any]) -> None:
        # A set of options, as of fastmath, has another order in each process.
        ordered = {k: sorted(v) if isinstance(v, (set, frozenset)) else v for k, v in sorted(options.items())}
        free = [cell.cell_contents for cell in function.__closure__ or ()]
        # A module may define two functions of the same name, one after the other.
        text = f"{function.__qualname__} {function.__code__.co_firstlineno} {ordered}"
        self._name, self._key = function.__qualname__.replace("<locals>.", ""), text.encode() + dumps(free)
        self._folder = cache_folder() / f"{function.__module__}-{source_key(function.__code__.co_filename)}"

    def _path(self, types: tuple[Any, ...]) -> Path:
        """Return the file for types of arguments and the processor of this machine."""
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
        """Return numba's `CompileResult` for the types, or None if there is no file, or a damaged one."""
        try:
            content = self._path(types).read_bytes()
        except OSError:
            return None
        data = content[_DIGEST_BYTES:]
        if content[:_DIGEST_BYTES] != hashlib.sha256(data).digest():
            return None
        context.refresh()  # numba's own functions
        return CompileResult._rebuild(context, *pickle.loads(data))

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
            beside.write_bytes(hashlib.sha256(data).digest() + data)
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
