"""What SIGINT (Ctrl-C), SIGTERM and SIGHUP do to a command."""

from __future__ import annotations

import _thread
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.machinery import ExtensionFileLoader
from types import FrameType

_IMPORTS_COMPILED = (ExtensionFileLoader.create_module.__code__, ExtensionFileLoader.exec_module.__code__)
_CALLED_BY_NUMBA = {"_numba_unpickle", "_raw_object_cache_notify", "_raw_object_cache_getbuffer"}
"""Functions of numba and llvmlite that compiled code calls: for the result of a function, and while LLVM compiles."""


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """Raise KeyboardInterrupt on each of the signals during the block; yield the list of signals received so far.

    Signals that the caller of the process ignores, such as SIGHUP under `nohup`, stay ignored. A signal that comes
    where an exception would crash the process is sent again until it comes elsewhere.
    """
    received: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        if _would_crash(frame):
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


def _would_crash(frame: FrameType | None) -> bool:
    """Whether compiled code has called this code, and would end the process, or lose the exception, if it raised one.

    So do modules in C++ while they are imported, and numba while it compiles and while it makes Python objects.
    """
    while frame is not None:
        if frame.f_code in _IMPORTS_COMPILED or frame.f_code.co_name in _CALLED_BY_NUMBA:
            return True
        frame = frame.f_back
    return False
