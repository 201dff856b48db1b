"""`parkenv report`: the results of a command on one page, with replays of its searches and drives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli import arguments as args
from parkenv.cli.tables import make_console, progress_bar
from parkenv.cli.trust import require_trust
from parkenv.errors import InputError, nearest

if TYPE_CHECKING:
    from parkenv.evaluation.experiments.compare import Case
    from parkenv.evaluation.experiments.spec import TrainingSpec, Workplace
    from parkenv.evaluation.report.run_folder import RunFolder
    from parkenv.files.spec_file import Spec
    from parkenv.mapping.survey import Survey

    Cases = list[tuple[Case, Sequence[int]]]
    Surveys = tuple[Callable[[], Survey], int]

PAGE = "report.html"
MAP_FILE = "map.sqlite"
EPISODES, SENSED = 20, 4
"""Default number of replayed searches: in general, and with rendered sensors at every step."""
BESIDE_MODELS = 3
"""Number of planners shown beside a trained model."""


def report(
    run: Path,
    /,
    episodes: int | None = None,
    replay: str | None = None,
    agents: str | None = None,
    sessions: int = 1,
    frames: int = 120,
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
        run (DIR): Folder of compare, survey, demo, train or another command.
        episodes, -n (N >= 0): About how many episodes to replay, all agents together.  [default: 20; through simulated
            sensors 4]
        replay (SEED[,...]): Replay the episodes with these seeds.
        agents (NAME[,...]): Replay only these agents.
        sessions (N >= 0): Survey drives to replay.
        frames (2 <= N <= 250): Captures of them to keep, all drives together.
        out, -o (FILE.html): The page.  [default: DIR/report.html]
    """
    make_report(
        run,
        machines,
        episodes=episodes,
        replay=replay,
        agents=agents,
        sessions=sessions,
        frames=frames,
        out=out,
        trust=trust,
    )


def make_report(
    folder: Path,
    machines: args.Machines | Workplace,
    *,
    episodes: int | None = None,
    replay: str | None = None,
    agents: str | None = None,
    sessions: int = 1,
    frames: int = 120,
    out: Path | None = None,
    drives: Sequence[dict[str, Any]] | None = None,
    stage: str = "Running again",
    trust: bool = True,
) -> Path:
    """Write the page, and return its path.

    The arguments are those of `report`; `drives` are survey drives that are already recorded (None: `sessions` of them
    are driven again), and `stage` describes the progress bar.

    Raises:
        InputError: the folder holds no finished run of this version, not the chosen searches, or names classes that
            are not trusted.
    """
    from parkenv.evaluation.report.page import page_data, write_page
    from parkenv.evaluation.report.run_folder import RunFolder
    from parkenv.evaluation.report.search_recording import choose, record

    run = RunFolder.read(folder)
    console = make_console()
    surveys: Surveys | None = None
    cases: Cases = []
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
        surveys, cases = _run_again(run, spec)
    except (InputError, OSError) as error:
        # The page still has tables and figures.
        notes.append(f"There is no replay: {error}")
    sensed = any(case.rig is not None for case, _ in cases)
    wanted = episodes if episodes is not None else SENSED if sensed else EPISODES
    cases, too_large = _small_enough(_chosen(cases, replay, agents))
    notes += too_large
    encounters = choose(cases, wanted) if wanted else []
    again = range(min(sessions, surveys[1])) if surveys is not None and drives is None else range(0)
    counted = run.totals()
    tasks: list[Callable[[], dict[str, Any]]] = []
    for encounter in encounters:
        keys = [case.key(encounter.seed) for case in encounter.cases]
        tasks.append(partial(record, encounter, {k: counted[k] for k in keys if k in counted}))
    if surveys is not None:
        tasks += [partial(_drive_again, surveys[0], number, frames // max(len(again), 1)) for number in again]
    with args.workers_of(machines) as workers, progress_bar(console) as progress:
        bar = progress.add_task(stage, total=len(tasks))
        done: list[dict[str, Any]] = []
        for recorded in workers.in_order(tasks):
            done.append(recorded)
            progress.advance(bar)
    watched = done[: len(encounters)]
    notes += _differing(watched)
    path = out or folder / PAGE
    recorded = done[len(encounters) :] if drives is None else drives
    write_page(page_data(run, watched, recorded, notes), path, run.figures)
    for note in notes:
        console.print(f"Note: {note}")
    console.print(f"Written: {path}, {path.stat().st_size / 1e6:.1f} MB")
    return path


def _run_again(run: RunFolder, spec: Spec | None) -> tuple[Surveys | None, Cases]:
    """Return the survey of a run, with its number of drives, and its searches, from its specification.

    Raises:
        InputError, OSError: the run cannot be repeated.
    """
    from parkenv.evaluation.experiments import spec as specs
    from parkenv.evaluation.experiments.experiment import Experiment, require_unchanged
    from parkenv.evaluation.experiments.results import read_settings

    match spec:
        case specs.ExperimentSpec():
            require_unchanged(spec, read_settings(run.path) or {})
            return None, [*Experiment(spec).cases]
        case specs.BenchmarkSpec():
            from parkenv.evaluation.experiments.benchmark import Suite

            return None, [*Suite.named(spec.suite).cases(spec.agents)]
        case specs.SurveySpec():
            from parkenv.evaluation.experiments.surveys import survey_of

            return (partial(_survey, *survey_of(spec)), len(run.table("sessions.csv"))), []
        case specs.DemoSpec():
            from parkenv.evaluation.experiments.demo import demo_cases, demo_survey
            from parkenv.mapping.store import MapStore

            its, settings = demo_survey(spec)
            with MapStore(run.path / MAP_FILE, its.lot, create=False) as store:
                log = store.log()
            return (partial(_survey, its, settings), len(log.time)), [*demo_cases(spec, its, log)]
        case specs.TrainingSpec():
            return None, _trained(run, spec)
    return None, []


def _trained(run: RunFolder, spec: TrainingSpec) -> Cases:
    """Return the best model and the best planners in the test scenarios; none for driving, or without a test."""
    if spec.env != "search" or not run.summary.get("transfer"):
        return []
    from parkenv.evaluation.experiments.compare import Case
    from parkenv.evaluation.training.rl_training import MODEL
    from parkenv.evaluation.training.search_task import SearchTask
    from parkenv.evaluation.training.training_task import TEST_SEED

    best = min(run.summary["rows"], key=lambda row: float(row["total_s"]))
    model = run.path / f"seed_{int(best['seed'])}" / MODEL
    task = SearchTask(spec)
    seeds = range(TEST_SEED, TEST_SEED + int(run.summary["transfer"][0]["episodes"]))
    cases: Cases = []
    for scenario in task.tested:
        planners = [row for row in run.summary.get("planners", []) if row["scenario"] == scenario.name]
        beside = sorted(planners, key=lambda row: float(row["total_s"]))[:BESIDE_MODELS]
        cases.append((Case(scenario, f"{task.algorithm}:{model}"), seeds))
        made = {
            case.label: case for case in (Case(scenario, a.name, options=a.options) for a in task.compared)
        }
        cases += [(made[row["agent"]], seeds) for row in beside if row["agent"] in made]
    return cases


def _chosen(cases: Cases, replay: str | None, agents: str | None) -> Cases:
    """Return the searches selected by `--replay` and `--agents`."""
    if agents is not None:
        from parkenv.evaluation.experiments.agent_spec import split_agents

        known = list(dict.fromkeys(case.label for case, _ in cases))
        for name in (names := split_agents(agents)):
            if name not in known:
                raise InputError(f"--agents has {name!r}; {nearest(name, known)}")
        cases = [(case, numbers) for case, numbers in cases if case.label in names]
    if replay is not None:
        its_seeds: Sequence[int] = cases[0][1] if cases else range(0)
        theirs = f"{its_seeds[0]} to {its_seeds[-1]}" if its_seeds else "none"
        wanted: list[int] = []
        for number in args.numbers("--replay", replay):
            if number not in its_seeds:
                raise InputError(f"--replay has {number:g}; this run's are {theirs}")
            wanted.append(int(number))
        cases = [(case, wanted) for case, _ in cases]
    return cases


def _small_enough(cases: Cases) -> tuple[Cases, list[str]]:
    """Return the searches on lots that are small enough to draw, and notes on the others."""
    from parkenv.evaluation.report.search_recording import MOST_SLOTS

    large = {
        case.scenario.name: case.scenario.lot.n_slots
        for case, _ in cases
        if case.scenario.lot.n_slots > MOST_SLOTS
    }
    notes = [
        f"{name} has {n} slots, more than the {MOST_SLOTS} that are drawn: no replay"
        for name, n in large.items()
    ]
    return [(case, its) for case, its in cases if case.scenario.name not in large], notes


def _differing(watched: Sequence[dict[str, Any]]) -> list[str]:
    """Return a note for every search whose total time differs from that in the results."""
    return [
        f"{search['agent']}, {e['world']['scenario']}, seed {e['world']['seed']}: run again it took "
        f"{search['total_s']:.2f} s, episodes.csv says {search['counted_s']:.2f} s"
        for e in watched
        for search in e["searches"]
        if search["agrees"] is False
    ]


def _survey(scenario: Any, settings: Any) -> Survey:
    from parkenv.mapping.survey import Survey

    return Survey(scenario, settings)


def _drive_again(survey: Callable[[], Survey], number: int, frames: int) -> dict[str, Any]:
    from parkenv.evaluation.report.drive_recording import record_drive

    return record_drive(survey(), number, most_frames=frames)[1]
