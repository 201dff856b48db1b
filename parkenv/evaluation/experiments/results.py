"""The folder of a comparison: what is finished stays finished, whatever happens to the process.

`settings.json` says what was asked for, `episodes.csv` gains a line for every finished search,
`timings.csv` one with the wall time of its decisions, and `summary.json` is written at the end.
"""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from parkenv.errors import InputError
from parkenv.files.atomic_write import atomic_write

SETTING_COLUMNS = ("scenario", "occupancy_level", "agent", "failure_cost_s", "v_walk_kmh", "v_drive_kmh")
EPISODE_COLUMNS = (
    *SETTING_COLUMNS,
    "seed",
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
TIMING_COLUMNS = (*SETTING_COLUMNS, "seed", "decisions_us")

_TEXT = {"scenario", "agent", "day", "slot", "decisions_us"}
_WHOLE = {"seed", "failed_parks", "slots_passed", "replans", "steps"}
_BOOL = {"parked", "truncated"}

SETTINGS = "settings.json"
SUMMARY = "summary.json"
SUMMARY_PARTIAL = "summary.partial.json"

Row = dict[str, Any]
Key = tuple[Any, ...]


def write_summary(folder: Path, summary: Mapping[str, Any], name: str = SUMMARY) -> None:
    """Write a command's summary as strict JSON; numbers that do not exist become null."""
    _write_text(folder / name, json.dumps(_plain(summary), indent=2, allow_nan=False) + "\n")


def read_settings(folder: Path) -> Row | None:
    """What a run in a folder was asked for; None where there was none.

    Raises:
        InputError: the file is torn.
    """
    file = folder / SETTINGS
    if not file.exists():
        return None
    try:
        settings = json.loads(file.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{file}: is torn: {error}") from error
    if not isinstance(settings, dict):
        raise InputError(f"{file}: want the settings of a command, by name, got a {type(settings).__name__}")
    return settings


def write_settings(folder: Path, settings: Mapping[str, Any]) -> None:
    """Write down what a run is asked for."""
    _write_text(folder / SETTINGS, json.dumps(dict(settings), indent=2) + "\n")


def require_same_settings(folder: Path, settings: Mapping[str, Any], kind: str) -> Row:
    """Refuse to go on with a run that was asked for something else.

    Settings that are mappings, such as the files of its agents, need to agree in the names that both have.

    Args:
        folder: of the run.
        settings: what is asked for now.
        kind: of run.

    Returns:
        What the run was asked for, then and now.

    Raises:
        InputError: there is no run, or one with other settings.
    """
    before = read_settings(folder)
    if before is None:
        raise InputError(f"--resume: {folder} holds no {kind} to go on with")
    now = json.loads(json.dumps(dict(settings)))
    both = {}
    for name in sorted(before.keys() | now.keys()):
        was, its = before.get(name), now.get(name)
        both[name] = {**was, **its} if isinstance(was, dict) and isinstance(its, dict) else its
        for part, old, new in _parts(name, was, its):
            if old != new:
                raise InputError(
                    f"--resume: {part} was {old!r} in {folder}, now it is {new!r}; "
                    "use the same settings, or another folder"
                )
    return both


def _parts(name: str, was: Any, its: Any) -> list[tuple[str, Any, Any]]:
    """A setting then and now; a mapping by each name that both have, and what stands there by every name."""
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
    """Make a folder for results and make sure that it can be written, before any work is done.

    Raises:
        InputError: it cannot be made or written.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / f".probe.{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"--out {path}: cannot be written ({error.strerror})") from error


def episode_key(row: Mapping[str, Any]) -> Key:
    """What makes an episode this one: its setting, agent and seed."""
    return (*(row[c] for c in SETTING_COLUMNS), row["seed"])


class ResultFolder:
    """Collects episodes as they finish.

    Args:
        path: the folder; made where it does not exist.
        settings: what was asked for; anything that changes the outcome of an episode.
        resume: go on from the episodes that an earlier run with the same settings left.
        overwrite: replace what another run left.

    Attributes:
        episodes: finished episodes by key.

    Raises:
        InputError: the folder cannot be written; it holds another run and neither `resume` nor `overwrite` is
            set; or `resume` is set and the settings differ.
    """

    def __init__(
        self, path: Path, settings: Mapping[str, Any], *, resume: bool = False, overwrite: bool = False
    ) -> None:
        make_folder(path)
        self.path = path
        self.episodes: dict[Key, Row] = {}
        self._timings: dict[Key, Row] = {}
        if resume:
            settings = require_same_settings(path, settings, "comparison")
            self.episodes = {episode_key(r): r for r in _read(path / "episodes.csv", EPISODE_COLUMNS)}
            self._timings = {episode_key(r): r for r in _read(path / "timings.csv", TIMING_COLUMNS)}
        elif (path / "episodes.csv").exists() and not overwrite:
            state = "a finished" if (path / SUMMARY).exists() else "an unfinished"
            raise InputError(
                f"--out {path}: holds {state} comparison; add --resume to go on with it, --overwrite to replace it, "
                "or name another folder"
            )
        (path / SUMMARY).unlink(missing_ok=True)
        write_settings(path, settings)
        # Rewritten from what could be read: a line that a crash tore is gone, and its episode runs again.
        _write_text(path / "episodes.csv", _csv_text(EPISODE_COLUMNS, self.episodes.values(), header=True))
        _write_text(path / "timings.csv", _csv_text(TIMING_COLUMNS, self._timings.values(), header=True))

    def add(self, rows: Sequence[Row], timings: Sequence[Row]) -> None:
        """Append finished episodes; on the disk when this returns."""
        # Memory first: after an interruption `finish` writes the files anew from what is known here.
        self._timings |= {episode_key(r): r for r in timings}
        self.episodes |= {episode_key(r): r for r in rows}
        # Then timings: an episode whose line is there is finished, and is not run again for its timing.
        _append(self.path / "timings.csv", _csv_text(TIMING_COLUMNS, timings))
        _append(self.path / "episodes.csv", _csv_text(EPISODE_COLUMNS, rows))

    def decision_s(self, key: Key) -> list[float]:
        """Wall time of the decisions of an episode, s; empty where a crash lost them."""
        row = self._timings.get(key)
        return [int(us) * 1e-6 for us in row["decisions_us"].split()] if row else []

    def finish(self, order: Iterable[Key], summary: Mapping[str, Any], *, complete: bool = True) -> None:
        """Put the episodes in order and write the summary.

        The order is the one asked for, not the one in which they finished, so that the file is the same
        for any number of jobs. Episodes that were not asked for, but are there from a run that this one
        resumed, come after. The summary of an incomplete run is called `summary.partial.json`.
        """
        wanted = dict.fromkeys(key for key in order if key in self.episodes)
        wanted |= dict.fromkeys(self.episodes)
        rows = [self.episodes[key] for key in wanted]
        timings = [self._timings[key] for key in wanted if key in self._timings]
        _write_text(self.path / "episodes.csv", _csv_text(EPISODE_COLUMNS, rows, header=True))
        _write_text(self.path / "timings.csv", _csv_text(TIMING_COLUMNS, timings, header=True))
        (self.path / SUMMARY_PARTIAL).unlink(missing_ok=True)
        write_summary(self.path, summary, SUMMARY if complete else SUMMARY_PARTIAL)


def _write_text(path: Path, text: str) -> None:
    with atomic_write(path) as beside:
        beside.write_text(text, encoding="utf-8")


def _csv_text(columns: Sequence[str], rows: Iterable[Mapping[str, Any]], *, header: bool = False) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    if header:
        writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _append(path: Path, text: str) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def _read(path: Path, columns: Sequence[str]) -> list[Row]:
    """The whole lines of a file that `_append` wrote."""
    if not path.exists():
        return []
    whole, _, _ = path.read_text(encoding="utf-8").rpartition("\n")
    rows = []
    for raw in csv.DictReader(io.StringIO(whole, newline="")):
        if tuple(raw) != tuple(columns) or None in raw.values():
            raise InputError(f"{path}: not written by this version of parkenv; use another folder")
        rows.append({name: _parse(name, value) for name, value in raw.items()})
    return rows


def _parse(name: str, value: str) -> Any:
    if name in _TEXT:
        return value
    if name in _BOOL:
        return value == "True"
    if name in _WHOLE:
        return int(value)
    return float(value) if value else None


def _plain(value: Any) -> Any:
    """JSON has no NaN: an interval that does not exist is null."""
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, float) and value != value:
        return None
    return value
