"""`parkenv report`: the results of a command on one page, with replays of its searches and drives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli import arguments as args
from parkenv.cli.tables import make_console, stages
from parkenv.cli.trust import require_trust
from parkenv.errors import InputError

if TYPE_CHECKING:
    from parkenv.studies.study import ExecutionSpec


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
    """Write the page with a progress bar, and return its path.

    The arguments are those of `report`; see `ReportOptions` for `drives`, and `stage` describes the progress bar.

    Raises:
        InputError: the folder holds no finished run of this version, not the chosen searches, or names classes that
            are not trusted.
    """
    from parkenv.studies.agent_spec import split_agents
    from parkenv.studies.report import ReportOptions, RunFolder, write_report

    run = RunFolder.read(folder)
    notes: list[str] = []
    spec = None
    try:
        spec = run.spec()
    except (InputError, OSError) as error:
        notes.append(f"There is no replay: {error}")
    if spec is not None:
        # The page is made on the machines of this command, not of the run.
        require_trust(spec.changed(address=None), folder, trust)
    options = ReportOptions(
        replays.episodes,
        None if replays.replay is None else args.numbers("--replay", replays.replay),
        None if replays.agents is None else split_agents(replays.agents),
        replays.sessions,
        replays.frames,
        drives,
    )
    console = make_console()
    with args.workers_of(machines) as workers, stages(console) as progress:
        path, notes = write_report(
            run, spec, options, out=out, notes=notes, workers=workers, progress=progress, doing=stage
        )
    for note in notes:
        console.print(f"Note: {note}")
    console.print(f"Written: {path}, {path.stat().st_size / 1e6:.1f} MB")
    return path
