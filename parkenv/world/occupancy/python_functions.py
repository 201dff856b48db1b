"""Functions by which compiled code asks a world that is written in Python.

A compiled search calls them at an address, so it needs no other path for such a world. An exception in the world is
kept while compiled code runs, and raised by `raise_error` after it.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

import numpy as np

from parkenv.compiled.memory import address_of
from parkenv.world.occupancy.kernel import FUNCTIONS

if TYPE_CHECKING:
    from parkenv.world.occupancy.process import World

_worlds: WeakValueDictionary[int, World] = WeakValueDictionary()
_errors: list[BaseException] = []

_TYPE = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_int64, ctypes.c_int64, ctypes.c_double)


@_TYPE
def _state(number: int, slot: int, time: float) -> float:
    try:
        return float(np.asarray(_worlds[number].occupied(np.array([slot]), time)).item())
    except BaseException as error:
        _errors.append(error)
        return 0.0


@_TYPE
def _next_free(number: int, slot: int, time: float) -> float:
    try:
        return float(np.asarray(_worlds[number].next_free(np.array([slot]), time)).item())
    except BaseException as error:
        _errors.append(error)
        return time


def functions_of(world: World) -> int:
    """Return the address of a FUNCTIONS record that calls the methods of a world; valid while the world lives."""
    if _worlds.get(id(world)) is not world:
        addresses = (ctypes.cast(function, ctypes.c_void_p).value for function in (_state, _next_free))
        _worlds[id(world)] = world
        # Kept in the world itself; a copy of the world is not among `_worlds` yet and gets a record of its own.
        vars(world)["_functions"] = np.array([(id(world), *addresses)], FUNCTIONS)
    return address_of(vars(world)["_functions"], FUNCTIONS)


def raise_error() -> None:
    """Raise the first exception of a world since the last call, if there was one."""
    if _errors:
        first = _errors[0]
        _errors.clear()
        raise first
