"""Keys of compiled code: the content of all sources that it is made from.

Numba's own cache checks only the file of the compiled function: after a change in another file, to a function that it
calls or a constant that it reads, callers would keep running the old code. Here the key is the content of the
function's module and of every module that it imports, directly or indirectly. Of libraries only numba's version counts.
"""

import functools
import hashlib
import os
import re
import sys
from pathlib import Path

import numba

_PACKAGES = ("sim_sensors", "parkenv", "planners")
_HOME = Path(__file__).resolve().parents[2]  # the folder that contains these packages


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
    files = {file}
    waiting = [file]
    while waiting:
        new = _imported_files(waiting.pop()) - files
        files |= new
        waiting += new
    return files


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
