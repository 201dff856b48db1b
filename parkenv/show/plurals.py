"""Numbers with their nouns, for titles and sentences, and how many searches have an interval."""

from __future__ import annotations

LEAST_SEARCHES = 5
"""Searches below which no interval is shown: a bootstrap of fewer covers less than 95 %."""


def plural(number: int, noun: str, several: str | None = None) -> str:
    """Return a number with its noun, in the singular for 1.

    Examples:
        >>> plural(1, "episode"), plural(20, "episode"), plural(2, "search", "searches")
        ('1 episode', '20 episodes', '2 searches')
    """
    return f"{number} {noun if number == 1 else several or f'{noun}s'}"
