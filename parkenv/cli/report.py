"""`parkenv report`: the results of a command on one page, with replays of its searches and drives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli import arguments as args
from parkenv.cli.tables import make_console, progress_bar
from parkenv.cli.trust import require_trust
from parkenv.errors import InputError, nearest

if TYPE_CHECKING:
    from parkenv.studies.fleet.setting import Setting
    from parkenv.studies.fleet.study import FleetStudy
    from parkenv.studies.report.fleet_recording import FleetDay
    from parkenv.studies.report.repetition import Cases
    from parkenv.studies.study import ExecutionSpec

PAGE = "report.html"
EPISODES, SENSED, DAYS = 20, 4, 8
"""Default number of replayed searches: in general, and with rendered sensors at every step; of days with many cars."""


@dataclass(frozen=True)
class Replays:
    """What a page replays.

    Options:
        episodes, -n (N >= 0): About how many episodes to replay, all agents together.  [default: 20; through simulated
            sensors 4; 8 days of a fleet]
        replay (SEED[,...]): Replay the episodes with these seeds, or these days of a fleet.
        agents (NAME[,...]): Replay only these agents.
        sessions (N >= 0): Survey drives to replay.
        frames (2 <= N <= 250): Captures of them to keep, all drives together.
    """

    episodes: int | None = None
    replay: str | None = None
    agents: str | None = None
    sessions: int = 1
    frames: int = 120


REPLAYS = Replays()


def report(
    run: Path,
    /,
    replays: Replays,
    out: Path | None = None,
    *,
    trust: bool = False,
    machines: args.Machines,
) -> None:
    """Write an HTML page on a run: its settings, sortable tables, figures, and replays of its searches and drives.

    The page needs no network and no other file. Searches and drives are repeated with their seeds. If the total time of
    a search differs from that in the results, the page says so.

    Examples:
        parkenv report results/compare
        parkenv report results/compare --replay 3,17 --agents mdp --out two.html
        parkenv report results/survey --sessions 2

    Options:
        run (DIR): Folder of compare, survey, demo, train, fleet or another command.
        out, -o (FILE.html): The page.  [default: DIR/report.html]
    """
    make_report(run, machines, replays, out=out, trust=trust)


def make_report(
    folder: Path,
    machines: args.Machines | ExecutionSpec,
    replays: Replays = REPLAYS,
    *,
    out: Path | None = None,
    drives: Sequence[dict[str, Any]] | None = None,
    stage: str = "Running again",
    trust: bool = True,
) -> Path:
    """Write the page, and return its path.

    The arguments are those of `report`; `drives` are survey drives that are already recorded (None: `replays.sessions`
    of them are driven again), and `stage` describes the progress bar.

    Raises:
        InputError: the folder holds no finished run of this version, not the chosen searches, or names classes that
            are not trusted.
    """
    from parkenv.files.atomic_write import make_folder
    from parkenv.show.report.page import write_page
    from parkenv.studies.replays import Replays as Repeated
    from parkenv.studies.report.fleet_recording import choose_days, differing_days
    from parkenv.studies.report.repetition import (
        differences,
        drawable,
        drawable_settings,
        repeat_drive,
        replays_of,
    )
    from parkenv.studies.report.run_folder import RunFolder
    from parkenv.studies.report.search_recording import choose, record

    run = RunFolder.read(folder)
    make_folder(folder if out is None else out.parent)
    console = make_console()
    repeated = Repeated()
    notes: list[str] = []
    spec = None
    try:
        spec = run.spec()
    except (InputError, OSError) as error:
        notes.append(f"There is no replay: {error}")
    if spec is not None:
        # The page is made on the machines of this command, not of the run.
        require_trust(spec.changed(address=None), folder, trust)
    try:
        repeated = replays_of(run, spec)
    except (InputError, OSError) as error:
        # The page still has tables and figures.
        notes.append(f"There is no replay: {error}")
    sensed = any(case.rig is not None for case, _ in repeated.searches)
    wanted = replays.episodes if replays.episodes is not None else SENSED if sensed else EPISODES
    days: list[FleetDay] = []
    cases: Cases = []
    if (fleets := repeated.fleet) is not None:
        settings, too_large = drawable_settings(fleets, _chosen_settings(fleets, replays.agents))
        wanted = replays.episodes if replays.episodes is not None else DAYS
        numbers = replays.replay and _numbers_of(range(fleets.days), replays.replay)
        days = choose_days(fleets, settings, wanted, numbers or None)
    else:
        cases, too_large = drawable(_chosen([*repeated.searches], replays.replay, replays.agents))
    notes += too_large
    encounters = choose(cases, wanted) if wanted else []
    again = range(min(replays.sessions, repeated.sessions) if drives is None else 0)
    counted = run.totals() if encounters else {}
    tasks: list[Callable[[], dict[str, Any]]] = []
    for encounter in encounters:
        keys = [case.key(encounter.seed) for case in encounter.cases]
        tasks.append(partial(record, encounter, {k: counted[k] for k in keys if k in counted}))
    if repeated.survey is not None:
        frames = replays.frames // max(len(again), 1)
        tasks += [partial(repeat_drive, *repeated.survey, number, frames) for number in again]
    day_totals = run.day_totals() if days else {}
    tasks += [partial(one.record, day_totals) for one in days]
    with args.workers_of(machines) as workers, progress_bar(console) as progress:
        bar = progress.add_task(stage, total=len(tasks))
        done: list[dict[str, Any]] = []
        for one in workers.in_order(tasks):
            done.append(one)
            progress.advance(bar)
    watched, rest = done[: len(encounters)], done[len(encounters) :]
    driven, shown = rest[: len(again)], rest[len(again) :]
    notes += differences(watched) + differing_days(shown)
    path = out or folder / PAGE
    write_page(run.page_data(watched, driven if drives is None else drives, shown, notes), path, run.figures)
    for note in notes:
        console.print(f"Note: {note}")
    console.print(f"Written: {path}, {path.stat().st_size / 1e6:.1f} MB")
    return path


def _chosen_settings(fleets: FleetStudy, agents: str | None) -> list[Setting]:
    """Return the settings with the agents selected by `--agents`."""
    if agents is None:
        return fleets.fleet_settings
    names = _agents_of(list(dict.fromkeys(one.agent.label for one in fleets.fleet_settings)), agents)
    return [one for one in fleets.fleet_settings if one.agent.label in names]


def _chosen(cases: Cases, replay: str | None, agents: str | None) -> Cases:
    """Return the searches selected by `--replay` and `--agents`."""
    if agents is not None:
        names = _agents_of(list(dict.fromkeys(case.label for case, _ in cases)), agents)
        cases = [(case, numbers) for case, numbers in cases if case.label in names]
    if replay is not None:
        wanted = _numbers_of(cases[0][1] if cases else (), replay)
        cases = [(case, wanted) for case, _ in cases]
    return cases


def _agents_of(known: Sequence[str], agents: str) -> list[str]:
    """Return the agents that `--agents` names."""
    from parkenv.studies.agent_spec import split_agents

    for name in (names := split_agents(agents)):
        if name not in known:
            raise InputError(f"--agents has {name!r}; {nearest(name, known)}")
    return names


def _numbers_of(known: Sequence[int], replay: str) -> list[int]:
    """Return the seeds or days that `--replay` names."""
    theirs = f"{known[0]} to {known[-1]}" if known else "none"
    wanted: list[int] = []
    for number in args.numbers("--replay", replay):
        if number not in known:
            raise InputError(f"--replay has {number:g}; this run's are {theirs}")
        wanted.append(int(number))
    return wanted
