"""Tables of results on a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterable

from rich import box
from rich.console import Console
from rich.table import Table

WIDE = 200
"""Width assumed if output goes to a file or a pipe, characters."""


def make_console(*, soft_wrap: bool = False) -> Console:
    """Make a console on standard output, as wide as the terminal; it prints names as they are, without markup."""
    width = None if soft_wrap or sys.stdout.isatty() else WIDE
    return Console(highlight=False, markup=False, emoji=False, soft_wrap=soft_wrap, width=width)


def make_table(title: str | None, headings: Iterable[str]) -> Table:
    """Make a table of numbers; the first column names the rows."""
    table = Table(
        title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0)
    )
    for i, heading in enumerate(headings):
        table.add_column(heading, justify="right" if i else "left", no_wrap=True)
    return table
