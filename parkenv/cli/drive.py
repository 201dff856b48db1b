"""`parkenv calibrate` and `parkenv park`: a car that steers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from parkenv.cli.study_command import StudyCommand
from parkenv.cli.tables import make_console, print_rows, save_summary, stages, writing_into
from parkenv.files.option import Inside, option, words_in
from parkenv.files.spec_file import Axis
from parkenv.scenarios.spec import Probability, scenario_spec
from parkenv.show.plurals import plural
from parkenv.studies.fields import Scenarios
from parkenv.studies.trips.calibration_study import CalibrationStudy
from parkenv.studies.trips.manoeuvre_study import ManoeuvreStudy

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.studies.runner import Result

SHOWN_ROWS, SHOWN_SCENES = 20, 60
SHOWN_LEVELS = (
    "agent", "level", "scenes", "driven", "success", "success_ci95", "contacts", "time_s", "length_m",
    "direction_changes", "planning_ms", "planning_ms_p95",
)  # fmt: skip
"""Columns of a comparison in drawn scenes that are printed."""
SHOWN = (
    "agent", "kind", "way", "parked", "success", "contacts", "planning_ms", "planning_ms_p95", "time_s", "time_s_p95",
    "direction_changes", "direction_changes_p95", "driven_m", "turned_rad",
)  # fmt: skip
"""Columns of parkings on lots that are printed."""


class Calibrate(StudyCommand):
    """A simulated car drives along the lanes and into slots, as the agent decides. Every seed is driven twice.

    The drive with the scenario's observations of slots gives the speed and the duration of the manoeuvre; the drive
    without observations before an attempt gives the cost of failed attempts. `parkenv compare --calibrated
    OUT/calibrated.json` then compares agents under both costs.
    """

    examples = """
        parkenv calibrate --scenario campus --episodes 200
        parkenv compare --calibrated results/calibrate/calibrated.json
        """

    study: CalibrationStudy = CalibrationStudy()
    out: Path = option(
        Path("results/calibrate"),
        "Folder for calibrated.json, trips.jsonl, summary.json and the figure.",
        short="-o",
    )

    def show(self, console: Console, result: Result) -> None:
        """Print the distributions and the calibration."""
        from parkenv.world.scenario import KMH

        print_rows(console, self.study.title, result.rows, ("what", "n", "mean", "median", "p95"))
        if (made := result.summary["calibrated"]) is not None:
            trips, touched, stuck = (result.summary[name] for name in ("trips", "contacts", "rescues"))
            console.print(
                f"Calibrated: driving at {made['v_drive'] / KMH:.2f} km/h, a failed attempt costs "
                f"{made['failure_s']:.1f} s, and parking takes {made['manoeuvre_s']:.1f} s that the drive graph leaves "
                f"out. In {trips} trips: {touched} contacts, {stuck} times stuck."
            )


_TASKS = "Parking tasks"


def _all_or(text: str) -> object:
    return None if text in ("all", "both") else words_in(text)


class Park(StudyCommand):
    """On lots it writes pictures of one successful episode per kind of slot and orientation, and an animation of one.

    It also draws failures, if any.

    With --cases or --levels, every scene is planned, driven within the car's limits, and checked with footprints 2 cm
    apart against the exact obstacles: no contact, and an end within 0.05 m and 0.01 rad of the target. The command
    writes manoeuvres.csv, trajectories.csv (the middle of the rear axle every 0.05 s) and pictures of all scenes.
    """

    examples = """
        parkenv park --episodes 250 --scenario campus,street,jam
        parkenv park --lot parking_map.yml --way back-in
        parkenv park --cases tpcap --vehicle tpcap --out results/tpcap
        parkenv park --levels parallel-extreme,oblique-complex --episodes 10
        """

    study: ManoeuvreStudy = ManoeuvreStudy()
    scenarios: Annotated[Scenarios, Inside(only=())] = (scenario_spec("campus"), scenario_spec("street"))
    kinds: Axis[Literal["perpendicular", "oblique", "parallel"]] | None = option(
        None,
        "Slots: perpendicular, oblique, parallel.",
        name="--kind",
        panel=_TASKS,
        takes="NAME[,...]|all",
        default="all",
        parse=_all_or,
    )
    ways: Axis[Literal["nose-in", "back-in"]] | None = option(
        None,
        "Orientation in the slot: nose-in, back-in.",
        name="--way",
        panel=_TASKS,
        takes="NAME|both",
        default="both",
        parse=_all_or,
    )
    occupied: Probability = option(
        0.85, "Fraction of the other slots that are taken.", takes="P", panel=_TASKS
    )
    slack: float = option(
        0.0,
        "Distance around the slot kept clear of parked cars, m.",
        takes="M",
        panel=_TASKS,
        ge=0.0,
        le=100.0,
    )
    out: Path = option(
        Path("results/park"), "Folder for pictures, episodes.csv and summary.json.", short="-o"
    )

    def run(self) -> None:
        if self.study.cases is not None or self.study.levels is not None:
            self.run_study()
        else:
            self._park_on_lots()

    def show(self, console: Console, result: Result) -> None:
        """Print a row for each level, or of files a row for each scene, those that failed first."""
        if self.study.levels is not None:
            levels = result.summary["levels"]
            print_rows(console, "Levels", levels, SHOWN_LEVELS)
        rows = sorted(result.rows, key=lambda row: row["driven"])
        shown = [name for name in rows[0] if name != "planned"] if rows else ()
        print_rows(console, plural(len(rows), "scene"), rows[:SHOWN_SCENES], shown)
        console.print(*self.study.findings(result.summary), soft_wrap=True)

    def _park_on_lots(self) -> None:
        from parkenv.driving.parking_task import WAYS
        from parkenv.driving.vehicle import VehicleParameters
        from parkenv.scenarios.build import build
        from parkenv.studies.trips.parking_comparison import PLANNER, park_on_lots
        from parkenv.studies.trips.parking_runs import ParkingCase

        study, vehicle = self.study, self.study.vehicle or VehicleParameters()
        cases = [
            ParkingCase(build(spec).lot, self.kinds, self.ways or WAYS, self.occupied, self.slack, vehicle)
            for spec in self.scenarios
        ]
        seeds = range(study.seed, study.seed + study.episodes)
        console = make_console()
        with writing_into(self.out):
            with stages(console, "episodes") as progress, study.workers() as workers:
                found = park_on_lots(cases, seeds, self.out, workers=workers, progress=progress)
            names = [case.lot.name for case in cases]
            save_summary(self.out, study.seed, found.table, lots=names, agents={PLANNER: PLANNER})
        print_rows(
            console, f"{', '.join(names)}, {plural(study.episodes, 'episode')} per lot", found.table, SHOWN
        )
        for row in [row for row in found.rows if not row["parked"]][:SHOWN_ROWS]:
            console.print(
                f"failed: {row['lot']}, seed {row['seed']}, {row['slot']} {row['way']}: {row['reason']}"
            )
        console.print(f"Episodes, summary and pictures are in {self.out}")
