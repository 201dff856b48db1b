"""`parkenv demo`: from the first survey session to the comparison of agents."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv import __version__
from parkenv.cli import arguments as args
from parkenv.cli.compare import result_tables
from parkenv.cli.report import make_report
from parkenv.cli.single_writer import writing_into
from parkenv.cli.tables import command_line, make_console, print_recorded, progress_bar
from parkenv.show.plurals import plural

if TYPE_CHECKING:
    from parkenv.mapping.inference import SessionLog
    from parkenv.mapping.survey import SurveySettings
    from parkenv.studies.spec import DemoSpec
    from parkenv.studies.workers import Workers
    from parkenv.world.scenario import Scenario

FIGURES = ("time_split", "time_distribution")
"""Names of figures in `parkenv.studies.compare.figures`."""
FILM = "search.gif"
NEXT = (
    (
        "parkenv compare --scenario jam --agents mdp,belief,oracle --episodes 40 --report",
        "another lot, where the forecast is wrong; many more searches, without images",
    ),
    (
        "parkenv trip --scenario campus --out results/trip.gif",
        "a trip with steering and manoeuvres, as a film",
    ),
    ("parkenv plan --scenario jam --failure-cost 10,90", "what the thesis's planner intends, in a picture"),
)
"""Commands to try after the demo, and what they do."""


def demo(
    scenario: str | None = None,
    quick: bool = False,
    sessions: int | None = None,
    episodes: int | None = None,
    seed: int = 0,
    out: Path = Path("results/demo"),
    *,
    every: float | None = None,
    detector: str | None = None,
    rerun: Path | None = None,
    folder: args.RunFolder,
    machines: args.Machines,
) -> None:
    """Survey a lot with simulated sensors, estimate how often each slot is taken, and search there on other days.

    1. Survey: a car with a side camera and a laser passes every slot; parked cars are detected, located and assigned to
    slots.

    2. Map: the probability that each slot is taken at the hour of the search, from these sessions alone.

    3. Searches on other days, with camera, laser and detector: the thesis's planner, the planner in belief space and
    two heuristic baselines, all with the same map, in the same worlds; and the clairvoyant lower bound.

    4. A report with replays, and a film of one search.

    Examples:
        parkenv demo
        parkenv demo --quick --out results/quick

    Options:
        quick: A shorter demo: fewer drives and episodes, captures farther apart.
        sessions (N >= 1): Survey drives.  [default: 4]
        episodes, -n (N >= 2): Episodes of each agent.  [default: 6]
        out, -o (DIR): Folder for everything.

    Sensors:
        every (M >= 0.1): Metres between captures.  [default: 2.5]
    """
    from parkenv.studies.compare.demo import QUICK
    from parkenv.studies.spec import DemoSpec

    settings = (QUICK if quick else {}) | args.not_none(sessions=sessions, episodes=episodes, every=every)
    spec = DemoSpec().changed(
        scenario=args.World().spec(scenario), detector=detector, seed=seed, **settings, **machines.given
    )
    with writing_into(out, "the same command"):
        run_demo(spec, out, folder, rerun)


def run_demo(spec: DemoSpec, out: Path, folder: args.RunFolder, rerun: Path | None = None) -> None:
    """Run the demo; continue an unfinished one in the folder, replace a finished one.

    Raises:
        InputError: the scenario cannot be made, or the folder cannot be used.
    """
    from parkenv.mapping.store import MapStore
    from parkenv.show.figures.survey import save_detections, save_session
    from parkenv.show.report.drive_recording import record_drive
    from parkenv.studies.compare.cases import run_cases, table
    from parkenv.studies.compare.demo import AGENTS, FILMED, demo_cases, demo_survey
    from parkenv.studies.compare.figures import ComparisonResults, draw_figures
    from parkenv.studies.compare.search_film import film_search
    from parkenv.studies.compare.warm_up import warm_up_tasks
    from parkenv.studies.results import ResultFolder
    from parkenv.studies.sensing.surveys import run_survey, summarize
    from parkenv.studies.spec import SPEC_FILE
    from parkenv.studies.trips.sensor_log import require_viewer

    if rerun is not None:
        require_viewer()
    its, settings = demo_survey(spec)
    console = make_console()
    map_file = out / "map.sqlite"
    resume = folder.resume or (_goes_on(out) and not folder.overwrite)
    results = ResultFolder(out, _settings(spec), resume=resume, overwrite=True)
    spec.write(out / SPEC_FILE)
    with (
        args.workers_of(spec) as workers,
        # Only processes of this machine write files.
        args.Machines(spec.jobs).workers() as here,
        progress_bar(console) as progress,
    ):

        def run_all(description: str, tasks: Sequence[Callable[[], object]], where: Workers) -> None:
            bar = progress.add_task(description, total=len(tasks))
            for _ in where.results(tasks):
                progress.advance(bar)

        run_all("compiling, once per installation", warm_up_tasks(settings, AGENTS), workers)
        bar = progress.add_task("1/4 survey drives", total=spec.sessions)
        run = run_survey(
            its, settings, spec.sessions, map_file, workers=workers, record=record_drive,
            on_session=lambda _: progress.advance(bar),
        )  # fmt: skip
        progress.update(bar, completed=spec.sessions)
        surveyed = summarize(its, settings, run, map_file)
        with MapStore(map_file, its.lot, create=False) as store:
            log = store.log()

        cases = demo_cases(spec, its, log)
        bar = progress.add_task("2/4 searches through the sensors", total=len(cases) * spec.episodes)
        run_cases(
            cases, results, workers=workers, block_size=1, on_progress=lambda n: progress.advance(bar, n)
        )
        rows = table(cases, results)
        filmed = next(case for case, _ in cases if case.agent == FILMED)
        tasks: list[Callable[[], object]] = [
            partial(film_search, filmed, cases[0][1][0], out / FILM),
            partial(_draw_map, its, log, spec.sessions, out / "map.png"),
            partial(draw_figures, ComparisonResults(cases, results.episodes, rows), out, FIGURES),
        ]
        if run.shown is not None:
            tasks += [
                partial(save_detections, run.shown, out / "detections.png"),
                partial(save_session, its.lot, run.shown, out / "session.png"),
            ]
        run_all("3/4 pictures and film", tasks, here)
        summary = {
            "command": command_line(), "version": __version__, "seed": spec.seed, "rows": rows,
            "survey": surveyed,
        }  # fmt: skip
        results.finish([case.key(s) for case, its_seeds in cases for s in its_seeds], summary)
    page = make_report(out, spec, drives=None if run.recorded is None else [run.recorded], stage="4/4 report")
    console.print(
        f"{plural(spec.sessions, 'drive')} past {its.lot.n_slots} slots: {surveyed['car_detection_rate']:.1%} of the "
        f"parked cars were found, {surveyed['slot_accuracy']:.1%} of the slots classified correctly. Mean absolute "
        f"error of the map: {surveyed['occupancy_mae']:.2f} (raw counts for that hour: "
        f"{surveyed['occupancy_mae_expected']:.2f})."
    )
    for printed in result_tables(rows, console.width):
        console.print(printed)
    if rerun is not None:
        with console.status(f"Running the first session and the first search again for {rerun}"):
            case, seeds = cases[0]
            _record(case.scenario, settings, seeds[0], rerun)
        print_recorded(console, rerun)
    console = make_console(soft_wrap=True)
    console.print("\nOpen")
    console.print(f"  {page}\n    the results on one page, with replays, in a browser")
    console.print(f"  {out / FILM}\n    a film of one search")
    console.print("\nTry next")
    for command, explained in NEXT:
        console.print(f"  {command}\n    {explained}")


def _draw_map(scenario: Scenario, log: SessionLog, sessions: int, path: Path) -> None:
    """Draw the map at the middle of the arrival window, and the true probabilities."""
    from parkenv.mapping.inference import predict
    from parkenv.show.figures.survey import save_map
    from parkenv.studies.sensing.surveys import mean_occupancy
    from parkenv.world.occupancy.process import DAY_NAMES
    from parkenv.world.week import DAY_S

    shown = replace(scenario.arrival, weekdays=scenario.arrival.weekdays[:2][-1:])
    time = DAY_S * shown.weekdays[0] + 0.5 * (shown.start_s + shown.end_s)
    hour, minute = divmod(int(time % DAY_S // 60), 60)
    title = f"{scenario.name}, {DAY_NAMES[shown.weekdays[0]]} {hour:02d}:{minute:02d}, {plural(sessions, 'session')}"
    save_map(scenario.lot, predict(log, time), mean_occupancy(scenario.occupancy, shown), title, path)


def _record(known: Scenario, settings: SurveySettings, seed: int, path: Path) -> None:
    """Record the first session and the first search on one timeline."""
    from parkenv.envs.perception import SearchPerceptionEnv
    from parkenv.mapping.survey import Survey
    from parkenv.studies.trips.sensor_log import record_search, record_session, sensor_log
    from planners.agent import make_agent

    env = SearchPerceptionEnv(known, rig="laser", detector=settings.detector)
    with sensor_log(path, known.lot, env.rig) as log:
        record_session(Survey(known, settings), 0, log)
        record_search(env, make_agent("mdp", env.scenario), seed, log)


def _settings(spec: DemoSpec) -> dict[str, Any]:
    """Return what determines the outcome of the searches."""
    from parkenv.perception.detector_registry import detector_version
    from parkenv.studies.compare.experiment import fingerprints, flat_tables

    return {
        "version": __version__,
        **flat_tables(spec.model_dump(mode="json", exclude={"jobs", "backend", "address", "episodes"})),
        "files": fingerprints(spec.files()),
        "detector": detector_version(spec.detector or spec.scenario.detector),
    }


def _goes_on(out: Path) -> bool:
    """Return whether the folder holds an unfinished demo."""
    from parkenv.studies.results import SETTINGS, SUMMARY

    return (out / SETTINGS).exists() and not (out / SUMMARY).exists()
