"""Errors of the simulated sensors, and the checks that raise them."""

import math

import numpy as np
from numpy.typing import ArrayLike

from parkenv.compiled.arrays import FloatArray, IntArray


class SensorError(ValueError):
    """An invalid scene, sensor or pose."""


def as_floats(name: str, value: ArrayLike, *shape: int | None) -> FloatArray:
    """Return `value` as a finite, read-only float64 array of a shape, None for any length; `()` has no rows."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SensorError(f"{name} is {value!r}, want numbers") from error
    if array.ndim and not len(array) and not shape[0]:
        array = array.reshape([length or 0 for length in shape])
    if array.ndim != len(shape) or any(w not in (None, n) for w, n in zip(shape, array.shape, strict=True)):
        wanted = ", ".join("any" if length is None else str(length) for length in shape)
        raise SensorError(f"{name} has shape {array.shape}, want ({wanted})")
    if not np.isfinite(array).all():
        place = np.argwhere(~np.isfinite(array))[0]
        raise SensorError(f"{name}{place.tolist()} is {array[tuple(place)]}, want a finite number")
    array.setflags(write=False)
    return array


def as_integers(name: str, value: ArrayLike, n: int, least: int | None = None) -> IntArray:
    array = np.asarray(value)
    if array.shape != (n,) or (n and not np.issubdtype(array.dtype, np.integer)):
        raise SensorError(f"{name} has shape {array.shape} of {array.dtype}, want ({n},) integers")
    if least is not None and array.min(initial=least) < least:
        raise SensorError(f"{name} is {array.min()}, want {least} or more")
    return array.astype(np.int64)


def require_numbers(
    owner: object,
    names: str,
    *,
    least: float = -math.inf,
    above: float = -math.inf,
    most: float = math.inf,
    below: float = math.inf,
) -> None:
    """Check that attributes of an object are finite numbers within limits."""
    for name in names.split():
        value = getattr(owner, name)
        is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if not (is_number and math.isfinite(value) and least <= value <= most and above < value < below):
            limits = {"at least": least, "above": above, "at most": most, "below": below}
            wanted = "".join(f", {word} {end:g}" for word, end in limits.items() if math.isfinite(end))
            raise SensorError(f"{name} is {value!r}, want a finite number{wanted}")


def require_seed(seed: object) -> None:
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise SensorError(f"seed is {seed!r}, want an integer, 0 or more")
