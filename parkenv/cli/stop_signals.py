"""What SIGINT (Ctrl-C), SIGTERM and SIGHUP do to a command."""

from __future__ import annotations

import _thread
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from parkenv.studies.interruption import unsafe_to_raise


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Raise KeyboardInterrupt on each of the signals during the block; yield the list of signals received so far.

    Signals that the caller of the process ignores, such as SIGHUP under `nohup`, stay ignored. A signal that comes
    where an exception would do harm is sent again until it comes elsewhere.
    """
    received: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        if unsafe_to_raise(frame):
            _thread.start_new_thread(os.kill, (os.getpid(), number))
            return
        received.append(number)
        raise KeyboardInterrupt

    before = {}
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) != signal.SIG_IGN:
                before[number] = signal.signal(number, stop)
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
