"""Keep modules and settings in the working folder, which may be a stranger's, out of a command and its workers.

A command never looks for modules there; processes that it starts would, and libraries read settings there. Users'
classes are still found: `parkenv.files.user_class` adds the folder when one is named.
"""

from __future__ import annotations

import os
import sys
from contextlib import chdir
from importlib import import_module
from pathlib import Path

_SETTINGS = {".numba_config.yaml": "numba", "matplotlibrc": "matplotlib"}
"""Files that libraries read in the working folder when they are imported: numba's sets where compiled code is kept."""


def distrust_working_folder() -> None:
    """Let neither libraries nor Python, in processes that start from now on, read files of the working folder."""
    os.environ["PYTHONSAFEPATH"] = "1"
    skip_settings()


def skip_settings() -> None:
    """Import libraries that the working folder has settings for, without these."""
    for file, library in _SETTINGS.items():
        if library not in sys.modules and os.path.lexists(file):
            with chdir(Path(__file__).parent):
                import_module(library)
    if numba := sys.modules.get("numba.core.config"):
        # Numba reads the file again whenever it compiles.
        numba._config_fname = os.devnull  # type: ignore[attr-defined]
