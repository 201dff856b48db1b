"""One pool of threads for sensors and perception: pictures are drawn beside each other, and then looked at."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from typing import TypeVar

from numba import get_num_threads, set_num_threads

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_threads(work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Return the result of each item, in their order; on as many cores as numba uses.

    `work` mostly runs compiled code without the interpreter lock. Within it, compiled loops and this function itself
    use one core: the items share the cores among them.
    """
    n = get_num_threads()
    if n == 1 or len(items) < 2:
        return [work(item) for item in items]
    waiting = [_pool(n).submit(work, item) for item in items[1:]]
    # The calling thread takes a part, too.
    set_num_threads(1)
    try:
        first = work(items[0])
    finally:
        set_num_threads(n)
    return [first, *(one.result() for one in waiting)]


def ahead_in_threads(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[tuple[Item, Result]]:
    """Yield each item and its result, in their order; a few are worked on ahead, on as many cores as numba uses."""
    n, waiting = get_num_threads(), deque[tuple[Item, Future[Result]]]()
    if n == 1:
        yield from ((item, work(item)) for item in items)
        return
    for item in items:
        waiting.append((item, _pool(n).submit(work, item)))
        if len(waiting) > n:
            first, done = waiting.popleft()
            yield first, done.result()
    for first, done in waiting:
        yield first, done.result()


@lru_cache(maxsize=1)
def _pool(n: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(n, "perception", set_num_threads, (1,))


# A forked process has none of the threads.
os.register_at_fork(after_in_child=_pool.cache_clear)
