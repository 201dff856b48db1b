"""User-defined classes, named `MODULE:CLASS` on a command line or in a file."""

import sys
import traceback
from collections.abc import Iterable, Sequence
from importlib import import_module
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

from parkenv.errors import InputError


def load_class(name: str, kind: str, method: str, *, alternatives: str = "") -> Any:
    """Import the class `MODULE:CLASS`, which has a method, such as `detect(image)`, perhaps from the working directory.

    For messages, `kind` is its role, such as a detector, and `alternatives` are other values for the module.
    """
    module, _, class_name = name.partition(":")
    if not all(part.isidentifier() for part in (*module.split("."), class_name)):
        raise InputError(f"{kind} {name!r}: want MODULE:CLASS{alternatives}")
    here = str(Path.cwd())
    # Last, so that no other module there replaces one of Python's own or of a library.
    if here not in sys.path:
        sys.path.append(here)
    try:
        named = getattr(import_module(module), class_name)
    except ModuleNotFoundError as error:
        if error.name != module.partition(".")[0]:
            raise InputError(
                f"{kind} {name!r}: its module needs {error.name!r}, which is not installed"
            ) from error
        raise InputError(
            f"{kind} {name!r}: no module {module!r} in {here} or on Python's path{alternatives}"
        ) from None
    except Exception as error:
        if isinstance(error, AttributeError) and module in sys.modules:
            file = sys.modules[module].__file__
            raise InputError(f"{kind} {name!r}: module {module!r} ({file}) has no {class_name!r}") from None
        at = traceback.extract_tb(error.__traceback__)[-1]
        # Syntax errors say where they are.
        where = "" if isinstance(error, SyntaxError) else f" ({at.filename}, line {at.lineno})"
        raise InputError(
            f"{kind} {name!r}: its module fails: {type(error).__name__}: {error}{where}"
        ) from error
    if not isinstance(named, type) or not callable(getattr(named, method.partition("(")[0], None)):
        raise InputError(f"{kind} {name!r}: has no method {method}")
    return named


def failure_of(error: Exception, names: Iterable[str]) -> InputError | None:
    """Return what to tell of an error in one of the classes, `MODULE:CLASS`; None if none had to do with it."""
    in_process = (name for name in names if name.partition(":")[0] in sys.modules)
    files = {str(file_of_class(name)): name for name in in_process}
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if name := files.get(frame.filename):
            return InputError(
                f"{name} fails: {type(error).__name__}: {error} ({frame.filename}, line {frame.lineno})"
            )
    return None


def find_module(name: str) -> str | None:
    """Return where the module of `MODULE:CLASS` would be imported from, without importing it; None if nowhere."""
    folders: Sequence[str] = [*sys.path, str(Path.cwd())]
    origin = None
    for part in name.partition(":")[0].split("."):
        if (spec := PathFinder.find_spec(part, folders)) is None:
            return None
        folders, origin = spec.submodule_search_locations or (), spec.origin
    return origin


def file_of_class(name: str) -> Path | None:
    file = sys.modules[name.partition(":")[0]].__file__
    return None if file is None else Path(file)
