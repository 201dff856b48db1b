"""The seconds that this process has spent on compiling functions and loading compiled code."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import event


class _Clock(event.Listener):  # type: ignore[misc]
    """Counts the time of everything that numba compiles, once where functions compile each other."""

    total_s = 0.0
    _depth = 0
    _begun = 0.0

    def on_start(self, event: Any = None) -> None:  # noqa: ARG002 - numba's interface
        if self._depth == 0:
            self._begun = time.perf_counter()
        self._depth += 1

    def on_end(self, event: Any = None) -> None:  # noqa: ARG002
        self._depth -= 1
        if self._depth == 0:
            self.total_s += time.perf_counter() - self._begun


_CLOCK = _Clock()
event.register("numba:compile", _CLOCK)


@contextmanager
def counted() -> Iterator[None]:
    """Count the seconds of a block, such as one that loads compiled code."""
    _CLOCK.on_start()
    try:
        yield
    finally:
        _CLOCK.on_end()


def seconds_spent() -> float:
    """Return the seconds that this process has spent so far on compiling and loading compiled code.

    Subtract the difference between two calls from a measured time to exclude compilation.
    """
    return _CLOCK.total_s
