"""A binary heap of vertices by label, for compiled searches over a graph."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled


@compiled(error_model="numpy")
def push(keys: FloatArray, vertices: NDArray[np.int32], size: int, key: float, vertex: int) -> int:
    """Insert a vertex into a binary heap; return its new size."""
    i = size
    while i > 0:
        above = (i - 1) >> 1
        if keys[above] <= key:
            break
        keys[i], vertices[i] = keys[above], vertices[above]
        i = above
    keys[i], vertices[i] = key, vertex
    return size + 1


@compiled(error_model="numpy")
def pop(keys: FloatArray, vertices: NDArray[np.int32], size: int) -> int:
    """Remove the first vertex, which the caller has read, from a binary heap; return its new size."""
    size -= 1
    key, vertex = keys[size], vertices[size]
    i = 0
    while True:
        below = 2 * i + 1
        if below >= size:
            break
        if below + 1 < size and keys[below + 1] < keys[below]:
            below += 1
        if keys[below] >= key:
            break
        keys[i], vertices[i] = keys[below], vertices[below]
        i = below
    keys[i], vertices[i] = key, vertex
    return size
