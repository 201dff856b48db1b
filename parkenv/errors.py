"""The one exception that bad input raises, and hints for misspelt names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """Input that cannot be used; the message names file, field, value and what was wanted.

    The command line turns it into one line on standard error and exit code 2.
    """


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a hint for a misspelt name: the closest known name, and all known names.

    Examples:
        >>> nearest("gredy", ["mdp", "greedy"])
        "did you mean 'greedy'? known: mdp, greedy"
    """
    names = list(known)
    begun = [its for its in names if name and its.startswith(name)]
    close = begun or difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    return (f"did you mean {close[0]!r}? " if close else "") + f"known: {', '.join(names) or 'none'}"
