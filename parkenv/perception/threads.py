"""One pool of threads for the parts of perception that run beside each other."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

from numba import get_num_threads

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_threads(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Return the result of each item, in their order; on as many cores as numba uses.

    Args:
        work: a function that mostly runs compiled code without the interpreter lock, and does not call this function.
        items: its arguments.
    """
    n = get_num_threads()
    if n == 1 or len(items) < 2:
        return [work(item) for item in items]
    waiting = [_pool(n).submit(work, item) for item in items[1:]]
    # The calling thread takes a part, too.
    first = work(items[0])
    return [first, *(one.result() for one in waiting)]


@lru_cache(maxsize=1)
def _pool(n: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=n, thread_name_prefix="perception")


# A forked process has none of the threads.
os.register_at_fork(after_in_child=_pool.cache_clear)
