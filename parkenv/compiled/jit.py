"""Compile functions with numba, and cache the machine code until any of its sources changes.

Numba's own cache checks only the file of the compiled function: after a change in another file, to a function that it
calls or a constant that it reads, callers would keep running the old code. Here the key is the content of the
function's module and of every module that it imports, directly or indirectly. Of libraries only numba's version counts.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import os
import pickle
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FunctionType
from typing import Any, overload

import numba
import numpy as np
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache, NullCache, _CacheLocator
from numba.core.cpu import CPUTargetOptions
from numba.core.options import TargetOptions
from numba.core.serialize import dumps
from numba.core.types.misc import unliteral
from platformdirs import user_cache_path

_PACKAGES = ("sim_sensors", "parkenv", "planners")
_HOME = Path(__file__).resolve().parents[2]  # the folder that contains these packages
_KEPT_DAYS = 30  # age at which compiled code of other versions of a module is deleted
_LOGGER = logging.getLogger("parkenv")


def cache_folder() -> Path:
    """Return the folder of compiled code: `NUMBA_CACHE_DIR`, else one in the user's cache folder."""
    configured = numba.config.CACHE_DIR
    return Path(configured) if configured else user_cache_path("parkenv", appauthor=False) / "compiled"


@overload
def compiled(function: Callable[..., Any], /) -> Any: ...
@overload
def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]: ...
def compiled(function: Callable[..., Any] | None = None, /, **options: Any) -> Any:
    """Compile the decorated function on its first call, once for all processes and sessions.

    A function that Python calls returns no named tuple: numba makes one by calling Python, which is slow, and the
    process crashes if a signal handler, such as that of Ctrl-C, raises an exception there.

    Args:
        function: the function, if the decorator has no options.
        options: options of `numba.njit`, except `cache`; and two of our own for loops that the compiler is to turn into
            vector instructions: `single=True` makes the float literals of the function single precision, and
            `distinct=True` promises that no two arrays among the arguments overlap. By default C cannot call the
            function (`no_cfunc_wrapper`).

    Examples:
        >>> @compiled(error_model="numpy")
        ... def half(x):
        ...     return x / 2
        >>> half.py_func(3.0)
        1.5
    """
    if function is None:
        return functools.partial(_compiled, options=options)
    return _compiled(function, options)


def _compiled(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    # Numba's wrapper for calls from C takes a tenth of the time of compiling, and next to nobody calls it.
    options = {"no_cfunc_wrapper": True, **options}
    plain = {name: value for name, value in options.items() if name not in _OWN_OPTIONS}
    if options.get("distinct"):
        plain["noalias"] = True
    if options.get("single"):
        function = _with_single_literals(function)
    dispatcher = numba.njit(**plain)(function)
    if numba.config.DISABLE_JIT:
        return dispatcher
    _ignore_literals(dispatcher)
    try:
        dispatcher._cache = _SourceKeyedCache(function, options)
    except (OSError, RuntimeError):
        dispatcher._cache = NullCache()  # the function's source file is not readable
    return dispatcher


_OWN_OPTIONS = ("single", "distinct")

# Numba has this flag for its own parallel loops, and no option for it.
CPUTargetOptions.noalias = TargetOptions.Mapping("noalias")


def _with_single_literals(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with float32 in place of its float literals: one float64 makes a whole expression float64."""
    code = function.__code__
    literals = tuple(np.float32(value) if type(value) is float else value for value in code.co_consts)
    single = FunctionType(code.replace(co_consts=literals), function.__globals__, function.__name__)
    single.__defaults__ = function.__defaults__
    return functools.update_wrapper(single, function)


def _ignore_literals(dispatcher: Any) -> None:
    """Let compiled callers share one version of a function for `f(0)` and `f(n)`.

    Numba gives a constant, or a variable whose first value is one, its own type, and would compile the function and all
    its callees again for it.
    """
    template_of = dispatcher.get_call_template

    def get_call_template(args: Any, kws: Any) -> Any:
        values = {name: unliteral(kind) for name, kind in dict(kws).items()}
        return template_of(tuple(unliteral(kind) for kind in args), values)

    dispatcher.get_call_template = get_call_template


class _Clock:
    """Measures the seconds that this process has spent on compiling and loading compiled code."""

    def __init__(self) -> None:
        self.total_s = 0.0
        self._depth = 0
        self._since = 0.0

    def start(self) -> None:
        if self._depth == 0:
            self._since = time.perf_counter()
        self._depth += 1

    def stop(self) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.total_s += time.perf_counter() - self._since

    @contextmanager
    def running(self) -> Iterator[None]:
        self.start()
        try:
            yield
        finally:
            self.stop()


_CLOCK = _Clock()


class _CompileListener(event.Listener):  # type: ignore[misc]
    def on_start(self, event: Any) -> None:  # noqa: ARG002 - numba's interface
        _CLOCK.start()

    def on_end(self, event: Any) -> None:  # noqa: ARG002
        _CLOCK.stop()


event.register("numba:compile", _CompileListener())


def seconds_spent() -> float:
    """Return the seconds that this process has spent so far on compiling and loading compiled code.

    Subtract the difference between two calls from a measured time to exclude compilation.
    """
    return _CLOCK.total_s


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


class _SourceKeyedLocator(_CacheLocator):  # type: ignore[misc]
    """Names the folder of a module's compiled code after the content of all its sources."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        self._py_file = py_file
        self._name = f"{py_func.__qualname__} {py_func.__code__.co_firstlineno}"
        self._folder = cache_folder() / f"{py_func.__module__}-{source_key(py_file)}"

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> _SourceKeyedLocator | None:
        return cls(py_func, py_file) if Path(py_file).is_file() else None

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._folder.name

    def get_disambiguator(self) -> str:
        # A module may define two functions of the same name, one after the other.
        return _short_hash(self._name)

    def ensure_cache_path(self) -> None:
        if not self._folder.exists():
            _delete_old_versions(self._folder)
            self._folder.mkdir(parents=True, exist_ok=True)


class _SourceKeyedImpl(CompileResultCacheImpl):  # type: ignore[misc]
    _locator_classes = (_SourceKeyedLocator,)


class _CodeFiles:
    """One file per signature, replaced atomically, so processes can compile at the same time."""

    def __init__(self, folder: str, name: str) -> None:
        self._folder, self._name = Path(folder), name

    def _path(self, key: Any) -> Path:
        return self._folder / f"{self._name}-{_short_hash(str(key))}.nbc"

    def load(self, key: Any) -> Any:
        try:
            saved_key, data = pickle.loads(self._path(key).read_bytes())
        except (OSError, EOFError, pickle.UnpicklingError):
            return None
        return data if saved_key == key else None

    def save(self, key: Any, data: Any) -> None:
        path = self._path(key)
        beside = path.with_name(f"{path.name}.{os.getpid()}.part")
        try:
            beside.write_bytes(dumps((key, data)))
            beside.replace(path)
        finally:
            beside.unlink(missing_ok=True)

    def flush(self) -> None:
        for path in self._folder.glob(f"{self._name}-*.nbc"):
            path.unlink(missing_ok=True)


class _SourceKeyedCache(FunctionCache):  # type: ignore[misc]
    _impl_class = _SourceKeyedImpl

    def __init__(self, py_func: Any, options: dict[str, Any]) -> None:
        super().__init__(py_func)
        # A set of options, as of fastmath, has another order in each process.
        ordered = {k: sorted(v) if isinstance(v, (set, frozenset)) else v for k, v in sorted(options.items())}
        name = f"{self._impl.filename_base}-{_short_hash(str(ordered))}"
        self._cache_file = _CodeFiles(self._cache_path, name)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        with _CLOCK.running():
            data = super().load_overload(sig, target_context)
        if data is None:
            _announce()
        return data

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            with _CLOCK.running():
                super().save_overload(sig, data)
        except OSError as error:
            _warn_of_unwritable_cache(error.strerror or str(error))


def _delete_old_versions(folder: Path) -> None:
    """Delete code of earlier versions of the module that has not changed for a month."""
    oldest = time.time() - _KEPT_DAYS * 86_400
    for other in folder.parent.glob(f"{folder.name.rpartition('-')[0]}-*"):
        try:
            if other.stat().st_mtime < oldest:
                shutil.rmtree(other)
        except OSError:
            continue  # another process deletes it, too


def _short_hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def source_key(file: str | os.PathLike[str]) -> str:
    """Return the key of code compiled from a file: a hash of numba's version, the file, and everything that it imports.

    Sources are read once per process, when they are imported.
    """
    path = Path(file).resolve()
    status = path.stat()
    if _STATUS.setdefault(path, (status.st_mtime_ns, status.st_size)) != (status.st_mtime_ns, status.st_size):
        # The module was edited and imported again, as in a notebook.
        _STATUS.clear()
        _content.cache_clear()
        _imported_files.cache_clear()
        _closure_key.cache_clear()
    return _closure_key(path)


_STATUS: dict[Path, tuple[int, int]] = {}


@functools.cache
def _closure_key(file: Path) -> str:
    settings = (numba.__version__, sys.version_info[:2], numba.config.OPT, numba.config.BOUNDSCHECK)
    digest = hashlib.sha256(str(settings).encode())
    for content in sorted(_content(path)[0] for path in _closure(file)):
        digest.update(content)
    return digest.hexdigest()[:16]


def _closure(file: Path) -> set[Path]:
    """Return the file and all files that it imports, directly or indirectly, except those of libraries."""
    found = {file}
    waiting = [file]
    while waiting:
        new = _imported_files(waiting.pop()) - found
        found |= new
        waiting += new
    return found


@functools.cache
def _imported_files(file: Path) -> frozenset[Path]:
    return frozenset(path for module in _content(file)[1] for path in _module_files(module, file))


_IMPORT = re.compile(
    rb"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)|import[ \t]+([^\n]+))", re.M
)
_NAME = re.compile(rb"[\w.]+")


@functools.cache
def _content(file: Path) -> tuple[bytes, tuple[str, ...]]:
    """Return the hash of a file, and the names of modules that it may import, relative ones with leading dots."""
    content = file.read_bytes()
    modules = set()
    for source, names, plain in _IMPORT.findall(content.replace(b"\\\n", b" ")):
        if source:
            parent = source.decode()
            modules.add(parent)
            prefix = parent if parent.endswith(".") else f"{parent}."
            modules |= {prefix + name.decode() for name in _NAME.findall(names)}
        else:
            modules |= {name.decode() for name in _NAME.findall(plain)}
    return hashlib.sha256(content).digest(), tuple(sorted(modules))


def _module_files(module: str, importer: Path) -> tuple[Path, ...]:
    """Return the file of a module that compiled code may depend on; none for modules of libraries.

    Sources of installed libraries change only with their version; those of this package and of the user's own modules
    may change at any time.
    """
    name = module.lstrip(".")
    if module != name:
        return _source_files(importer.parents[len(module) - len(name) - 1], name)
    top, _, rest = name.partition(".")
    if top in _PACKAGES:
        return _source_files(_HOME, name)
    package = sys.modules.get(top)
    file = getattr(package, "__file__", None)
    if file is None or "site-packages" in file or top in sys.stdlib_module_names:
        return ()
    folders = getattr(package, "__path__", None)
    if folders is None:
        return (Path(file).resolve(),)
    return tuple(path for folder in folders for path in _source_files(Path(folder), rest))


@functools.cache
def _source_files(folder: Path, name: str) -> tuple[Path, ...]:
    place = folder.joinpath(*name.split("."))
    candidates = (*([place.with_suffix(".py")] if name else []), place / "__init__.py")
    return tuple(path.resolve() for path in candidates if path.is_file())
