"""Tables of results on a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
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


class StageProgress(Progress):
    """Progress bars of the stages of a command; a line per stage if the output is not a terminal that can redraw.

    Args:
        console: where to print.
    """

    def __init__(self, console: Console) -> None:
        columns = TextColumn("{task.description}"), BarColumn(24), MofNCompleteColumn(), TimeElapsedColumn()
        super().__init__(
            *columns, console=console, disable=not console.is_terminal or console.is_dumb_terminal
        )

    def add_task(self, description: str, *args: Any, **options: Any) -> TaskID:
        """Start a stage."""
        if self.disable:
            self.console.print(f"{description} ...")
        return super().add_task(description, *args, **options)
