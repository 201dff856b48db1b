"""Typed access from compiled code to arrays and records by addresses stored in records.

A kernel that takes one record with the addresses of all its data compiles several times as fast as one that takes a
dozen arrays, and is cheap to call from Python. Code that writes an address into a record must keep the array alive.
"""

import math
import mmap
from collections.abc import Sequence
from functools import cache
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np import arrayobj
from numpy.typing import NDArray

from parkenv.compiled.jit import compiled

LINE = 64  # bytes of a cache line
_SMALL = 4096  # bytes
ADDRESS = np.int64  # type of the fields of a record that hold addresses


def address_of(array: NDArray[Any], dtype: Any) -> int:
    """Return the address of the first element of a contiguous array of the given type.

    Raises:
        TypeError: the array has another type or is not contiguous; compiled code would misread it.
    """
    if array.dtype != np.dtype(dtype) or not array.flags.c_contiguous:
        raise TypeError(f"array of {array.dtype}, contiguous {array.flags.c_contiguous}; want {dtype}, True")
    return int(array.ctypes.data)


def in_one_block(arrays: Sequence[NDArray[Any]]) -> list[NDArray[Any]]:
    """Copy arrays into one block of memory; small read-only ones that are equal share a copy.

    Systems keep large blocks in large pages, so compiled code finds its way through many small tables faster.
    """
    keys: list[Any] = [
        i
        if array.flags.writeable or array.nbytes > _SMALL
        else (array.tobytes(), array.dtype.str, array.shape)
        for i, array in enumerate(arrays)
    ]
    different = dict(zip(keys, arrays, strict=True))
    begins = np.cumsum([0, *(-(-array.nbytes // LINE) * LINE for array in different.values())])
    block = np.zeros(int(begins[-1]) + LINE, np.uint8)
    block = block[-block.ctypes.data % LINE :]
    copies = {}
    for (key, array), begin in zip(different.items(), begins, strict=False):
        copies[key] = copy = block[begin : begin + array.nbytes].view(array.dtype).reshape(array.shape)
        if array.dtype.names or array.any():  # pages of zeros that are never written take no memory
            copy[...] = array
    return [copies[key] for key in keys]


def zeros_on_lines(shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
    """Return zeros that begin with a cache line, so that records of whole lines do not reach into others."""
    n_bytes = math.prod(shape) * np.dtype(dtype).itemsize
    memory = np.zeros(n_bytes + LINE, np.uint8)
    begin = -memory.ctypes.data % LINE
    zeros: NDArray[Any] = memory[begin : begin + n_bytes].view(dtype).reshape(shape)
    return zeros


def sparse_zeros(shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
    """Return zeros of which little will be written: memory is taken page by page, and by small pages."""
    n_bytes = math.prod(shape) * np.dtype(dtype).itemsize
    if n_bytes == 0:
        return np.zeros(shape, dtype)
    memory = mmap.mmap(-1, n_bytes)
    if hasattr(mmap, "MADV_NOHUGEPAGE"):
        memory.madvise(mmap.MADV_NOHUGEPAGE)
    return np.frombuffer(memory, dtype).reshape(shape)


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


def _arrays(item: Any) -> Any:
    @intrinsic
    def array(_: Any, address: Any, shape: Any) -> Any:  # noqa: ARG001 - numba passes it
        kind = types.Array(item, len(shape), "C")

        def code(context: Any, builder: Any, _: Any, values: Any) -> Any:
            view = context.make_array(kind)(context, builder)
            itemsize = ir.Constant(ir.IntType(64), context.get_abi_sizeof(context.get_data_type(item)))
            lengths, size = cgutils.unpack_tuple(builder, values[1]), itemsize
            strides: list[Any] = []
            for length in reversed(lengths):
                strides.insert(0, size)
                size = builder.mul(size, length)
            data = builder.inttoptr(values[0], context.get_data_type(item).as_pointer())
            arrayobj.populate_array(view, data, lengths, strides, itemsize, meminfo=None)
            return view._getvalue()

        return kind(types.int64, shape), code

    return array


# In compiled code, `float64_array(address, (m, n))` is the array at an address.
float64_array, uint8_array = _arrays(types.float64), _arrays(types.uint8)
int64_array, int32_array = _arrays(types.int64), _arrays(types.int32)


@intrinsic
def prefetch(_: Any, address: Any) -> Any:  # noqa: ARG001 - numba passes it
    """Load the cache line of an address, which may be any number, without waiting for it."""

    def code(_: Any, builder: Any, __: Any, values: Any) -> Any:
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        fetch = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        # For reading, into all caches, data.
        settings = (number(setting) for setting in (0, 3, 1))
        builder.call(fetch, [builder.inttoptr(values[0], byte), *settings])

    return types.void(types.int64), code


@intrinsic
def call_at(_: Any, address: Any, one: Any, other: Any) -> Any:  # noqa: ARG001 - numba passes them
    """Call the compiled function at an address from `call_address` with two int64; returns an int64."""

    def code(_: Any, builder: Any, __: Any, values: Any) -> Any:
        number = ir.IntType(64)
        function = ir.FunctionType(number, [number, number]).as_pointer()
        return builder.call(builder.inttoptr(values[0], function), values[1:])

    return types.int64(types.int64, types.int64, types.int64), code


@intrinsic
def call_world_at(_: Any, address: Any, data: Any, slot: Any, time: Any) -> Any:  # noqa: ARG001 - numba passes them
    """Call the function at an address with int64 data and slot and a float64 time; returns a float64."""

    def code(_: Any, builder: Any, __: Any, values: Any) -> Any:
        number, real = ir.IntType(64), ir.DoubleType()
        function = ir.FunctionType(real, [number, number, real]).as_pointer()
        return builder.call(builder.inttoptr(values[0], function), values[1:])

    return types.float64(types.int64, types.int64, types.int64, types.float64), code


def call_address(function: Any) -> int:
    """Return the address of a compiled function of two int64 that returns an int64, for `call_at`.

    An exception in the function is printed, and it then returns 0.
    """
    signature = types.int64(types.int64, types.int64)
    from_c = _callable_from_c(function)
    from_c.compile(signature)
    code = from_c.overloads[signature.args]
    return int(code.library.get_pointer_to_function(code.fndesc.llvm_cfunc_wrapper_name))


@cache
def _callable_from_c(function: Any) -> Any:
    options = {name: value for name, value in function.targetoptions.items() if name != "nopython"}
    return compiled(**options | {"no_cfunc_wrapper": False})(function.py_func)


def part_of(dtype: Any) -> Any:
    """Return a function for compiled code: record -> the part of it that has the fields of a type, at their distances.

    Functions that take the part are compiled once for all records that have it.
    """
    part = numba.from_dtype(np.dtype(dtype))
    names = [name for name, _ in part.members]

    @intrinsic
    def view(_: Any, record: Any) -> Any:
        begin = record.offset(names[0]) - part.offset(names[0])
        layout = [(name, record.typeof(name), record.offset(name) - begin) for name in names]
        if layout != [(name, part.typeof(name), part.offset(name)) for name in names]:
            raise TypeError(f"the fields {names} of {record} lie otherwise than in {part}")

        def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            start = cgutils.pointer_add(builder, values[0], begin)
            return builder.bitcast(start, context.get_value_type(signature.return_type))

        return part(record), code

    return view


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
