"""`parkenv demo`: from the first survey session to the comparison of agents."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from parkenv.cli import arguments as args
from parkenv.cli.compare import result_tables
from parkenv.cli.report import make_report
from parkenv.cli.study_run import run_study
from parkenv.cli.tables import make_console, print_recorded
from parkenv.show.plurals import plural

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.studies.demo.study import Demo
    from parkenv.studies.runner import Result

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
    from parkenv.studies.demo.study import QUICK, Demo

    settings = (QUICK if quick else {}) | args.not_none(sessions=sessions, episodes=episodes, every=every)
    study = Demo().changed(
        scenario=args.World().spec(scenario), detector=detector, seed=seed, **settings, **machines.given
    )
    run_demo(study, out, folder, rerun)


def run_demo(study: Demo, out: Path, folder: args.RunFolder, rerun: Path | None = None) -> None:
    """Run the demo, write its report, and say what to look at; continue an unfinished one, replace a finished one.

    Raises:
        InputError: the scenario cannot be made, or the folder cannot be used.
        KeyboardInterrupt: the run was interrupted; what is finished is in the folder.
    """
    from parkenv.studies.demo.study import FILM
    from parkenv.studies.sensing.survey_study import SHOWN
    from parkenv.studies.trips.sensor_log import require_viewer

    if rerun is not None:
        require_viewer()
    result = run_study(study, out, args.ReportedRun(folder.resume, folder.overwrite), show)
    shown = result.results.kept.get(SHOWN)
    page = make_report(out, study, drives=None if shown is None else [shown[1]], stage="Report")
    console = make_console()
    if rerun is not None:
        with console.status(f"Running the first session and the first search again for {rerun}"):
            _record(study, out, rerun)
        print_recorded(console, rerun)
    console = make_console(soft_wrap=True)
    console.print("\nOpen")
    console.print(f"  {page}\n    the results on one page, with replays, in a browser")
    console.print(f"  {out / FILM}\n    a film of one search")
    console.print("\nTry next")
    for command, explained in NEXT:
        console.print(f"  {command}\n    {explained}")


def show(console: Console, result: Result) -> None:
    """Print the errors of the survey, and the table of the searches."""
    if (surveyed := result.summary["survey"]) is not None:
        console.print(
            f"{plural(surveyed['sessions'], 'drive')} past {surveyed['slots']} slots: "
            f"{surveyed['car_detection_rate']:.1%} of the parked cars were found, {surveyed['slot_accuracy']:.1%} of "
            f"the slots classified correctly. Mean absolute error of the map: {surveyed['occupancy_mae']:.2f} (raw "
            f"counts for that hour: {surveyed['occupancy_mae_expected']:.2f})."
        )
    for printed in result_tables(result.rows, console.width):
        console.print(printed)


def _record(study: Demo, out: Path, path: Path) -> None:
    """Record the first session and the first search on one timeline."""
    from parkenv.envs.perception import SearchPerceptionEnv
    from parkenv.mapping.survey import Survey
    from parkenv.studies.trips.sensor_log import record_search, record_session, sensor_log
    from planners.agent import make_agent

    case, seeds = study.cases_in(out)[0]
    settings = study.survey.drive_settings
    env = SearchPerceptionEnv(case.scenario, rig="laser", detector=settings.detector)
    with sensor_log(path, case.scenario.lot, env.rig) as log:
        record_session(Survey(case.scenario, settings), 0, log)
        record_search(env, make_agent("mdp", env.scenario), seeds[0], log)
