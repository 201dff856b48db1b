"""Early signals of the command, and protection of it and its workers from files in the working folder.

The working folder may be a stranger's. A command never looks for modules there; processes that it starts would, and
libraries read settings there. Users' classes are still found: `parkenv.files.user_class` adds the folder when one is
named.
"""

import os
import signal
import sys
from contextlib import chdir
from importlib import import_module
from pathlib import Path
from types import FrameType


def is_command() -> bool:
    """Whether this process is `parkenv` or `python -m parkenv`, and not a program that imports the package."""
    file = getattr(sys.modules.get("__main__"), "__file__", None)
    if file is not None:
        # On Windows the command is an archive.
        return Path(file).name == "parkenv" or Path(file).parent.name == "parkenv.exe"
    # A module's package is imported before the module is; its arguments follow its name.
    return sys.argv[:1] == ["-m"] and sys.orig_argv[-len(sys.argv)] == "parkenv"


def end_on_signals() -> None:
    """Let Ctrl-C and the like end this process with code 128 + n, until `parkenv.cli.stop_signals` takes over."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, _end)


def _end(number: int, frame: FrameType | None) -> None:
    del frame
    os._exit(128 + number)


# Files that libraries read in the working folder when they are imported: numba's sets where compiled code is kept.
_SETTINGS = {".numba_config.yaml": "numba", "matplotlibrc": "matplotlib"}


def distrust_working_folder() -> None:
    """Let neither libraries nor Python, in processes that start from now on, read files of the working folder."""
    os.environ["PYTHONSAFEPATH"] = "1"
    skip_settings()


def skip_settings() -> None:
    for file, library in _SETTINGS.items():
        if library not in sys.modules and os.path.lexists(file):
            with chdir(Path(__file__).parent):
                import_module(library)
    if numba := sys.modules.get("numba.core.config"):
        # Numba reads the file again whenever it compiles.
        numba._config_fname = os.devnull  # type: ignore[attr-defined]
