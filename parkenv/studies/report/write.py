"""Write the page on a run: choose what is replayed, run it again, and put it beside tables and figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from parkenv.errors import InputError, nearest
from parkenv.files.atomic_write import make_folder
from parkenv.files.spec_file import Spec
from parkenv.show.report.page import write_page
from parkenv.studies.fleet.setting import Setting
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.replays import Replays
from parkenv.studies.report.fleet_recording import FleetDay, choose_days, differing_days
from parkenv.studies.report.repetition import (
    Cases,
    differences,
    drawable,
    drawable_settings,
    repeat_drive,
    replays_of,
)
from parkenv.studies.report.run_folder import RunFolder
from parkenv.studies.report.search_recording import choose, record
from parkenv.studies.results import PAGE
from parkenv.studies.study import Progress
from parkenv.studies.workers import SERIAL, Workers

EPISODES, SENSED, DAYS = 20, 4, 8
"""Default number of replayed searches: in general, and with rendered sensors at every step; of days with many cars."""


@dataclass(frozen=True)
class ReportOptions:
    """What a page replays.

    Args:
        episodes: about how many searches or days, all agents together; None for `EPISODES`, `SENSED` or `DAYS`.
        numbers: seeds of the searches, or numbers of the days; None to choose them.
        agents: agents of the searches or days; None for all.
        sessions: number of survey drives.
        frames: captures of them to keep, all drives together.
        drives: survey drives that are already recorded, instead of driving them again.
    """

    episodes: int | None = None
    numbers: Sequence[float] | None = None
    agents: Sequence[str] | None = None
    sessions: int = 1
    frames: int = 120
    drives: Sequence[dict[str, Any]] | None = None


def write_report(
    run: RunFolder,
    spec: Spec | None,
    options: ReportOptions | None = None,
    *,
    out: Path | None = None,
    notes: Sequence[str] = (),
    workers: Workers = SERIAL,
    progress: Progress = lambda *_: None,
    doing: str = "Running again",
) -> tuple[Path, list[str]]:
    """Write the page on a run.

    Args:
        run: the run.
        spec: its specification; None to replay nothing.
        options: what to replay.
        out: the page; None for `report.html` in the folder of the run.
        notes: notes for the reader.
        workers: where searches, drives and days run again.
        progress: called as they finish.
        doing: what `progress` is called with.

    Returns:
        The page, and all notes on it.

    Raises:
        InputError: the run has not the chosen searches, or the page cannot be written.
    """
    options = options or ReportOptions()
    path = out or run.path / PAGE
    make_folder(path.parent)
    shown_notes, repeated = [*notes], Replays()
    try:
        repeated = replays_of(run, spec)
    except (InputError, OSError) as error:
        # The page still has tables and figures.
        shown_notes.append(f"There is no replay: {error}")
    sensed = any(case.rig is not None for case, _ in repeated.searches)
    usual = DAYS if repeated.fleet is not None else SENSED if sensed else EPISODES
    wanted = usual if options.episodes is None else options.episodes
    days: list[FleetDay] = []
    cases: Cases = []
    if (fleet := repeated.fleet) is not None:
        settings, too_large = drawable_settings(fleet, _chosen_settings(fleet, options.agents))
        days = choose_days(fleet, settings, wanted, _known(range(fleet.days), options.numbers))
    else:
        cases, too_large = drawable(_chosen([*repeated.searches], options.numbers, options.agents))
    shown_notes += too_large
    encounters = choose(cases, wanted) if wanted else []
    again = range(min(options.sessions, repeated.sessions) if options.drives is None else 0)
    counted = run.totals() if encounters else {}
    tasks: list[Callable[[], dict[str, Any]]] = []
    for encounter in encounters:
        keys = [case.key(encounter.seed) for case in encounter.cases]
        tasks.append(partial(record, encounter, {k: counted[k] for k in keys if k in counted}))
    if repeated.survey is not None:
        frames = options.frames // max(len(again), 1)
        tasks += [partial(repeat_drive, *repeated.survey, number, frames) for number in again]
    day_totals = run.day_totals() if days else {}
    tasks += [partial(one.record, day_totals) for one in days]
    progress(doing, 0, len(tasks))
    done: list[dict[str, Any]] = []
    for one in workers.in_order(tasks):
        done.append(one)
        progress(doing, len(done), len(tasks))
    watched, rest = done[: len(encounters)], done[len(encounters) :]
    driven, shown = rest[: len(again)], rest[len(again) :]
    shown_notes += differences(watched) + differing_days(shown)
    drives = driven if options.drives is None else options.drives
    write_page(run.page_data(watched, drives, shown, shown_notes), path, run.figures)
    return path, shown_notes


def _chosen_settings(fleet: FleetStudy, agents: Sequence[str] | None) -> list[Setting]:
    """Return the settings with some agents."""
    if agents is not None:
        _require_known(list(dict.fromkeys(one.agent.label for one in fleet.fleet_settings)), agents)
    return [one for one in fleet.fleet_settings if agents is None or one.agent.label in agents]


def _chosen(cases: Cases, numbers: Sequence[float] | None, agents: Sequence[str] | None) -> Cases:
    """Return the searches with some seeds and agents."""
    if agents is not None:
        _require_known(list(dict.fromkeys(case.label for case, _ in cases)), agents)
        cases = [(case, seeds) for case, seeds in cases if case.label in agents]
    wanted = _known(cases[0][1] if cases else (), numbers)
    return cases if wanted is None else [(case, wanted) for case, _ in cases]


def _require_known(known: Sequence[str], agents: Sequence[str]) -> None:
    for name in agents:
        if name not in known:
            raise InputError(f"--agents has {name!r}; {nearest(name, known)}")


def _known(known: Sequence[int], numbers: Sequence[float] | None) -> list[int] | None:
    """Return seeds or days that a run has."""
    theirs = f"{known[0]} to {known[-1]}" if known else "none"
    for number in numbers or ():
        if number not in known:
            raise InputError(f"--replay has {number:g}; this run's are {theirs}")
    return None if numbers is None else [int(number) for number in numbers]
