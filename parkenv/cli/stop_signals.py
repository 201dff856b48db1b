"""What SIGINT (Ctrl-C), SIGTERM and SIGHUP do to a command."""

import _thread
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.machinery import ExtensionFileLoader, SourceFileLoader
from types import FrameType

# Functions of importlib that import a compiled module, and that read a file of a module in Python.
_IMPORTS = (
    ExtensionFileLoader.create_module.__code__,
    ExtensionFileLoader.exec_module.__code__,
    SourceFileLoader.get_data.__code__,
)
# Functions of numba and llvmlite that compiled code calls: for the result of a function, and while LLVM compiles.
_CALLED_BY_NUMBA = {"_numba_unpickle", "_raw_object_cache_notify", "_raw_object_cache_getbuffer"}


def unsafe_to_raise(frame: FrameType | None) -> bool:
    """Return whether an exception raised in a frame would end the process, be lost or leave a file open.

    Compiled code that called this code may end the process or lose the exception: modules in C++ while they are
    imported, and numba while it compiles and while it makes Python objects. A file stays open where importlib has
    opened a module's file and not yet entered its `with`: Python warns of that where warnings are on.
    """
    while frame is not None:
        if frame.f_code in _IMPORTS or frame.f_code.co_name in _CALLED_BY_NUMBA:
            return True
        frame = frame.f_back
    return False


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
