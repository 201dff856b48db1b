"""Tags that an import could not read, and what it assumed instead."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

Notes = dict[tuple[str, str, str], dict[int, Mapping[str, Any]]]
_NOTES: ContextVar[Notes | None] = ContextVar("unread tags", default=None)


@dataclass(frozen=True)
class Unread:
    """A value of a tag that could not be read."""

    tag: str  # the key, or the column of a table
    value: str
    count: int  # number of elements with it
    assumed: str  # what the import assumed instead


def note_unread(tags: Mapping[str, Any], key: str, assumed: str) -> None:
    """Add the value of a key to the table of the running import; an element, known by its tags, counts once."""
    notes = _NOTES.get()
    if notes is not None and key in tags:
        notes.setdefault((key, str(tags[key]), assumed), {})[id(tags)] = tags


def unread_rows(notes: Notes) -> tuple[Unread, ...]:
    """Return the values, sorted by key, the most frequent ones of a key first."""
    rows = (Unread(tag, value, len(of), assumed) for (tag, value, assumed), of in notes.items())
    return tuple(sorted(rows, key=lambda row: (row.tag, -row.count, row.value)))


@contextmanager
def noting_unread() -> Iterator[Notes]:
    """Collect the notes of the block; those of an import around it are its own."""
    notes: Notes = {}
    token = _NOTES.set(notes)
    try:
        yield notes
    finally:
        _NOTES.reset(token)
