"""The one exception that bad input raises, the checks that raise it, and hints for misspelt names."""

from __future__ import annotations

import difflib
import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from numbers import Integral, Real
from typing import Any


class InputError(ValueError):
    """Input that cannot be used; the message names file, field, value and what was wanted.

    The command line turns it into one line on standard error and exit code 2.
    """


def needs_extra(what: str, extra: str) -> str:
    return f'{what} needs the extra {extra}: pip install "parkenv[{extra}]"'


@contextmanager
def with_extra(what: str, extra: str) -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        raise InputError(f"{needs_extra(what, extra)} ({error})") from error


@contextmanager
def naming(source: object) -> Iterator[None]:
    """Let the messages of InputErrors in the block begin with the source that they are about, such as a file."""
    try:
        yield
    except InputError as error:
        if str(error).startswith(f"{source}: "):
            raise
        raise InputError(f"{source}: {error}") from error


def require(good: object, message: str) -> None:
    """Raise an InputError with the message unless the condition holds."""
    if not good:
        raise InputError(message)


def require_number(
    name: str,
    value: Any,
    *,
    above: float | None = None,
    least: float | None = None,
    below: float | None = None,
    most: float | None = None,
    finite: bool = True,
) -> None:
    """Check that a value is a number within bounds, each of which may be absent.

    Examples:
        >>> require_number("every", -1.0, above=0.0)
        Traceback (most recent call last):
        parkenv.errors.InputError: every is -1.0, want a finite number above 0
    """
    good = not isinstance(value, bool) and isinstance(value, Real) and not math.isnan(value)
    if (
        not good
        or (finite and math.isinf(value))
        or (above is not None and not value > above)
        or (least is not None and not value >= least)
        or (below is not None and not value < below)
        or (most is not None and not value <= most)
    ):
        bounds = {"above": above, "at least": least, "below": below, "at most": most}
        wanted = " and ".join(f"{word} {bound:g}" for word, bound in bounds.items() if bound is not None)
        if least is not None and most is not None:
            wanted = f"from {least:g} to {most:g}"
        kind = "a finite number" if finite else "a number"
        raise InputError(f"{name} is {value!r:.60}, want {kind} {wanted}".rstrip())


def require_whole(name: str, value: Any, *, least: int = 0, most: int | None = None) -> None:
    """Check that a value is a whole number of at least `least` and, unless that is None, at most `most`."""
    good = not isinstance(value, bool) and isinstance(value, Integral)
    if not good or value < least or (most is not None and value > most):
        wanted = f"of at least {least}" if most is None else f"from {least:,} to {most:,}"
        raise InputError(f"{name} is {value!r:.60}, want a whole number {wanted}")


def require_one_of(name: str, value: object, known: Collection[object]) -> None:
    if value not in known:
        raise InputError(f"{name} is {value!r:.60}, want one of {', '.join(map(str, known)) or 'none'}")


# Options of `reset` that wrappers of other libraries take for themselves and pass on.
_FOREIGN_OPTIONS = ("minari_autoseed",)


def reset_options(options: object, known: Collection[str]) -> dict[str, Any]:
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise InputError(f"options is {options!r:.60}, want a dictionary or None")
    given = {name: value for name, value in options.items() if name not in _FOREIGN_OPTIONS}
    for name in given:
        require_one_of("option of reset", name, known)
    return given


def require_keywords(function: str, given: Iterable[str], known: Collection[str]) -> None:
    """Check the names of keyword arguments.

    Raises:
        TypeError: one is unknown, in Python's own words; with the closest known name, and all known names.
    """
    for name in given:
        if name not in known:
            raise TypeError(
                f"{function}() got an unexpected keyword argument {name!r}; {nearest(name, known)}"
            )


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a hint for a misspelt name: the closest known name, and all known names.

    Examples:
        >>> nearest("gredy", ["mdp", "greedy"])
        "did you mean 'greedy'? known: mdp, greedy"
    """
    names = list(known)
    begun = [other for other in names if name and other.startswith(name)]
    close = begun or difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    return (f"did you mean {close[0]!r}? " if close else "") + f"known: {', '.join(names) or 'none'}"
