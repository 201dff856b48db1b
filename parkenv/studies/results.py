"""Result folder of a run: finished episodes survive a crash.

`settings.json` holds the settings. Every finished search appends a line to `episodes.csv`, and one with the wall time
of its decisions to `timings.csv`; a day with many cars, a line to `days.csv`. `summary.json` is written at the end.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from parkenv.errors import InputError
from parkenv.files.atomic_write import append_text, atomic_write
from parkenv.files.csv_writing import csv_text, write_csv
from parkenv.files.limited_reading import parse_json, read_json
from parkenv.files.typed_csv import (
    NUMBER,
    NUMBER_OR_NOTHING,
    TEXT,
    WHOLE,
    YES_OR_NO,
    Kind,
    typed_records,
    wholes,
)
from parkenv.show.columns import SETTING_AXES

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
    "drive_s",
    "failed_s",
    "walk_s",
    "parking_cost_s",
    "gave_up_s",
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
    **dict.fromkeys(("failed_parks", "slots_passed", "replans", "steps"), WHOLE),
    **dict.fromkeys(("parked", "truncated"), YES_OR_NO),
    **dict.fromkeys(("occupancy_level", "forecast_error"), NUMBER_OR_NOTHING),
    DECISIONS: wholes(),
}
"""What a column of an episode holds; all others hold numbers."""

SETTINGS = "settings.json"
SUMMARY = "summary.json"
SUMMARY_PARTIAL = "summary.partial.json"


@dataclass(frozen=True)
class EpisodeTable:
    """The table that a run appends a line to for every finished episode.

    Args:
        file: its name.
        keys: columns that identify an episode.
        columns: the other columns of an episode.
        kinds: what a column holds; all others hold numbers.
        timings: name of the table with the wall times of decisions; None for a run that measures none.
    """

    file: str = "episodes.csv"
    keys: Sequence[str] = KEY_COLUMNS
    columns: Sequence[str] = OUTCOME_COLUMNS
    kinds: Mapping[str, Kind] = field(default_factory=lambda: KINDS)
    timings: str | None = "timings.csv"

    def key(self, row: Mapping[str, Any]) -> Key:
        """Return the key of an episode."""
        return tuple(row[c] for c in self.keys)

    def read(self, path: Path) -> list[Row]:
        """Read the complete lines of a file; none if there is no file.

        Raises:
            InputError: the file is damaged, or not of this version.
        """
        return self._read(path, (*self.keys, *self.columns))

    def read_timings(self, path: Path) -> list[Row]:
        """Read the complete lines of a file of wall times; see `read`."""
        return self._read(path, (*self.keys, DECISIONS))

    def _read(self, path: Path, columns: Sequence[str]) -> list[Row]:
        def kind_of(column: str) -> Kind:
            return self.kinds.get(column, NUMBER)

        return [row for _, row in typed_records(path, kind_of, columns, whole_lines=True)]


def write_summary(folder: Path, summary: Mapping[str, Any], name: str = SUMMARY) -> None:
    """Write a command's summary as strict JSON; NaN becomes null."""
    _write_text(folder / name, json.dumps(without_nan(summary), indent=2, allow_nan=False) + "\n")


def read_settings(folder: Path) -> Row | None:
    """Read the settings of the run in a folder; return None if there is no run.

    Raises:
        InputError: the file is damaged.
    """
    file = folder / SETTINGS
    if not file.exists():
        return None
    settings = read_json(file)
    if not isinstance(settings, dict):
        raise InputError(f"{file}: want the settings of a command, by name, got a {type(settings).__name__}")
    return settings


def write_settings(folder: Path, settings: Mapping[str, Any]) -> None:
    """Write the settings of a run."""
    _write_text(folder / SETTINGS, json.dumps(dict(settings), indent=2) + "\n")


def require_same_settings(folder: Path, settings: Mapping[str, Any], kind: str) -> Row:
    """Check that a run to resume has the same settings.

    Mappings, such as the files of agents, need to agree only in the names that both have.

    Args:
        folder: folder of the run.
        settings: the current settings.
        kind: kind of run.

    Returns:
        The merged settings; new values take precedence.

    Raises:
        InputError: there is no run, or its settings differ.
    """
    before = read_settings(folder)
    if before is None:
        raise InputError(f"--resume: {folder} holds no {kind} to go on with")
    now = parse_json(json.dumps(dict(settings)), "settings")
    both = {}
    for name in sorted(before.keys() | now.keys()):
        was, its = before.get(name), now.get(name)
        both[name] = {**was, **its} if isinstance(was, dict) and isinstance(its, dict) else its
        for part, old, new in _parts(name, was, its):
            if old != new:
                raise InputError(
                    f"--resume: {part:.80} was {old!r:.200} in {folder}, now it is {new!r:.200}; "
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


def make_folder(path: Path) -> None:
    """Make a folder for results, and check that it is writable before any work is done.

    Raises:
        InputError: the folder cannot be made or written.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / f".probe.{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"--out {path}: cannot be written ({error.strerror})") from error


def episode_key(row: Mapping[str, Any]) -> Key:
    """Return the key of an episode: its setting, agent and seed."""
    return tuple(row[c] for c in KEY_COLUMNS)


class ResultFolder:
    """Collects episodes as they finish.

    Args:
        path: the folder; created if missing.
        settings: settings of the run; everything that affects the outcome of an episode.
        table: the table of episodes.
        kind: kind of run, for messages.
        resume: continue an earlier run with the same settings.
        overwrite: replace the results of another run.

    Attributes:
        episodes: finished episodes by key.

    Raises:
        InputError: the folder is not writable, it holds another run and neither `resume` nor `overwrite` is set, or
            `resume` is set and the settings differ.
    """

    def __init__(
        self,
        path: Path,
        settings: Mapping[str, Any],
        *,
        table: EpisodeTable | None = None,
        kind: str = "comparison",
        resume: bool = False,
        overwrite: bool = False,
    ) -> None:
        make_folder(path)
        self.path = path
        self._table = table = table or EpisodeTable()
        self.episodes: dict[Key, Row] = {}
        self._timings: dict[Key, Row] = {}
        if resume:
            settings = require_same_settings(path, settings, kind)
            self.episodes = self._by_key(table.read(path / table.file))
            if table.timings is not None:
                self._timings = self._by_key(table.read_timings(path / table.timings))
        elif (path / table.file).exists() and not overwrite:
            state = "a finished" if (path / SUMMARY).exists() else "an unfinished"
            raise InputError(
                f"--out {path}: holds {state} {kind}; add --resume to go on with it, --overwrite to replace it, "
                "or name another folder"
            )
        (path / SUMMARY).unlink(missing_ok=True)
        write_settings(path, settings)
        # Rewrite the readable lines: this drops a line truncated by a crash, and its episode runs again.
        self._write(self.episodes.values(), self._timings.values())

    def add(self, rows: Sequence[Row], timings: Sequence[Row] = (), *, sync: bool = True) -> None:
        """Append finished episodes, and flush them to disk; see `append_text`."""
        # Memory first: after an interruption, `finish` rewrites the files from it.
        self._timings |= self._by_key(timings)
        self.episodes |= self._by_key(rows)
        # Timings before episodes: a finished episode would not run again for its timing.
        for file, columns, new in self._files(rows, timings):
            append_text(file, csv_text(columns, new), sync=sync)

    def decision_s(self, key: Key) -> list[float]:
        """Return the wall times of an episode's decisions, s; empty if a crash lost them."""
        row = self._timings.get(key)
        return [int(us) * 1e-6 for us in row[DECISIONS].split()] if row else []

    def finish(self, order: Iterable[Key], summary: Mapping[str, Any], *, complete: bool = True) -> None:
        """Put the episodes in order and write the summary.

        Episodes are sorted by `order`, not by when they finished, so the file is the same for any number of jobs.
        Further episodes of a resumed run come last. The summary of an incomplete run is called `summary.partial.json`.
        """
        wanted = dict.fromkeys(key for key in order if key in self.episodes)
        wanted |= dict.fromkeys(self.episodes)
        rows = [self.episodes[key] for key in wanted]
        timings = [self._timings[key] for key in wanted if key in self._timings]
        self._write(rows, timings)
        (self.path / SUMMARY_PARTIAL).unlink(missing_ok=True)
        write_summary(self.path, summary, SUMMARY if complete else SUMMARY_PARTIAL)

    def _by_key(self, rows: Iterable[Row]) -> dict[Key, Row]:
        return {self._table.key(row): row for row in rows}

    def _files(
        self, rows: Iterable[Row], timings: Iterable[Row]
    ) -> Iterator[tuple[Path, Sequence[str], Iterable[Row]]]:
        """Yield each file with its columns and rows, timings first."""
        table = self._table
        if table.timings is not None:
            yield self.path / table.timings, (*table.keys, DECISIONS), timings
        yield self.path / table.file, (*table.keys, *table.columns), rows

    def _write(self, episodes: Iterable[Row], timings: Iterable[Row]) -> None:
        for file, columns, rows in self._files(episodes, timings):
            write_csv(file, columns, rows)


def _write_text(path: Path, text: str) -> None:
    with atomic_write(path) as beside:
        beside.write_text(text, encoding="utf-8")


def read_rows(path: Path) -> list[Row]:
    """Read the complete lines of the `episodes.csv` of a comparison; see `EpisodeTable.read`."""
    return EpisodeTable().read(path)


def without_nan(value: Any) -> Any:
    """Replace NaN, such as a missing interval, by None: JSON has no NaN."""
    if isinstance(value, Mapping):
        return {k: without_nan(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(v) for v in value]
    if isinstance(value, float) and value != value:
        return None
    return value
