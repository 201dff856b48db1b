"""Tasks for tests of workers, in a separate module that worker processes can import."""

import logging
import os
import signal
import time
from pathlib import Path

from parkenv.errors import InputError


def refuse(value: int) -> None:
    raise InputError(f"value is {value}")


def square(number: int) -> int:
    return number * number


def square_killed_once(marker: str, number: int) -> int:
    """As `square`, but the first process that gets number 3 is killed in the middle of it."""
    time.sleep(0.05)
    if number == 3:
        try:
            Path(marker).touch(exist_ok=False)
        except FileExistsError:
            pass
        else:
            os.kill(os.getpid(), signal.SIGKILL)
    with Path(f"{marker}.{number}").open("a") as file:
        file.write("run\n")
    return number * number


def warn() -> None:
    """Say what a worker says that compiles."""
    logging.getLogger("parkenv").warning("compiling functions for this machine")


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def wait(folder: str) -> None:
    """Leave a file named after this process, and work on."""
    Path(folder, str(os.getpid())).touch()
    time.sleep(60.0)
