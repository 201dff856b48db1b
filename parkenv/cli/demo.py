"""`parkenv demo`: from the first survey session to the comparison of agents."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv import __version__
from parkenv.cli import arguments as args
from parkenv.cli.compare import result_tables
from parkenv.cli.report import make_report
from parkenv.cli.single_writer import writing_into
from parkenv.cli.tables import command_line, make_console, print_recorded

if TYPE_CHECKING:
    from parkenv.evaluation.experiments.spec import DemoSpec
    from parkenv.mapping.survey import SurveySettings
    from parkenv.world.scenario import Scenario

FIGURES = ("time_split", "time_distribution")
"""Names of figures in `parkenv.evaluation.figures.registry`."""


def demo(
    scenario: str | None = None,
    sessions: int = 4,
    episodes: int = 6,
    seed: int = 0,
    out: Path = Path("results/demo"),
    *,
    every: float = 2.5,
    detector: str = "hog",
    rerun: Path | None = None,
    folder: args.RunFolder,
    machines: args.Machines,
) -> None:
    """Survey a lot with simulated sensors, estimate how often each slot is taken, and search there on other days.

    1. Survey: a car with a side camera and a laser passes every slot; parked cars are detected, located and assigned to
    slots.

    2. Map: the probability that each slot is taken at the hour of the search, from these sessions alone.

    3. Searches on other days, with camera, laser and detector: the thesis's planner and three heuristic baselines, all
    with the same map, in the same worlds.

    Examples:
        parkenv demo

    Options:
        sessions (N >= 1): Survey drives.
        episodes, -n (N >= 2): Episodes of each agent.
        out, -o (DIR): Folder for everything.

    Sensors:
        every (M >= 0.1): Metres between captures.
    """
    from parkenv.evaluation.experiments.spec import DemoSpec

    spec = DemoSpec().changed(
        scenario=args.World().spec(scenario), sessions=sessions, episodes=episodes, every=every, detector=detector,
        seed=seed, **machines.given,
    )  # fmt: skip
    with writing_into(out, "the same command"):
        run_demo(spec, out, folder, rerun)


def run_demo(spec: DemoSpec, out: Path, folder: args.RunFolder, rerun: Path | None = None) -> None:
    """Run the demo; continue an unfinished one in the folder, replace a finished one.

    Raises:
        InputError: the scenario cannot be made, or the folder cannot be used.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from parkenv.evaluation.experiments.compare import run_cases, table
    from parkenv.evaluation.experiments.demo import AGENTS, demo_cases, demo_survey
    from parkenv.evaluation.experiments.results import ResultFolder
    from parkenv.evaluation.experiments.spec import SPEC_FILE
    from parkenv.evaluation.experiments.surveys import mean_occupancy, run_survey, summarize
    from parkenv.evaluation.experiments.warm_up import warm_up_tasks
    from parkenv.evaluation.figures.registry import ComparisonResults, draw_figures
    from parkenv.evaluation.figures.survey_pictures import save_detections, save_map, save_session
    from parkenv.evaluation.trips.sensor_log import require_viewer
    from parkenv.mapping.inference import predict
    from parkenv.mapping.store import MapStore
    from parkenv.world.occupancy import DAY_NAMES
    from parkenv.world.week import DAY_S

    if rerun is not None:
        require_viewer()
    its, settings = demo_survey(spec)
    console = make_console()
    map_file = out / "map.sqlite"
    resume = folder.resume or (_goes_on(out) and not folder.overwrite)
    results = ResultFolder(out, _settings(spec), resume=resume, overwrite=True)
    spec.write(out / SPEC_FILE)
    with args.workers_of(spec) as workers, Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        console=console, disable=not console.is_terminal,
    ) as progress:  # fmt: skip
        tasks = warm_up_tasks(settings, AGENTS)
        bar = progress.add_task("compiling, once after an installation", total=len(tasks))
        for _ in workers.results(tasks):
            progress.advance(bar)
        bar = progress.add_task("1/3 surveying", total=spec.sessions)
        run = run_survey(
            its,
            settings,
            spec.sessions,
            map_file,
            workers=workers,
            on_session=lambda _: progress.advance(bar),
        )
        progress.update(bar, completed=spec.sessions)

        bar = progress.add_task("2/3 drawing the map", total=1)
        with MapStore(map_file, its.lot, create=False) as store:
            log = store.log()
        shown = replace(its.arrival, weekdays=its.arrival.weekdays[:2][-1:])
        time = DAY_S * shown.weekdays[0] + 0.5 * (shown.start_s + shown.end_s)
        hour, minute = divmod(int(time % DAY_S // 60), 60)
        title = (
            f"{its.name}, {DAY_NAMES[shown.weekdays[0]]} {hour:02d}:{minute:02d}, {spec.sessions} sessions"
        )
        true = mean_occupancy(its.occupancy, shown)
        save_map(its.lot, predict(log, time), true, title, out / "map.png")
        if run.shown is not None:
            save_detections(run.shown, out / "detections.png")
            save_session(its.lot, run.shown, out / "session.png")
        progress.advance(bar)

        cases = demo_cases(spec, its, log)
        bar = progress.add_task("3/3 searching with simulated sensors", total=len(cases) * spec.episodes)
        run_cases(
            cases, results, workers=workers, block_size=1, on_progress=lambda n: progress.advance(bar, n)
        )
    rows = table(cases, results)
    surveyed = summarize(its, settings, run, map_file)
    summary = {
        "command": command_line(), "version": __version__, "seed": spec.seed, "rows": rows,
        "survey": surveyed,
    }  # fmt: skip
    results.finish([case.key(s) for case, its_seeds in cases for s in its_seeds], summary)
    draw_figures(ComparisonResults(cases, results.episodes, rows), out, FIGURES)
    console.print(
        f"{spec.sessions} drives past {its.lot.n_slots} slots: {surveyed['car_detection_rate']:.1%} of the parked cars "
        f"were found, {surveyed['slot_accuracy']:.1%} of the slots classified correctly. Mean absolute error of the "
        f"map: {surveyed['occupancy_mae']:.2f} (raw counts for that hour: {surveyed['occupancy_mae_expected']:.2f})."
    )
    for printed in result_tables(rows, console.width):
        console.print(printed)
    console.print(f"Pictures, the map, episodes.csv and summary.json are in {out}")
    if rerun is not None:
        with console.status(f"Running the first session and the first search again for {rerun}"):
            case, seeds = cases[0]
            _record(case.scenario, settings, seeds[0], rerun)
        print_recorded(console, rerun)
    if folder.report:
        make_report(out, spec)


def _record(known: Scenario, settings: SurveySettings, seed: int, path: Path) -> None:
    """Record the first session and the first search on one timeline."""
    from parkenv.envs.perception import SearchPerceptionEnv
    from parkenv.evaluation.trips.sensor_log import record_search, record_session, sensor_log
    from parkenv.mapping.survey import Survey
    from planners.agent import make_agent

    env = SearchPerceptionEnv(known, rig="laser", detector=settings.detector)
    with sensor_log(path, known.lot, env.rig) as log:
        record_session(Survey(known, settings), 0, log)
        record_search(env, make_agent("mdp", env.scenario), seed, log)


def _settings(spec: DemoSpec) -> dict[str, Any]:
    """Return what determines the outcome of the searches."""
    from parkenv.evaluation.experiments.experiment import fingerprints, flat_tables
    from parkenv.perception.detector_registry import detector_version

    return {
        "version": __version__,
        **flat_tables(spec.model_dump(mode="json", exclude={"jobs", "backend", "address", "episodes"})),
        "files": fingerprints(spec.files()),
        "detector": detector_version(spec.detector),
    }


def _goes_on(out: Path) -> bool:
    """Return whether the folder holds an unfinished demo."""
    from parkenv.evaluation.experiments.results import SETTINGS, SUMMARY

    return (out / SETTINGS).exists() and not (out / SUMMARY).exists()
