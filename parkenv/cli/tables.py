"""Tables of results on a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterable

from rich import box
from rich.console import Console
from rich.table import Table

WIDE = 200
"""Width assumed if output goes to a file or a pipe, characters."""


def make_console() -> Console:
    """Make a console on standard output, as wide as the terminal."""
    return Console(highlight=False) if sys.stdout.isatty() else Console(highlight=False, width=WIDE)


def make_table(title: str | None, headings: Iterable[str]) -> Table:
    """Make a table of numbers; the first column names the rows."""
    table = Table(
        title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0)
    )
    for i, heading in enumerate(headings):
        table.add_column(heading, justify="right" if i else "left", no_wrap=True)
    return table
