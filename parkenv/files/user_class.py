"""User-defined classes, named `MODULE:CLASS` on a command line or in a file."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterable, Sequence
from importlib import import_module
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

from parkenv.errors import InputError


def load_class(name: str, kind: str, method: str, *, alternatives: str = "") -> Any:
    """Import the class `MODULE:CLASS`; the module may be in the working directory.

    Args:
        name: name, such as `my_detectors:Mine`.
        kind: role of the class, for messages: `agent`, `detector`.
        method: required method of the class, with its parameters: `detect(image)`.
        alternatives: other valid values for the part before the colon, for the message.
    """
    module, _, class_name = name.partition(":")
    if not all(part.isidentifier() for part in (*module.split("."), class_name)):
        raise InputError(f"{kind} {name!r}: want MODULE:CLASS{alternatives}")
    here = str(Path.cwd())
    # Last, so that no other module there replaces one of Python's own or of a library.
    if here not in sys.path:
        sys.path.append(here)
    try:
        found = getattr(import_module(module), class_name)
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
    if not isinstance(found, type) or not callable(getattr(found, method.partition("(")[0], None)):
        raise InputError(f"{kind} {name!r}: has no method {method}")
    return found


def failure_of(error: Exception, names: Iterable[str]) -> InputError | None:
    """Return what to tell of an error in one of the classes, `MODULE:CLASS`; None if none had to do with it."""
    files = {
        str(file_of_class(name)): name for name in names if name.partition(":")[0] in sys.modules
    }  # in this process
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if name := files.get(frame.filename):
            return InputError(
                f"{name} fails: {type(error).__name__}: {error} ({frame.filename}, line {frame.lineno})"
            )
    return None


def find_module(name: str) -> str | None:
    """Return where the module of `MODULE:CLASS` would be imported from, without importing it; None if nowhere."""
    folders: Sequence[str] = [*sys.path, str(Path.cwd())]
    found = None
    for part in name.partition(":")[0].split("."):
        found = PathFinder.find_spec(part, folders)
        if found is None:
            return None
        folders = found.submodule_search_locations or ()
    return None if found is None else found.origin


def file_of_class(name: str) -> Path | None:
    file = sys.modules[name.partition(":")[0]].__file__
    return None if file is None else Path(file)
