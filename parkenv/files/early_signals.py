"""What signals do to the command while it is imported; `parkenv.cli.stop_signals` takes over later."""

from __future__ import annotations

import os
import signal
import sys
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
    """Let Ctrl-C and the like end this process at once with exit code 128 + n, where they have no other handler."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, _end)


def _end(number: int, frame: FrameType | None) -> None:
    del frame
    os._exit(128 + number)
