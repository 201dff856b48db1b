"""Classes of the user's own, named `MODULE:CLASS` on a command line or in a file."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from parkenv.errors import InputError


def load_class(name: str, kind: str, method: str, *, alternatives: str = "") -> Any:
    """Import the class that `MODULE:CLASS` names; the module may be in the working directory.

    Args:
        name: such as `my_detectors:Mine`.
        kind: what the class is used as, for messages: `agent`, `detector`.
        method: the method that the class must have, with its parameters: `detect(image)`.
        alternatives: what else the part before the colon may be, for the message.

    Raises:
        InputError: no such module or class, or a class without the method.
    """
    module, _, class_name = name.partition(":")
    here = str(Path.cwd())
    # As `python -m` does; an installed command would search its own folder instead.
    if here not in sys.path:
        sys.path.insert(0, here)
    try:
        found = getattr(import_module(module), class_name)
    except ModuleNotFoundError as error:
        if error.name != module.partition(".")[0]:
            raise
        raise InputError(
            f"{kind} {name!r}: no module {module!r} in {here} or on Python's path{alternatives}"
        ) from None
    except AttributeError:
        raise InputError(f"{kind} {name!r}: module {module!r} has no {class_name!r}") from None
    if not callable(getattr(found, method.partition("(")[0], None)):
        raise InputError(f"{kind} {name!r}: has no method {method}")
    return found


def file_of_class(name: str) -> Path | None:
    """Return the file of the module in `MODULE:CLASS`, which `load_class` has imported; None if it has no file."""
    file = sys.modules[name.partition(":")[0]].__file__
    return None if file is None else Path(file)
