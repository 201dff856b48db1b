"""What commands print and leave: consoles, tables, progress bars, summaries."""

from __future__ import annotations

import sys
import textwrap
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread
from typing import TYPE_CHECKING, Any

from parkenv.files.file_names import is_plain
from parkenv.show.tables import part_of, table_of, written
from parkenv.studies.results import write_summary
from parkenv.version import __version__

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID
    from rich.table import Table

    from parkenv.show.tables import Column

WIDE = 1000  # width assumed if output goes to a file or a pipe, characters: no column of a table is cut there

MOST_ROWS = 60  # rows of a table that are printed


def make_console(*, soft_wrap: bool = False) -> Console:
    """Make a console on standard output, as wide as the terminal.

    It prints names as they are, without markup, and escapes characters that a terminal would obey.
    """
    from rich.console import Console
    from rich.text import Text

    class NamesConsole(Console):
        def render_str(self, text: str, **options: Any) -> Text:
            return super().render_str(_escaped(text), **options)

    width = None if soft_wrap or sys.stdout.isatty() else WIDE
    return NamesConsole(highlight=False, markup=False, emoji=False, soft_wrap=soft_wrap, width=width)


def _escaped(text: str) -> str:
    return "".join(c if c == "\n" or is_plain(c) else ascii(c)[1:-1] for c in text)


def make_table(
    title: str | None, headings: Iterable[str], rows: Iterable[Sequence[str]] = (), texts: int = 1
) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(
        title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0)
    )
    for i, heading in enumerate(headings):
        table.add_column(heading, justify="right" if i >= texts else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table


def print_rows(
    console: Console,
    title: str,
    rows: Sequence[Mapping[str, Any]],
    keys: Collection[str] = (),
    columns: Sequence[Column] = (),
) -> None:
    table = table_of("", title, rows, columns)
    print_table(console, part_of(table, keys) if keys else table)


def print_table(console: Console, table: Mapping[str, Any]) -> None:
    """Print a table of `parkenv.show.tables.table_of`, or the first `MOST_ROWS` of its rows.

    What is equal in all rows, and not 0, stands above the table. A narrow terminal gets several tables, each of which
    begins with the columns that name the rows.
    """
    rows = table["rows"][:MOST_ROWS]
    equal = [
        f"{column['label']} {written(column, column['value'])} {column.get('unit', '')}".rstrip()
        for column in table["same"]
        if column["value"]
    ]
    title = f"{table['title']}: {', '.join(equal)}" if equal else table["title"]
    headings, cells, n_names = list[str](), list[list[str]](), 0
    for column, *values in zip(table["columns"], *rows, strict=True):
        if not any(texts := [written(column, value) for value in values]):
            continue
        has_numbers = any(isinstance(value, float | int | list) for value in values)
        if not has_numbers and n_names == len(cells):
            n_names += 1  # the columns before the first with numbers name the rows
        interval = "[95 %]" if any(isinstance(value, list) for value in values) else ""
        words = " ".join(filter(None, (column["label"], column.get("unit"), interval)))
        room = 60 if table["facts"] else max(10, *map(len, texts))
        headings.append("\n".join(textwrap.wrap(words, room, break_long_words=False)))
        cells.append(texts)
    if table["facts"]:
        facts = zip(headings, (texts[0] for texts in cells), strict=True)
        console.print(make_table(title, ("figure", "value"), facts))
        return
    widths = [
        2 + max(map(len, (*heading.split("\n"), *texts)))
        for heading, texts in zip(headings, cells, strict=True)
    ]
    parts = [list(range(n_names))]
    for i in range(n_names, len(widths)):
        if sum(widths[k] for k in parts[-1]) + widths[i] > console.width and len(parts[-1]) > n_names:
            parts.append(list(range(n_names)))
        parts[-1].append(i)
    for number, part in enumerate(parts):
        lines = zip(*(cells[i] for i in part), strict=True)
        console.print(make_table(None if number else title, [headings[i] for i in part], lines, n_names))
    if len(rows) < len(table["rows"]):
        console.print(f"The first {len(rows)} of {len(table['rows'])} rows; files have all.")


@contextmanager
def stages(console: Console, unit: str = "") -> Iterator[Callable[[str, int, int], None]]:
    """Show a bar for each stage of a run during the block, or a line where nothing can be redrawn.

    While functions are compiled, another line says which. Yields a `parkenv.studies.study.Progress`.
    """
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    bars: dict[str, TaskID] = {}
    with Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(20),
        MofNCompleteColumn(),
        TextColumn("{task.fields[unit]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal or console.is_dumb_terminal,
    ) as progress:

        def advance(doing: str, done: int, total: int) -> None:
            if doing not in bars:
                bars[doing] = progress.add_task(doing, unit=unit)
                if progress.disable:
                    console.print(doing if done == total > 0 else f"{doing} ...")
            progress.update(bars[doing], completed=done, total=total or None)

        ended = Event()
        if not progress.disable:
            Thread(target=_show_compiling, args=(progress, ended), daemon=True).start()
        try:
            yield advance
        finally:
            ended.set()


def _show_compiling(progress: Progress, ended: Event) -> None:
    """Show a line, until the event, while processes compile functions."""
    from parkenv.compiled.code_files import compiling_now

    since_s, line = time.time(), progress.add_task("", total=None, visible=False, unit="functions")
    while not ended.wait(0.5):
        names, n_finished = compiling_now(since_s)
        text = f"Compiling {', '.join(names[:3])}"
        progress.update(line, visible=bool(names), description=text, completed=n_finished)


def command_line() -> list[str]:
    return ["parkenv", *sys.argv[1:]]


def save_summary(folder: Path, seed: int | None, rows: Any, **more: Any) -> None:
    head = {"command": command_line(), "version": __version__, "seed": seed}
    write_summary(folder, head | more | {"rows": rows})
