"""`parkenv park`: a car that drives into slots."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from parkenv.cli.study_command import StudyCommand
from parkenv.cli.tables import make_console, print_rows, save_summary, stages, writing_into
from parkenv.files.field_types import Probability
from parkenv.files.option import Inside, option, words_in
from parkenv.files.spec_file import Axis
from parkenv.scenarios.spec import scenario_spec
from parkenv.show.plurals import plural
from parkenv.studies.fields import Scenarios
from parkenv.studies.trips.manoeuvre_study import ManoeuvreStudy

SHOWN_ROWS = 20
SHOWN = (
    "agent", "kind", "way", "parked", "success", "contacts", "planning_ms", "planning_ms_p95", "time_s", "time_s_p95",
    "direction_changes", "direction_changes_p95", "driven_m", "turned_rad",
)  # fmt: skip
"""Columns of parkings on lots that are printed."""
_TASKS = "Parking tasks"


def _all_or(text: str) -> object:
    return None if text in ("all", "both") else words_in(text)


class Park(StudyCommand):
    """Parking in scenes, a study, or on lots."""

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
        from parkenv.studies.trips.parking_comparison import PLANNER, park_on_lots
        from parkenv.studies.trips.parking_runs import ParkingCase

        vehicle = study.vehicle or VehicleParameters()
        cases = [
            ParkingCase(build(spec).lot, self.kinds, self.ways or WAYS, self.occupied, self.slack, vehicle)
            for spec in self.scenarios
        ]
        seeds = range(study.seed, study.seed + study.episodes)
        console = make_console()
        with writing_into(out):
            with stages(console, "episodes") as progress, study.workers() as workers:
                parkings = park_on_lots(cases, seeds, out, workers=workers, progress=progress)
            names = [case.lot.name for case in cases]
            save_summary(out, study.seed, parkings.table, lots=names, agents={PLANNER: PLANNER})
        title = f"{', '.join(names)}, {plural(study.episodes, 'episode')} per lot"
        print_rows(console, title, parkings.table, SHOWN, study.columns)
        for row in [row for row in parkings.rows if not row["parked"]][:SHOWN_ROWS]:
            console.print(
                f"failed: {row['lot']}, seed {row['seed']}, {row['slot']} {row['way']}: {row['reason']}"
            )
        console.print(f"Episodes, summary and pictures are in {out}")
