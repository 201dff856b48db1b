"""Typed access from compiled code to arrays and records by addresses stored in records.

A kernel that takes one record with the addresses of all its data compiles several times as fast as one that takes a
dozen arrays, and is cheap to call from Python. Code that writes an address into a record must keep the array alive.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

ADDRESS = np.int64  # type of the fields of a record that hold addresses


def address_of(array: NDArray[Any], dtype: Any) -> int:
    """Return the address of the first element of a contiguous array of the given type.

    Raises:
        TypeError: the array has another type or is not contiguous; compiled code would misread it.
    """
    if array.dtype != np.dtype(dtype) or not array.flags.c_contiguous:
        raise TypeError(
            f"array of {array.dtype}, contiguous {array.flags.c_contiguous}; wanted {dtype}, True"
        )
    return int(array.ctypes.data)


def _elements(item: Any) -> Any:
    @intrinsic
    def elements(_: Any, address: Any) -> Any:  # noqa: ARG001 - numba passes it
        def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            return builder.inttoptr(values[0], context.get_value_type(signature.return_type))

        return types.CPointer(item)(types.int64), code

    return elements


# In compiled code, `float64s(address)[i]` reads and writes element i of the array of float64 at an address.
float64s, float32s = _elements(types.float64), _elements(types.float32)
int64s, int32s, uint8s = _elements(types.int64), _elements(types.int32), _elements(types.uint8)


def record_at(dtype: Any) -> Any:
    """Return a function for compiled code: (address, index) -> record `index` of the array of records there."""
    dtype = np.dtype(dtype)
    record = numba.from_dtype(dtype)

    @intrinsic
    def at(_: Any, address: Any, index: Any) -> Any:  # noqa: ARG001 - numba passes them
        def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            offset = builder.mul(values[1], context.get_constant(types.int64, dtype.itemsize))
            start = builder.add(values[0], offset)
            return builder.inttoptr(start, context.get_value_type(signature.return_type))

        return record(types.int64, types.int64), code

    return at
