"""The seconds that this process has spent on compiling functions and loading compiled code."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class _Clock:
    total_s = 0.0
    depth = 0


@contextmanager
def counted() -> Iterator[None]:
    """Count the seconds of a block, once where blocks are nested."""
    begun = time.perf_counter()
    _Clock.depth += 1
    try:
        yield
    finally:
        _Clock.depth -= 1
        if _Clock.depth == 0:
            _Clock.total_s += time.perf_counter() - begun


def seconds_spent() -> float:
    """Return the seconds that this process has spent so far on compiling and loading compiled code.

    Subtract the difference between two calls from a measured time to exclude compilation.
    """
    return _Clock.total_s
