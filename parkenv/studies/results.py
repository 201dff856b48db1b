"""Finished rows of a run, in one SQLite file in its folder, so that they survive a crash; and what they depend on.

`settings.json` holds the settings. Every finished row goes into `results.sqlite`. The tables, such as `episodes.csv` or
`days.csv`, are written from there at the end of a run and when it is interrupted; `summary.json` is written at the end.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from parkenv.errors import InputError, require
from parkenv.files.atomic_write import make_folder, write_text
from parkenv.files.csv_tables import csv_columns, csv_text, write_csv
from parkenv.files.limited_reading import parse_json, read_json
from parkenv.files.row_file import RowFile, to_json
from parkenv.files.spec_file import Spec
from parkenv.show.tables import SETTING_AXES
from parkenv.studies.workers import SERIAL
from parkenv.version import __version__
from parkenv.world.cost_terms import COST_FIELDS

if TYPE_CHECKING:
    from parkenv.engine.search_record import SearchRecord

Row = dict[str, Any]
Key = tuple[Any, ...]

SETTING_COLUMNS = ("scenario", "occupancy_level", "agent", *SETTING_AXES)
KEY_COLUMNS = (*SETTING_COLUMNS, "seed")  # columns that identify an episode of a comparison
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
DECISIONS = "decisions_us"  # column of the wall times of an episode's decisions, µs
SPEC_FILE = "experiment.json"  # file in a run folder with the specification of its study
SETTINGS = "settings.json"
SUMMARY = "summary.json"
SUMMARY_PARTIAL = "summary.partial.json"
PAGE = "report.html"
STORE = "results.sqlite"


@dataclass(frozen=True, eq=False)
class Table:
    """A table of a run, stored under the name of the file that is written from it at the end.

    A second file may have `lists`: columns with a list for each row as a text, such as the wall times of decisions.
    """

    file: str  # name of the file: a CSV table; or `.jsonl` for whole rows, a JSON object in each line
    keys: Sequence[str]  # columns that identify a row
    columns: Sequence[str] = ()  # the other columns of the file
    long: bool = False  # whether a row has many lines of the file, and each of `columns` a list of them
    lists: tuple[str, Sequence[str]] | None = None  # name of the second file, and its columns

    def key(self, row: Mapping[str, Any]) -> Key:
        return tuple(row[c] for c in self.keys)

    @property
    def files(self) -> list[str]:
        return [self.file, *(self.lists or ())[:1]]

    def read(self, folder: Path) -> list[Row]:
        return list(_stored(folder, [self])[self.file].values())

    def write(self, folder: Path, rows: Sequence[Row]) -> None:
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


# Searches of comparisons.
EPISODES = Table("episodes.csv", KEY_COLUMNS, OUTCOME_COLUMNS, lists=("timings.csv", (DECISIONS,)))


def _store(folder: Path, *, create: bool) -> RowFile:
    return RowFile(folder / STORE, "file of results", "a run", create=create, alone=True)


def _stored(folder: Path, tables: Sequence[Table]) -> dict[str, dict[Key, Row]]:
    if not (folder / STORE).exists():
        return {table.file: {} for table in tables}
    try:
        with _store(folder, create=False) as store:
            return {table.file: {table.key(row): row for row in store.read(table.file)} for table in tables}
    except (KeyError, TypeError) as error:
        raise InputError(f"{folder / STORE}: a row has no key ({error!r})") from error


def write_summary(folder: Path, summary: Mapping[str, Any], name: str = SUMMARY) -> None:
    write_text(folder / name, json.dumps(without_nan(summary), indent=2, allow_nan=False) + "\n")


def read_settings(folder: Path) -> Row | None:
    file = folder / SETTINGS
    if not file.exists():
        return None
    settings: Row = read_json(file)
    require(
        isinstance(settings, dict),
        f"{file}: want the settings of a command, by name, got a {type(settings).__name__}",
    )
    return settings


def require_same_settings(folder: Path, settings: Mapping[str, Any], kind: str) -> Row:
    """Check that a run to resume has the same settings, and return the merged ones; new values take precedence.

    Mappings, such as the files of agents, need to agree only in the names that both have.
    """
    before = read_settings(folder)
    if before is None:
        raise InputError(f"--resume: {folder} holds no {kind} run to resume")
    now = parse_json(json.dumps(dict(settings)), "settings")
    merged: Row = {}
    for name in sorted(before.keys() | now.keys()):
        old, new = before.get(name), now.get(name)
        pairs = [(name, old, new)]
        merged[name] = new
        if isinstance(old, dict) and isinstance(new, dict):
            merged[name] = {**old, **new}
            pairs = [(f"{name}: {key}", old[key], new[key]) for key in sorted(old.keys() & new.keys())]
        for part, was, wanted in pairs:
            if was != wanted:
                _refuse(folder, part, was, wanted)
    return merged


def _refuse(folder: Path, part: str, was: Any, wanted: Any) -> None:
    """Raise an error that names the first difference of two settings, which may be tables."""
    if isinstance(was, dict) and isinstance(wanted, dict):
        key = next(key for key in sorted(was | wanted) if was.get(key) != wanted.get(key))
        part, was, wanted = f"{part}.{key}", was.get(key), wanted.get(key)
    raise InputError(
        f"--resume: {part:.300} was {was!r:.200} in {folder}, now it is {wanted!r:.200}; "
        "use the same settings, or another folder"
    )


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
        if self._store is not None:
            self._store.close()
            self._store = None

    def read(self) -> None:
        self._rows = _stored(self.path, self._tables)

    def claim(
        self,
        settings: Mapping[str, Any],
        kind: str = "compare",
        *,
        resume: bool = False,
        overwrite: bool = False,
    ) -> Row:
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

    def begin(self, settings: Mapping[str, Any], *, continues: bool) -> None:
        old = [SUMMARY, *(file for table in self._tables for file in table.files)]
        for name in (
            old if continues else [*old, *(f"{STORE}{ending}" for ending in ("", "-wal", "-journal"))]
        ):
            (self.path / name).unlink(missing_ok=True)
        write_summary(self.path, {"command": self.command, "complete": False}, SUMMARY_PARTIAL)
        write_text(self.path / SETTINGS, json.dumps(dict(settings), indent=2) + "\n")
        self._store = _store(self.path, create=True)

    def rows(self, table: Table = EPISODES) -> Mapping[Key, Row]:
        return self._rows[table.file]

    def replace(self, rows: Iterable[Row], table: Table) -> None:
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
        for table in self._tables:
            table.write(self.path, list(self._rows[table.file].values()))

    def finish(self, summary: Mapping[str, Any], *, complete: bool = True) -> None:
        (self.path / SUMMARY_PARTIAL).unlink(missing_ok=True)
        write_summary(self.path, summary, SUMMARY if complete else SUMMARY_PARTIAL)


def decision_s(row: Mapping[str, Any]) -> list[float]:
    return [int(us) * 1e-6 for us in row[DECISIONS].split()]


def timed_row(record: SearchRecord) -> Row:
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


def search_settings(spec: Any, *fields: str) -> Row:
    """Return the settings of a study whose agents search, with further fields that a resumed run must share."""
    scenarios = spec.scenarios if hasattr(spec, "scenarios") else (spec.scenario,)
    agents = (spec.agents or ()) if hasattr(spec, "agents") else (spec.agent,)
    detector = getattr(spec, "detector", None)
    versions = {}
    if detector is not None:
        from parkenv.perception.detector_registry import detector_version

        versions = {"detector": detector_version(detector)}
    return {
        "version": __version__,
        "scenarios": {s.title: flat_tables(s.model_dump(mode="json")) for s in scenarios},
        "files": fingerprints(spec.files()),
        "agent files": agent_fingerprints(agent.name for agent in agents),
        **{name: getattr(spec, name) for name in fields},
        **versions,
    }


def flat_tables(tables: Mapping[str, Any], before: str = "") -> Row:
    """Flatten nested tables into one with dotted keys, such as `costs.failure_s`."""
    flat: Row = {}
    for key, value in tables.items():
        flat |= (
            flat_tables(value, f"{before}{key}.") if isinstance(value, Mapping) else {f"{before}{key}": value}
        )
    return flat


def fingerprints(files: Iterable[Path]) -> dict[str, str]:
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest()[:16] for path in files}


def agent_fingerprints(names: Iterable[str]) -> dict[str, str]:
    from planners.agent import agent_file

    files = {name: agent_file(name) for name in dict.fromkeys(names)}
    return {name: fingerprints([file])[str(file)] for name, file in files.items() if file is not None}


def require_unchanged(spec: Spec, folder: Path) -> None:
    before = (read_settings(folder) or {}).get("files", {})
    for path, now in fingerprints(spec.files()).items():
        require(before.get(path) in (None, now), f"{path} has changed since the run")
