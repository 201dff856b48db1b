"""A step of the only search there is, called from Python at little cost.

Numba takes every array apart that it is handed, which for all the arrays of a `Search` takes several times as long as
the step itself. So `held` writes down once what they are taken apart into, and a step reads that off one array.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import float32, float64, int32, int64, types
from numba.core.errors import TypingError
from numba.extending import intrinsic
from numpy.typing import NDArray

from parkenv.envs.search_step import Search, begin, kernel, renew, step_one, tell_time
from parkenv.world.occupancy import IntArray

_SEARCH = types.NamedTuple(
    (
        int64[:, ::1], int32[::1], float64[::1], float64[::1],
        float64[:, ::1], int64[:, ::1], float64[:, ::1], int32[:, :, ::1], int32[:, ::1],
        float64[:, :, ::1], float32[:, ::1], float32[:, :, ::1],
    ),
    Search,
)  # fmt: skip
_HELD = types.Tuple((_SEARCH, float32[::1]))
_ROOM = 160
"""Words that hold all of that, with some to spare: an array is its address, its shape, its strides and 4 more."""


def held(search: Search, clock: NDArray[np.float32]) -> IntArray:
    """What is handed to `begin_alone` and `step_alone` instead of a search and a clock, (2,) s.

    It is good for this process, and for as long as these arrays are kept.
    """
    room = np.zeros(_ROOM, dtype=np.int64)
    _hold(room, (search, clock))
    return room


@kernel
def begin_alone(room: IntArray) -> None:
    """Begin the search that `room` holds, and write the time into its clock."""
    search, clock = _read(room)
    begin(search, 0)
    tell_time(search, 0, clock)


@kernel
def step_alone(room: IntArray, action: int) -> None:
    """Step the search that `room` holds, bring the full belief up to date, and write the time into its clock.

    Args:
        room: from `held`.
        action: one that there is.
    """
    search, clock = _read(room)
    step_one(search, 0, action)
    renew(search, 0)
    tell_time(search, 0, clock)


@kernel
def _hold(room: IntArray, what: tuple[Search, NDArray[np.float32]]) -> None:
    _write(room, what)


@intrinsic
def _write(_: Any, room: Any, what: Any) -> Any:
    # Numba itself would take arrays of another type for those that will be read.
    if what != _HELD:
        raise TypingError(f"held: got {what}, wanted {_HELD}")

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        assert context.get_abi_sizeof(values[1].type) <= _ROOM * 8, "_ROOM is too small"
        to = context.make_array(signature.args[0])(context, builder, values[0]).data
        builder.store(values[1], builder.bitcast(to, values[1].type.as_pointer()))
        return context.get_dummy_value()

    return types.void(room, what), code


@intrinsic
def _read(_: Any, room: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        at = context.make_array(signature.args[0])(context, builder, values[0]).data
        return builder.load(builder.bitcast(at, context.get_value_type(_HELD).as_pointer()))

    return _HELD(room), code
