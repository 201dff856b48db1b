"""Results of a run: finished rows survive a crash.

`settings.json` holds the settings. Every finished row is appended to the table of the study, such as a search to
`episodes.csv` or a day with many cars to `days.csv`. `summary.json` is written at the end.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from parkenv.errors import InputError
from parkenv.files.atomic_write import append_text, make_folder, write_text
from parkenv.files.csv_tables import (
    NUMBER,
    NUMBER_OR_NOTHING,
    TEXT,
    WHOLE,
    YES_OR_NO,
    Kind,
    csv_columns,
    csv_text,
    or_nothing,
    typed_records,
    wholes,
)
from parkenv.files.limited_reading import parse_json, read_json, read_text
from parkenv.show.columns import SETTING_AXES
from parkenv.studies.workers import SERIAL
from parkenv.world.cost_terms import COST_FIELDS

if TYPE_CHECKING:
    from parkenv.show.search_record import SearchRecord
    from parkenv.studies.study import Cell, Study

Row = dict[str, Any]
Key = tuple[Any, ...]

MOST_BYTES = 1_000_000_000
"""Largest table of a run: a day of a town has thousands of rows, and what was written must be read again."""
SETTING_COLUMNS = ("scenario", "occupancy_level", "agent", *SETTING_AXES)
KEY_COLUMNS = (*SETTING_COLUMNS, "seed")
"""Columns that identify an episode of a comparison."""
OUTCOME_COLUMNS = (
    "day",
    "arrival_s",
    "occupancy",
    "slot",
    "parked",
    "truncated",
    "total_s",
    *COST_FIELDS,
    "bound_s",
    "driven_m",
    "walked_m",
    "failed_parks",
    "slots_passed",
    "replans",
    "steps",
)
"""Columns of an episode's outcome."""
DECISIONS = "decisions_us"
"""Column of the wall times of an episode's decisions, µs."""
KINDS: Mapping[str, Kind] = {
    **dict.fromkeys(("scenario", "map", "agent", "day", "slot"), TEXT),
    **dict.fromkeys(("seed", "course", "day_number", "driver"), WHOLE),
    # `bound` drives no car.
    **dict.fromkeys(("failed_parks", "slots_passed", "replans", "steps"), or_nothing(WHOLE)),
    **dict.fromkeys(
        (*COST_FIELDS, "driven_m", "walked_m", "occupancy_level", "forecast_error"), NUMBER_OR_NOTHING
    ),
    "parked": or_nothing(YES_OR_NO),
    "truncated": YES_OR_NO,
    DECISIONS: wholes(),
}
"""What a column of an episode holds; all others hold numbers."""

GoesOn = Literal["asked", "unfinished", "always"]
"""When a run continues the one in its folder; see `Study`."""
SPEC_FILE = "experiment.json"
"""File in a run folder with the specification of its study."""
SETTINGS = "settings.json"
SUMMARY = "summary.json"
SUMMARY_PARTIAL = "summary.partial.json"
PAGE = "report.html"


class Table(ABC):
    """The table that a run appends a row to for everything that is finished.

    Args:
        file: name of its file.
        keys: columns that identify a row.
    """

    file: str
    keys: Sequence[str]

    def key(self, row: Mapping[str, Any]) -> Key:
        """Return the key of a row."""
        return tuple(row[c] for c in self.keys)

    @abstractmethod
    def read(self, folder: Path) -> list[Row]:
        """Read the complete lines of the file in a folder; none if there is no file."""

    @abstractmethod
    def texts(self, rows: Sequence[Row], *, header: bool = False) -> Iterator[tuple[str, str]]:
        """Yield the name of each file with its text of some rows, below a header if wanted and if it has one."""

    def append(self, folder: Path, rows: Sequence[Row], *, sync: bool = True) -> None:
        """Append rows to the file in a folder, and flush them to disk; see `append_text`."""
        for file, text in self.texts(rows):
            append_text(folder / file, text, sync=sync)

    def write(self, folder: Path, rows: Sequence[Row]) -> None:
        """Replace the rows of the file in a folder, atomically."""
        for file, text in self.texts(rows, header=True):
            write_text(folder / file, text)


@dataclass(frozen=True, eq=False)
class CsvTable(Table):
    """A table of numbers and texts.

    Args:
        file, keys: see `Table`.
        columns: the other columns.
        kinds: what a column holds.
        other: what all other columns hold.
        lists: name of a second file, and its columns, which hold a list for each row as a text, such as the wall times
            of decisions; None for none.
    """

    file: str = "episodes.csv"
    keys: Sequence[str] = KEY_COLUMNS
    columns: Sequence[str] = OUTCOME_COLUMNS
    kinds: Mapping[str, Kind] = field(default_factory=lambda: KINDS)
    other: Kind = NUMBER
    lists: tuple[str, Sequence[str]] | None = ("timings.csv", (DECISIONS,))

    def read(self, folder: Path) -> list[Row]:
        """See `Table`; a row without lists, as a crash lost them, has empty ones."""
        rows = self._read(folder / self.file, (*self.keys, *self.columns))
        if self.lists is not None:
            file, columns = self.lists
            found = {self.key(row): row for row in self._read(folder / file, (*self.keys, *columns))}
            for row in rows:
                row |= dict.fromkeys(columns, "") | found.get(self.key(row), {})
        return rows

    def _read(self, path: Path, columns: Sequence[str]) -> list[Row]:
        def kind_of(column: str) -> Kind:
            return self.kinds.get(column, self.other)

        return [row for _, row in typed_records(path, kind_of, columns, most=MOST_BYTES, whole_lines=True)]

    def texts(self, rows: Sequence[Row], *, header: bool = False) -> Iterator[tuple[str, str]]:
        """See `Table`; lists come first: a finished row would not run again for them."""
        if self.lists is not None:
            file, columns = self.lists
            yield file, self._text((*self.keys, *columns), [r for r in rows if r.get(columns[0])], header)
        yield self.file, self._text((*self.keys, *self.columns), rows, header)

    def _text(self, columns: Sequence[str], rows: Sequence[Row], header: bool) -> str:
        return csv_text(columns, [{c: row.get(c) for c in columns} for row in rows], header=header)


@dataclass(frozen=True, eq=False)
class LongTable(Table):
    """A table whose rows have many lines each: a column of a row is a list with a value for each of its lines.

    Args:
        file, keys: see `Table`.
        line_keys: columns that tell the lines of a row apart.
        columns: the other columns.
        kinds: what a column holds.
        other: what all other columns hold.
    """

    file: str
    keys: Sequence[str]
    line_keys: Sequence[str]
    columns: Sequence[str]
    kinds: Mapping[str, Kind]
    other: Kind = NUMBER

    def read(self, folder: Path) -> list[Row]:
        """See `Table`; of lines that are there twice, as after a crash, the last one counts."""
        in_line = (*self.line_keys, *self.columns)
        found: dict[Key, dict[Key, Key]] = {}
        records = typed_records(
            folder / self.file,
            lambda column: self.kinds.get(column, self.other),
            (*self.keys, *in_line),
            most=MOST_BYTES,
            whole_lines=True,
        )
        for _, record in records:
            lines = found.setdefault(self.key(record), {})
            lines[tuple(record[c] for c in self.line_keys)] = tuple(record[c] for c in in_line)
        return [
            dict(zip(self.keys, key, strict=True))
            | {c: list(values) for c, values in zip(in_line, zip(*lines.values(), strict=True), strict=True)}
            for key, lines in found.items()
        ]

    def texts(self, rows: Sequence[Row], *, header: bool = False) -> Iterator[tuple[str, str]]:
        in_line = (*self.line_keys, *self.columns)
        texts = [csv_text((*self.keys, *in_line), [], header=header)]
        for row in rows:
            n = len(row[in_line[0]])
            texts.append(csv_columns([*([row[c]] * n for c in self.keys), *(row[c] for c in in_line)]))
        yield self.file, "".join(texts)


@dataclass(frozen=True, eq=False)
class JsonTable(Table):
    """A table whose rows hold lists: a JSON object in each line.

    Args:
        file, keys: see `Table`.
        checked: returns a row of the file in the types of `Study.run`; raises ValueError, TypeError or KeyError if it
            is none.
        what: what a row is, for messages.
    """

    file: str
    keys: Sequence[str]
    checked: Callable[[Row], Row]
    what: str

    def read(self, folder: Path) -> list[Row]:
        path = folder / self.file
        if not path.exists():
            return []
        # A crash may leave a last line without its end.
        whole = read_text(path, MOST_BYTES).rpartition("\n")[0]
        rows = []
        for number, line in enumerate(whole.splitlines(), start=1):
            row = parse_json(line, f"{path}: line {number}")
            try:
                rows.append(self.checked(row))
                self.key(rows[-1])
            except (AttributeError, KeyError, TypeError, ValueError) as error:
                raise InputError(f"{path}: line {number}: {line!r:.40} is not a valid {self.what}") from error
        return rows

    def texts(self, rows: Sequence[Row], *, header: bool = False) -> Iterator[tuple[str, str]]:
        del header
        yield self.file, "".join(json.dumps(row) + "\n" for row in rows)


EPISODES = CsvTable()
"""Searches of comparisons."""


def write_summary(folder: Path, summary: Mapping[str, Any], name: str = SUMMARY) -> None:
    """Write a command's summary as strict JSON; NaN becomes null."""
    write_text(folder / name, json.dumps(without_nan(summary), indent=2, allow_nan=False) + "\n")


def read_settings(folder: Path) -> Row | None:
    """Read the settings of the run in a folder; return None if there is no run."""
    file = folder / SETTINGS
    if not file.exists():
        return None
    settings = read_json(file)
    if not isinstance(settings, dict):
        raise InputError(f"{file}: want the settings of a command, by name, got a {type(settings).__name__}")
    return settings


def require_same_settings(folder: Path, settings: Mapping[str, Any], kind: str) -> Row:
    """Check that a run to resume has the same settings.

    Mappings, such as the files of agents, need to agree only in the names that both have.

    Args:
        folder: folder of the run.
        settings: the current settings.
        kind: kind of run.

    Returns:
        The merged settings; new values take precedence.
    """
    before = read_settings(folder)
    if before is None:
        raise InputError(f"--resume: {folder} holds no {kind} run to resume")
    now = parse_json(json.dumps(dict(settings)), "settings")
    both = {}
    for name in sorted(before.keys() | now.keys()):
        was, its = before.get(name), now.get(name)
        both[name] = {**was, **its} if isinstance(was, dict) and isinstance(its, dict) else its
        for part, old, new in _parts(name, was, its):
            if old != new:
                raise InputError(
                    f"--resume: {part:.300} was {old!r:.200} in {folder}, now it is {new!r:.200}; "
                    "use the same settings, or another folder"
                )
    return both


def _parts(name: str, was: Any, its: Any) -> list[tuple[str, Any, Any]]:
    """Pair an old and a new setting: mappings by the names that both have, nested mappings by all names."""
    if not (isinstance(was, dict) and isinstance(its, dict)):
        return [(name, was, its)]
    parts: list[tuple[str, Any, Any]] = []
    for key in sorted(was.keys() & its.keys()):
        old, new = was[key], its[key]
        if isinstance(old, dict) and isinstance(new, dict):
            parts += [
                (f"{key}.{part}", old.get(part), new.get(part)) for part in sorted(old.keys() | new.keys())
            ]
        else:
            parts.append((f"{name}: {key}", old, new))
    return parts


class Results:
    """Finished rows of a study, in memory and in its folder.

    Args:
        path: the folder.
        tables: its tables, the most important first.

    Attributes:
        kept: what this run has found besides, for figures.
        workers, progress, command: those of the run, for a study that needs more than its cells.
    """

    def __init__(self, path: Path, tables: Sequence[Table] = (EPISODES,)) -> None:
        self.path, self._tables = path, tables
        self.kept: dict[str, Any] = {}
        self.workers = SERIAL
        self.progress: Callable[[str, int, int], None] = lambda *_: None
        self.command: tuple[str, ...] = ()
        self._rows: dict[str, dict[Key, Row]] = {table.file: {} for table in tables}

    def read(self) -> None:
        """Read the rows that the folder holds."""
        for table in self._tables:
            self._rows[table.file] = {table.key(row): row for row in table.read(self.path)}

    def claim(
        self,
        settings: Mapping[str, Any],
        kind: str = "compare",
        *,
        resume: bool = False,
        overwrite: bool = False,
        goes_on: GoesOn = "asked",
    ) -> tuple[Row, bool]:
        """Check that a run may use the folder, and read what it goes on with.

        Args:
            settings: settings of the run; everything that affects a row.
            kind: kind of run, for messages.
            resume: continue an earlier run with the same settings.
            overwrite: replace the results of another run.
            goes_on: see `Study`.

        Returns:
            The settings for `begin`, and whether an earlier run is continued.
        """
        make_folder(self.path)
        found, finished = (self.path / SETTINGS).exists(), (self.path / SUMMARY).exists()
        if resume and goes_on != "always":
            continues = True
        elif goes_on == "asked":
            if (self.path / self._tables[0].file).exists() and not overwrite:
                state = "a finished" if finished else "an unfinished"
                raise InputError(
                    f"--out {self.path}: holds {state} {kind} run; add --resume to go on with it, --overwrite to "
                    "replace it, or name another folder"
                )
            continues = False
        else:
            continues = not overwrite and (goes_on == "always" or (found and not finished))
        if continues and goes_on != "always":
            settings = require_same_settings(self.path, settings, kind)
        if continues:
            self.read()
        return dict(settings), continues

    def recorded_command(self) -> tuple[str, ...]:
        """Return the command of the run that the folder holds; empty if it is lost."""
        for file in (self.path / SUMMARY, self.path / SUMMARY_PARTIAL):
            if file.exists() and isinstance(summary := read_json(file), dict):
                return tuple(map(str, summary.get("command", ())))
        return ()

    def begin(self, settings: Mapping[str, Any]) -> None:
        """Write the settings of the run, and the rows that it goes on with.

        A line that a crash has truncated is dropped, and runs again.
        """
        (self.path / SUMMARY).unlink(missing_ok=True)
        write_summary(self.path, {"command": self.command, "complete": False}, SUMMARY_PARTIAL)
        write_text(self.path / SETTINGS, json.dumps(dict(settings), indent=2) + "\n")
        for table in self._tables:
            table.write(self.path, list(self._rows[table.file].values()))

    def rows(self, table: Table = EPISODES) -> Mapping[Key, Row]:
        """Return the finished rows of a table, by key."""
        return self._rows[table.file]

    def of(self, study: Study, cell: Cell) -> list[Row]:
        """Return the finished rows of a cell, in the order of its items."""
        rows = self.rows(study.table)
        return [rows[key] for item in cell.items for key in study.keys(cell.work, item) if key in rows]

    def drop(self, keys: Iterable[Key], table: Table = EPISODES) -> None:
        """Forget rows, which run again."""
        for key in keys:
            del self._rows[table.file][key]

    def add(self, rows: Sequence[Row], table: Table = EPISODES, *, sync: bool = True) -> None:
        """Append finished rows, and flush them to disk; see `append_text`."""
        # Memory first: after an interruption, `put_in_order` rewrites the files from it.
        self._rows[table.file] |= {table.key(row): row for row in rows}
        table.append(self.path, rows, sync=sync)

    def put_in_order(self, order: Iterable[Key], table: Table = EPISODES) -> None:
        """Sort a table by `order`, not by when rows finished, so that the file is the same for any number of jobs.

        Further rows of a resumed run come last.
        """
        rows = self._rows[table.file]
        wanted = dict.fromkeys(key for key in order if key in rows) | dict.fromkeys(rows)
        table.write(self.path, [rows[key] for key in wanted])

    def finish(self, summary: Mapping[str, Any], *, complete: bool = True) -> None:
        """Write the summary; that of an incomplete run is called `summary.partial.json`."""
        (self.path / SUMMARY_PARTIAL).unlink(missing_ok=True)
        write_summary(self.path, summary, SUMMARY if complete else SUMMARY_PARTIAL)


def decision_s(row: Mapping[str, Any]) -> list[float]:
    """Return the wall times of an episode's decisions, s; empty if a crash lost them."""
    return [int(us) * 1e-6 for us in row[DECISIONS].split()]


def timed_row(record: SearchRecord) -> Row:
    """Return the row of a search with the wall times of its decisions."""
    return record.row | {DECISIONS: " ".join(str(round(1e6 * s)) for s in record.decision_s)}


def without_nan(value: Any) -> Any:
    """Replace NaN, such as a missing interval, by None: JSON has no NaN."""
    if isinstance(value, Mapping):
        return {k: without_nan(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(v) for v in value]
    if isinstance(value, float) and value != value:
        return None
    return value
