"""Commands of studies that have options besides the fields of the study, and `parkenv plan`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from parkenv.cli.options import Command
from parkenv.cli.report import make_report
from parkenv.cli.study_command import StudyCommand
from parkenv.cli.tables import print_rows, save_summary, stages
from parkenv.files.atomic_write import make_folder
from parkenv.files.field_types import Probability
from parkenv.files.folder_lock import only_writer
from parkenv.files.option import Inside, option, words_in
from parkenv.files.spec_file import Axis
from parkenv.scenarios.spec import scenario_spec
from parkenv.show.tables import SETTING_AXES, plural
from parkenv.studies.compare.comparison import Grid
from parkenv.studies.demo.study import FILM, QUICK
from parkenv.studies.demo.study import Demo as DemoStudy
from parkenv.studies.fields import TRAFFIC, AgentSpec, OneAgent, OneScenario, Scenarios, Seed
from parkenv.studies.results import PAGE
from parkenv.studies.sensing.survey_study import SHOWN, SurveyStudy
from parkenv.studies.study import ReportOptions
from parkenv.studies.trips.manoeuvre_study import ManoeuvreStudy

if TYPE_CHECKING:
    from parkenv.studies.runner import Result


class Survey(StudyCommand):
    record: Path | None = option(
        None,
        "Also record images, scans and poses of the first session (extra bags), for `parkenv map-drive`.",
        takes="FILE.mcap",
        panel="Results",
        default="none",
    )

    def run(self) -> None:
        if self.record is None:
            self.run_study()
            return
        from parkenv.mapping.recordings.writer import record_drive, require_recordable

        require_recordable(self.record)
        self.run_study()
        study = self.study
        assert isinstance(study, SurveyStudy)
        with self.console.status(f"Driving the first session once more for {self.record}"):
            record_drive(study.survey, 0, self.record)
        again = f"parkenv map-drive {self.record} --scenario {study.scenario.argument}"
        self.say(f"Recorded: {self.record}; map it with: {again}")


NEXT = (
    (
        "parkenv compare --scenario jam --agents mdp,belief,oracle --episodes 40 --report",
        "another lot, where the forecast is wrong; many more searches, without images",
    ),
    ("parkenv plan --scenario jam --failure-cost 10,90", "what the thesis's planner intends, in a picture"),
)


class Demo(StudyCommand):
    soft_wrap: ClassVar = True
    quick: bool = option(
        False,
        "A shorter demo: fewer drives and episodes, captures farther apart.",
        sets={"study": DemoStudy().changed(**QUICK)},
    )
    report: bool = option(True, "Write report.html.", panel="Results")

    def run(self) -> None:
        out = self.run_study().folder
        self.say("\nOpen")
        if self.report:
            self.say(f"  {out / PAGE}\n    the results on one page, with replays, in a browser")
        self.say(f"  {out / FILM}\n    a film of one search\n\nTry next")
        for command, explained in NEXT:
            self.say(f"  {command}\n    {explained}")

    def write_report(self, result: Result) -> Path:
        shown = result.results.kept.get(SHOWN)
        options = ReportOptions(drives=None if shown is None else [shown[1]])
        return make_report(result.folder, self.study, options, stage="Report")


SHOWN_ROWS = 20
# Columns of parkings on lots that are printed.
SHOWN_OF_PARKINGS = (
    "agent", "kind", "way", "parked", "success", "contacts", "planning_ms", "planning_ms_p95", "time_s", "time_s_p95",
    "direction_changes", "direction_changes_p95", "driven_m", "turned_rad",
)  # fmt: skip
_TASKS = "Parking tasks"


def _all_or(text: str) -> object:
    return None if text in ("all", "both") else words_in(text)


class Park(StudyCommand):
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

    def run(self) -> None:
        study = self.study
        assert isinstance(study, ManoeuvreStudy)
        if study.cases is not None or study.levels is not None:
            self.run_study()
        else:
            self._park_on_lots(study, self.out or study.folder({}))

    def _park_on_lots(self, study: ManoeuvreStudy, out: Path) -> None:
        from parkenv.driving.parking_task import WAYS
        from parkenv.driving.vehicle import VehicleParameters
        from parkenv.scenarios.build import build
        from parkenv.studies.trips.parking_runs import PLANNER, ParkingCase, park_on_lots

        vehicle = study.vehicle or VehicleParameters()
        cases = [
            ParkingCase(build(spec).lot, self.kinds, self.ways or WAYS, self.occupied, vehicle=vehicle)
            for spec in self.scenarios
        ]
        seeds = range(study.seed, study.seed + study.episodes)
        with only_writer(out):
            with stages(self.console, "episodes") as progress, study.workers() as workers:
                rows, table = park_on_lots(cases, seeds, out, workers=workers, progress=progress)
            names = [case.lot.name for case in cases]
            save_summary(out, study.seed, table, lots=names, agents={PLANNER: PLANNER})
        title = f"{', '.join(names)}, {plural(study.episodes, 'episode')} per lot"
        print_rows(self.console, title, table, SHOWN_OF_PARKINGS, study.columns)
        for row in [row for row in rows if not row["parked"]][:SHOWN_ROWS]:
            self.say(f"failed: {row['lot']}, seed {row['seed']}, {row['slot']} {row['way']}: {row['reason']}")
        self.say(f"Episodes, summary and pictures are in {out}")


class Plan(Command):
    """The picture shows the true occupancy (inner disc) and the forecast (outer ring) of each slot.

    It also shows the planned action at each vertex (arrow), the path driven with replanning, and the walk.
    """

    examples = """
        parkenv plan --scenario jam --failure-cost 10,90
        parkenv plan --scenario campus --failure-cost 90 --v-walk-kmh 4,10
        """

    scenario: Annotated[OneScenario, Inside(without=TRAFFIC)] = scenario_spec("campus")
    agent: OneAgent = Field(
        AgentSpec(name="mdp"),
        description="mdp or mdp-static, with any options in brackets: mdp(failure_s=90).",
    )
    seed: Seed = Field(0, description="Seed of the world.")
    grid: Annotated[Grid, Inside(only=("--failure-cost", "--v-walk-kmh", "--v-drive-kmh"))] = Grid()
    out: Path = option(Path("results/plan"), "Folder for plan.png and summary.json.", short="-o")

    def run(self) -> None:
        from parkenv.scenarios.build import build
        from parkenv.show.figures.picture_files import save_picture
        from parkenv.show.figures.searches import draw_searches
        from parkenv.studies.compare.cases import plan_searches, settings_of

        grid = self.grid
        with self.console.status("Planning"):
            settings = settings_of(build(self.scenario), grid.failure_s, grid.v_walk_kmh, grid.v_drive_kmh)
            rows, searches = plan_searches(settings, self.agent, self.seed)
            make_folder(self.out)
            save_picture(draw_searches(searches), self.out / "plan.png")
        save_summary(self.out, self.seed, rows)
        title = f"{self.scenario.title}: plans of {self.agent.label}, seed {self.seed}"
        print_rows(
            self.console,
            title,
            rows,
            (*SETTING_AXES, "slot", "expected_s", "total_s", "driven_m", "walked_m", "replans"),
        )
        self.say(f"Picture and summary are in {self.out}")
