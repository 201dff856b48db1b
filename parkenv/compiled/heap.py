"""A binary heap of whole numbers by key, for compiled searches over a graph and queues of events."""

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled


@compiled(error_model="numpy")
def push(
    keys: FloatArray,
    items: NDArray[np.int32],
    size: int,
    key: float,
    item: int,
    ranks: IntArray | None = None,
) -> int:
    """Insert an item into a binary heap of `size` keys and items, lowest key first; return its new size.

    `ranks`, indexed by item, orders items with equal keys; None: any order.
    """
    i = size
    while i > 0:
        above = (i - 1) >> 1
        if not _is_before(key, item, keys[above], items[above], ranks):
            break
        keys[i], items[i] = keys[above], items[above]
        i = above
    keys[i], items[i] = key, item
    return size + 1


@compiled(error_model="numpy")
def pop(keys: FloatArray, items: NDArray[np.int32], size: int, ranks: IntArray | None = None) -> int:
    """Remove the first item, which the caller has read, from a binary heap; return its new size."""
    size -= 1
    key, item = keys[size], items[size]
    i = 0
    while True:
        below = 2 * i + 1
        if below >= size:
            break
        after = below + 1
        if after < size and _is_before(keys[after], items[after], keys[below], items[below], ranks):
            below = after
        if not _is_before(keys[below], items[below], key, item, ranks):
            break
        keys[i], items[i] = keys[below], items[below]
        i = below
    keys[i], items[i] = key, item
    return size


@compiled(error_model="numpy", forceinline=True)
def _is_before(key: float, item: int, other_key: float, other: int, ranks: IntArray | None) -> bool:
    if ranks is not None and key == other_key:
        return bool(ranks[item] < ranks[other])
    return key < other_key
