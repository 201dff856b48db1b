"""Numbers in words: with nouns and intervals, for tables, titles and sentences; which searches have an interval."""

from __future__ import annotations

import re

LEAST_SEARCHES = 5  # searches below which no interval is shown: a bootstrap of fewer covers less than 95 %


def plural(number: int, noun: str, several: str | None = None) -> str:
    """Return a number with its noun, in the singular for 1.

    Examples:
        >>> plural(1, "episode"), plural(20, "episode"), plural(2, "search", "searches")
        ('1 episode', '20 episodes', '2 searches')
    """
    return f"{number} {noun if number == 1 else several or f'{noun}s'}"


def number_text(value: float, spec: str) -> str:
    """Format a number; one that is rounded to zero has no sign.

    Examples:
        >>> number_text(-0.04, "+.1f"), number_text(0.06, "+.1f")
        ('0.0', '+0.1')
    """
    return re.sub(r"^[+-](?=[0.]*%?$)", "", format(value, spec))


def interval_text(value: float, ends: tuple[float, float] | list[float] | None, spec: str) -> str:
    """Format a value and its interval, if there is one.

    Examples:
        >>> interval_text(0.0, (-1.0, 0.0), "+.1f"), interval_text(2.0, (float("nan"),) * 2, ".0f")
        ('0.0 [-1.0, 0.0]', '2')
    """
    if ends is None or ends[0] != ends[0]:
        return number_text(value, spec)
    return f"{number_text(value, spec)} [{', '.join(number_text(end, spec) for end in ends)}]"


def slots_text(right: float, unknown: float) -> str:
    return f"{right:.1%} right, {unknown:.1%} unknown, {max(1.0 - right - unknown, 0.0):.1%} wrong"
