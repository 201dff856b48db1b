"""Functions by which compiled code asks a world that is written in Python.

A compiled search calls them at an address, so it needs no other path for such a world. An exception in the world is
kept while compiled code runs, and raised by `raise_error` after it.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

import numpy as np

from parkenv.compiled.memory import address_of
from parkenv.world.occupancy.kernel import FUNCTIONS

if TYPE_CHECKING:
    from parkenv.world.occupancy.process import World

_worlds: WeakValueDictionary[int, World] = WeakValueDictionary()
_errors: list[BaseException] = []

_TYPE = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_int64, ctypes.c_int64, ctypes.c_double)


def _function(method: str) -> Any:
    """Return a function (number of the world, slot, time, s) that calls a method of the world for a slot."""

    def call(number: int, slot: int, time: float) -> float:
        try:
            return float(np.asarray(getattr(_worlds[number], method)(np.array([slot]), time)).item())
        except BaseException as error:
            _errors.append(error)
            return time

    return _TYPE(call)


# In the order of the fields of FUNCTIONS.
_FUNCTIONS = tuple(_function(method) for method in ("occupied", "next_free"))


def functions_of(world: World) -> int:
    """Return the address of a FUNCTIONS record that calls the methods of a world; valid while the world lives."""
    if _worlds.get(id(world)) is not world:
        addresses = (ctypes.cast(function, ctypes.c_void_p).value for function in _FUNCTIONS)
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
