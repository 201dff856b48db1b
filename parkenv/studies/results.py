"""Finished rows of a run: in one SQLite file in its folder, so that they survive a crash.

`settings.json` holds the settings. Every finished row goes into `results.sqlite`. The tables, such as `episodes.csv` or
`days.csv`, are written from there at the end of a run and when it is interrupted; `summary.json` is written at the end.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from parkenv.errors import InputError
from parkenv.files.atomic_write import make_folder, write_text
from parkenv.files.csv_tables import csv_columns, csv_text, write_csv
from parkenv.files.limited_reading import parse_json, read_json
from parkenv.files.row_file import RowFile, to_json
from parkenv.show.columns import SETTING_AXES
from parkenv.studies.workers import SERIAL
from parkenv.world.cost_terms import COST_FIELDS

if TYPE_CHECKING:
    from parkenv.engine.search_record import SearchRecord
    from parkenv.studies.study import Cell, Study

Row = dict[str, Any]
Key = tuple[Any, ...]

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
SPEC_FILE = "experiment.json"
"""File in a run folder with the specification of its study."""
SETTINGS = "settings.json"
SUMMARY = "summary.json"
SUMMARY_PARTIAL = "summary.partial.json"
PAGE = "report.html"
STORE = "results.sqlite"


@dataclass(frozen=True, eq=False)
class Table:
    """A table of a run, stored under the name of the file that is written from it at the end.

    Args:
        file: name of the file: a CSV table; or `.jsonl` for whole rows, a JSON object in each line.
        keys: columns that identify a row.
        columns: the other columns of the file.
        long: whether a row has many lines of the file: each of `columns` is a list with a value for each of them.
        lists: name of a second file, and its columns, which hold a list for each row as a text, such as the wall times
            of decisions; None for none.
    """

    file: str
    keys: Sequence[str]
    columns: Sequence[str] = ()
    long: bool = False
    lists: tuple[str, Sequence[str]] | None = None

    def key(self, row: Mapping[str, Any]) -> Key:
        """Return the key of a row."""
        return tuple(row[c] for c in self.keys)

    @property
    def files(self) -> list[str]:
        """Names of its files."""
        return [self.file, *(self.lists or ())[:1]]

    def read(self, folder: Path) -> list[Row]:
        """Read the rows of the run in a folder; none if it holds none."""
        return list(_stored(folder, [self])[self.file].values())

    def write(self, folder: Path, rows: Sequence[Row]) -> None:
        """Write its files."""
        names = (*self.keys, *self.columns)
        if self.file.endswith(".jsonl"):
            write_text(folder / self.file, "".join(to_json(row) + "\n" for row in rows))
        elif self.long:
            texts = [csv_text(names, [], header=True)]
            for row in rows:
                n = len(row[self.columns[0]])
                texts.append(
                    csv_columns([*([row[c]] * n for c in self.keys), *(row[c] for c in self.columns)])
                )
            write_text(folder / self.file, "".join(texts))
        else:
            write_csv(folder / self.file, names, [{c: row.get(c) for c in names} for row in rows])
        if self.lists is not None:
            file, columns = self.lists
            names = (*self.keys, *columns)
            lists = [{c: row.get(c) for c in names} for row in rows if row.get(columns[0])]
            write_csv(folder / file, names, lists)


EPISODES = Table("episodes.csv", KEY_COLUMNS, OUTCOME_COLUMNS, lists=("timings.csv", (DECISIONS,)))
"""Searches of comparisons."""


def _store(folder: Path, *, create: bool) -> RowFile:
    return RowFile(folder / STORE, "file of results", "a run", create=create, alone=True)


def _stored(folder: Path, tables: Sequence[Table]) -> dict[str, dict[Key, Row]]:
    """Return the rows of the run in a folder, by table and key; none if it holds none."""
    if not (folder / STORE).exists():
        return {table.file: {} for table in tables}
    try:
        with _store(folder, create=False) as store:
            return {table.file: {table.key(row): row for row in store.read(table.file)} for table in tables}
    except (KeyError, TypeError) as error:
        raise InputError(f"{folder / STORE}: a row has no key ({error!r})") from error


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
        old, new = before.get(name), now.get(name)
        both[name] = {**old, **new} if isinstance(old, dict) and isinstance(new, dict) else new
        for part, was, wanted in _parts(name, old, new):
            if was != wanted:
                raise InputError(
                    f"--resume: {part:.300} was {was!r:.200} in {folder}, now it is {wanted!r:.200}; "
                    "use the same settings, or another folder"
                )
    return both


def _parts(name: str, old: Any, new: Any) -> list[tuple[str, Any, Any]]:
    """Pair an old and a new setting: mappings by the names that both have, nested mappings by all names."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return [(name, old, new)]
    parts: list[tuple[str, Any, Any]] = []
    for key in sorted(old.keys() & new.keys()):
        was, now = old[key], new[key]
        if isinstance(was, dict) and isinstance(now, dict):
            parts += [
                (f"{key}.{part}", was.get(part), now.get(part)) for part in sorted(was.keys() | now.keys())
            ]
        else:
            parts.append((f"{name}: {key}", was, now))
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
        self._store: RowFile | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Close the store; the rows stay in memory."""
        if self._store is not None:
            self._store.close()
            self._store = None

    def read(self) -> None:
        """Read the rows that the folder holds."""
        self._rows = _stored(self.path, self._tables)

    def claim(
        self,
        settings: Mapping[str, Any],
        kind: str = "compare",
        *,
        resume: bool = False,
        overwrite: bool = False,
    ) -> Row:
        """Check that a run may use the folder, and read what it goes on with; return the settings for `begin`.

        Args:
            settings: settings of the run; everything that affects a row.
            kind: kind of run, for messages.
            resume: continue an earlier run with the same settings.
            overwrite: replace the results of another run.
        """
        make_folder(self.path)
        if resume:
            settings = require_same_settings(self.path, settings, kind)
            self.read()
        elif (self.path / SETTINGS).exists() and not overwrite:
            state = "a finished" if (self.path / SUMMARY).exists() else "an unfinished"
            raise InputError(
                f"--out {self.path}: holds {state} {kind} run; add --resume to go on with it, --overwrite to "
                "replace it, or name another folder"
            )
        return dict(settings)

    def recorded_command(self) -> tuple[str, ...]:
        """Return the command of the run that the folder holds; empty if it is lost."""
        for file in (self.path / SUMMARY, self.path / SUMMARY_PARTIAL):
            if file.exists() and isinstance(summary := read_json(file), dict):
                return tuple(map(str, summary.get("command", ())))
        return ()

    def begin(self, settings: Mapping[str, Any], *, continues: bool) -> None:
        """Write the settings of the run, and open the store, an empty one unless the run goes on with another."""
        old = [SUMMARY, *(file for table in self._tables for file in table.files)]
        for name in (
            old if continues else [*old, *(f"{STORE}{ending}" for ending in ("", "-wal", "-journal"))]
        ):
            (self.path / name).unlink(missing_ok=True)
        write_summary(self.path, {"command": self.command, "complete": False}, SUMMARY_PARTIAL)
        write_text(self.path / SETTINGS, json.dumps(dict(settings), indent=2) + "\n")
        self._store = _store(self.path, create=True)

    def rows(self, table: Table = EPISODES) -> Mapping[Key, Row]:
        """Return the finished rows of a table, by key."""
        return self._rows[table.file]

    def of(self, study: Study, cell: Cell) -> list[Row]:
        """Return the finished rows of a cell, in the order of its items."""
        rows = self.rows(study.table)
        return [rows[key] for item in cell.items for key in study.keys(cell.work, item) if key in rows]

    def replace(self, rows: Iterable[Row], table: Table) -> None:
        """Store these rows of a table instead of those that it has."""
        self._rows[table.file] = {table.key(row): row for row in rows}
        if self._store is not None:
            new = ((table.file, key, row) for key, row in self._rows[table.file].items())
            self._store.write(new, replaces=[table.file])

    def add(self, rows: Sequence[Row], table: Table = EPISODES) -> None:
        """Store finished rows, with those of other tables that they hold under the names of these, all or none."""
        new: list[tuple[str, Key, Row]] = []
        for other in self._tables:
            inner = [row.pop(other.file) for row in rows if other.file in row]
            new += [(other.file, other.key(row), row) for row in inner]
        new += [(table.file, table.key(row), row) for row in rows]
        # Memory first: after an interruption, `put_in_order` may replace the stored rows by it.
        for name, key, row in new:
            self._rows[name][key] = row
        if self._store is not None:
            self._store.write(new)

    def put_in_order(self, order: Mapping[tuple[str, ...], Iterable[Key]]) -> None:
        """Sort the tables with some key columns by keys, not by when rows finished: equal for any number of jobs.

        Further rows of a resumed run come last.
        """
        for table in self._tables:
            rows = self._rows[table.file]
            keys = [key for key in order.get(tuple(table.keys), ()) if key in rows]
            if (wanted := list(dict.fromkeys([*keys, *rows]))) != list(rows):
                self.replace([rows[key] for key in wanted], table)

    def export(self) -> None:
        """Write the files of all tables."""
        for table in self._tables:
            table.write(self.path, list(self._rows[table.file].values()))

    def finish(self, summary: Mapping[str, Any], *, complete: bool = True) -> None:
        """Write the summary; that of an incomplete run is called `summary.partial.json`."""
        (self.path / SUMMARY_PARTIAL).unlink(missing_ok=True)
        write_summary(self.path, summary, SUMMARY if complete else SUMMARY_PARTIAL)


def decision_s(row: Mapping[str, Any]) -> list[float]:
    """Return the wall times of an episode's decisions, s."""
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
