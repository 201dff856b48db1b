"""`parkenv demo`: from the first survey session to the comparison of agents."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from parkenv import __version__
from parkenv.cli import arguments as args
from parkenv.cli.compare import result_tables
from parkenv.cli.tables import make_console
from parkenv.scenarios.build import make_scenario

if TYPE_CHECKING:
    from parkenv.evaluation.experiments.compare import Case
    from parkenv.mapping.inference import SessionLog
    from parkenv.mapping.survey import SurveySettings
    from parkenv.world.scenario import Scenario

AGENTS = ("mdp", "greedy-goal", "greedy-drive", "first-free")
FIGURES = ("time_split", "time_distribution")
"""Of `parkenv.evaluation.figures.registry`."""


def demo(
    scenario: Annotated[
        str, typer.Option("--scenario", help="A packaged scenario: campus, jam, street, mini.")
    ] = "campus",
    sessions: Annotated[int, typer.Option("--sessions", min=1, help="Survey drives.")] = 4,
    searches: Annotated[int, typer.Option("--searches", "-n", min=2, help="Searches of each agent.")] = 6,
    every: Annotated[
        float, typer.Option("--every", min=0.1, help="Metres between captures of the survey.")
    ] = 2.5,
    detector: args.DetectorOption = "hog",
    seed: args.SeedOption = 0,
    jobs: args.JobsOption = 0,
    rerun: args.RerunOption = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for everything.")] = Path("results/demo"),
    report: Annotated[
        bool, typer.Option("--report", help="Also write report.html, as `parkenv report` does.")
    ] = False,
) -> None:
    """Survey a lot with simulated sensors, estimate how often each slot is taken, and search there on other days.

    1. Survey: a car with a side camera and a laser passes every slot; parked cars are detected, located and assigned to
    slots.

    2. Map: the probability that each slot is taken at the hour of the search, from these sessions alone.

    3. Searches on other days, with camera, laser and detector: the thesis's planner and three heuristic baselines, all
    with the same map, in the same worlds.

    Example:
    * `parkenv demo`
    """
    from parkenv.evaluation.experiments.compare import run_cases, table
    from parkenv.evaluation.experiments.results import ResultFolder, make_folder
    from parkenv.evaluation.experiments.surveys import run_survey, summarize
    from parkenv.evaluation.experiments.warm_up import warm_up_tasks
    from parkenv.evaluation.figures.registry import ComparisonResults, draw_figures
    from parkenv.evaluation.figures.survey_pictures import save_detections, save_map, save_session
    from parkenv.evaluation.trips.sensor_log import require_viewer
    from parkenv.mapping.inference import predict
    from parkenv.mapping.store import MapStore
    from parkenv.world.occupancy import Arrival

    if rerun is not None:
        require_viewer()
    its, settings = survey_spec(scenario, every, seed, detector)
    make_folder(out)
    console = make_console()
    map_file = out / "map.sqlite"
    folder = ResultFolder(out, _settings(its, settings, sessions, seed), resume=_goes_on(out), overwrite=True)
    with args.workers_of(jobs, "loky", None) as workers, Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        console=console, disable=not console.is_terminal,
    ) as progress:  # fmt: skip
        tasks = warm_up_tasks(settings, AGENTS)
        bar = progress.add_task("compiling, once after an installation", total=len(tasks))
        for _ in workers.results(tasks):
            progress.advance(bar)
        bar = progress.add_task("1/3 surveying", total=sessions)
        run = run_survey(
            its, settings, sessions, map_file, workers=workers, on_session=lambda _: progress.advance(bar)
        )
        progress.update(bar, completed=sessions)

        bar = progress.add_task("2/3 drawing the map", total=1)
        with MapStore(map_file, its.lot, create=False) as store:
            log = store.log()
        noon = 86_400.0 + 0.5 * (its.arrival.start_s + its.arrival.end_s)
        true = its.occupancy.forecast(Arrival(noon)).p_occupied
        title = f"{its.name}, Tuesday {int(noon % 86_400 // 3600):02d}:30, {sessions} sessions"
        save_map(its.lot, predict(log, noon), true, title, out / "map.png")
        if run.shown is not None:
            save_detections(run.shown, out / "detections.png")
            save_session(its.lot, run.shown, out / "session.png")
        progress.advance(bar)

        cases = search_spec(its, log, searches, seed, detector)
        bar = progress.add_task("3/3 searching with simulated sensors", total=len(AGENTS) * searches)
        run_cases(
            cases, folder, workers=workers, block_size=1, on_progress=lambda n: progress.advance(bar, n)
        )
    rows = table(cases, folder)
    surveyed = summarize(its, settings, run, map_file)
    summary = {
        "command": ["parkenv", *sys.argv[1:]], "version": __version__, "seed": seed, "rows": rows, "survey": surveyed,
    }  # fmt: skip
    folder.finish([case.key(s) for case, its_seeds in cases for s in its_seeds], summary)
    draw_figures(ComparisonResults(cases, folder.episodes, rows), out, FIGURES)
    console.print(
        f"{sessions} survey sessions, {its.lot.n_slots} slots: {surveyed['car_detection_rate']:.1%} of the parked cars "
        f"detected, {surveyed['slot_accuracy']:.1%} of the slots right. Mean absolute error of the map: "
        f"{surveyed['occupancy_mae']:.2f} (raw counts for that hour: {surveyed['occupancy_mae_expected']:.2f})."
    )
    for printed in result_tables(rows, console.width):
        console.print(printed)
    console.print(f"Pictures, the map, episodes.csv and summary.json are in {out}")
    if rerun is not None:
        with console.status(f"Running the first session and the first search again for {rerun}"):
            case, seeds = cases[0]
            _record(case.scenario, settings, seeds[0], rerun)
        console.print(f"Recorded: {rerun}; look at it with: rerun {rerun}")
    if report:
        from parkenv.cli.report import make_report

        make_report(out, jobs=jobs)


def survey_spec(scenario: str, every: float, seed: int, detector: str) -> tuple[Scenario, SurveySettings]:
    """Return the world of the demo, and how it is surveyed."""
    from parkenv.mapping.survey import SurveySettings
    from parkenv.world.occupancy import ArrivalWindow
    from parkenv.world.traffic import Traffic

    hours = ("08:00-09:30", "09:30-11:00", "11:00-12:30", "12:30-13:00")
    windows = tuple(ArrivalWindow.parse(h) for h in hours)
    its = make_scenario(scenario, traffic=Traffic(cars=3, pedestrians=5))
    return its, SurveySettings(every=every, windows=windows, seed=seed, detector=detector)


def search_spec(
    its: Scenario, log: SessionLog, searches: int, seed: int, detector: str
) -> list[tuple[Case, range]]:
    """Return the searches: all agents with the map of the survey, and the seeds."""
    from parkenv.evaluation.experiments.compare import Case
    from parkenv.mapping.inference import MapPrior
    from parkenv.world.sensor_model import SensorModel

    known = its.replace(prior=MapPrior(log), sensor_model=SensorModel.named("laser"))
    # The worlds of the searches are not those of the survey: their seeds are far from its seeds.
    seeds = range(seed + 1_000_000, seed + 1_000_000 + searches)
    return [(Case(known, name, rig="laser", detector=detector), seeds) for name in AGENTS]


def _record(known: Scenario, settings: SurveySettings, seed: int, path: Path) -> None:
    """Record the first session and the first search, on one time line."""
    from parkenv.envs.perception import SearchPerceptionEnv
    from parkenv.evaluation.trips.sensor_log import record_search, record_session, sensor_log
    from parkenv.mapping.survey import Survey
    from planners.agent import make_agent

    env = SearchPerceptionEnv(known, rig="laser", detector=settings.detector)
    with sensor_log(path, known.lot, env.rig) as log:
        record_session(Survey(known, settings), 0, log)
        record_search(env, make_agent(AGENTS[0], env.scenario), seed, log)


def _settings(its: Scenario, settings: SurveySettings, sessions: int, seed: int) -> dict[str, Any]:
    """Return what determines the outcome of the searches."""
    from parkenv.perception.detector_registry import detector_version

    return {
        "version": __version__,
        "demo": its.name,
        "every": settings.every,
        "sessions": sessions,
        "seed": seed,
        "detector": detector_version(settings.detector),
    }


def _goes_on(out: Path) -> bool:
    """Return whether the folder holds an unfinished demo."""
    from parkenv.evaluation.experiments.results import SETTINGS, SUMMARY

    return (out / SETTINGS).exists() and not (out / SUMMARY).exists()
