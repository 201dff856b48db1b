"""Detectors compared on whole survey drives: all look at the same drives and pictures."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, get_args

from pydantic import Field

from parkenv.files.known_names import RigName
from parkenv.files.spec_file import Axis, DetectorName
from parkenv.scenarios.spec import scenario_spec
from parkenv.studies.fields import CaptureDistance, ScenarioItem, Seed
from parkenv.studies.results import Key, Results, Row
from parkenv.studies.sensing.sessions import MAP_FILE, SESSION_COLUMNS, SessionTable
from parkenv.studies.sensing.survey_study import DRIVEN, SurveyStudy
from parkenv.studies.study import Cell, Study
from parkenv.studies.workers import Task
from parkenv.version import __version__

if TYPE_CHECKING:
    from parkenv.studies.runner import Result
    from parkenv.studies.sensing.detector_surveys import DetectorSurvey, SurveyedDrive


class DetectorStudy(Study):
    """Detectors compared on whole survey drives, each with every rig."""

    table: ClassVar = SessionTable(
        "sessions.csv", keys=("rig", "detector", "key"), columns=SESSION_COLUMNS[1:], lists=None
    )
    block: ClassVar = 1
    doing: ClassVar = "Driving (compiles first after an installation)"
    unit: ClassVar = "drives"
    goes_on: ClassVar = "always"
    keeps_order: ClassVar = True

    kind: Literal["detectors"] = "detectors"
    scenario: ScenarioItem = scenario_spec("campus")
    rigs: Axis[RigName] = Field(("laser",), description=f"Rigs: {', '.join(get_args(RigName))}.")
    detectors: Axis[DetectorName] = Field(
        ("hog", "net"), description="hog, side, front, net, a file (.npz, .onnx) or MODULE:CLASS."
    )
    sessions: int = Field(6, ge=1, le=100_000, description="Survey drives for each rig.")
    every: CaptureDistance = Field(2.5, description="Distance between captures, m.")
    seed: Seed = Field(0, description="Seed of cars, lighting and noise.")
    misses: int = Field(
        0,
        ge=0,
        le=1_000,
        description="Missed cars of each kind on a contact sheet for each rig and detector.",
    )

    @cached_property
    def surveys(self) -> list[SurveyStudy]:
        """The survey of each rig and detector, all of one scenario."""
        surveys = [
            SurveyStudy(
                scenario=self.scenario, sessions=self.sessions, rig=rig, detector=detector, every=self.every,
                seed=self.seed,
            )
            for rig in self.rigs
            for detector in self.detectors
        ]  # fmt: skip
        for other in surveys[1:]:
            other.built = surveys[0].built
        return surveys

    def check(self) -> None:
        """See `Study`."""
        from parkenv.perception.detector_registry import make_detector

        for name in self.detectors:
            make_detector(name)
        for survey in self.surveys:
            survey.check()

    def settings(self) -> Row:
        """See `Study`: the keys of sessions hold the others."""
        return {"version": __version__}

    def cells(self) -> list[Cell]:
        """See `Study`: rigs with the same route share their pictures."""
        groups = itertools.groupby(self.surveys, lambda survey: survey.survey.route.path.tobytes())
        numbers = itertools.count()
        return [Cell([next(numbers) for _ in group], range(self.sessions)) for _, group in groups]

    def keys(self, work: Sequence[int], item: int) -> list[Key]:
        """See `Study`."""
        surveys = [self.surveys[i] for i in work]
        return [(survey.rig, survey.detector, survey.survey.key_of(item)) for survey in surveys]

    def run(self, work: Sequence[int], items: Sequence[int]) -> list[Row]:
        """See `Study`."""
        from parkenv.mapping.survey import drive_together
        from parkenv.studies.sensing.surveys import session_row

        surveys = [self.surveys[i] for i in work]
        return [
            {"rig": survey.rig, "detector": survey.detector, **session_row(result), DRIVEN: (number, result)}
            for number in items
            for survey, result in zip(
                surveys, drive_together([survey.survey for survey in surveys], number), strict=True
            )
        ]

    def prepare(self, results: Results, *, continues: bool) -> None:
        """See `Study`; sessions that are not in a map are driven again."""
        from parkenv.files.atomic_write import make_folder
        from parkenv.mapping.store import MapStore

        for survey in self.of_detectors(results.path):
            make_folder(survey.folder / "sightings")
            file = survey.folder / MAP_FILE
            if not continues:
                file.unlink(missing_ok=True)
            names = survey.settings.rig, survey.settings.detector
            with MapStore(file, self.surveys[0].built.lot) as store:
                lost = [key for key in results.rows(self.table) if key[:2] == names and not store.has(key[2])]
            results.drop(lost, self.table)

    def of_detectors(self, folder: Path) -> list[DetectorSurvey]:
        """Return what `detector_surveys` needs of each survey."""
        from parkenv.files.file_names import file_name
        from parkenv.studies.sensing.detector_surveys import DetectorSurvey

        return [
            DetectorSurvey(survey.drive_settings, folder / file_name(f"{survey.rig}_{survey.detector}"))
            for survey in self.surveys
        ]

    def keep(self, work: Sequence[int], rows: Sequence[Row], results: Results) -> None:
        """See `Study`: sightings go into a table, and sessions into the map, of rig and detector."""
        from parkenv.mapping.store import MapStore
        from parkenv.studies.sensing.detector_surveys import write_sightings

        of_detectors = self.of_detectors(results.path)
        for i, row in zip(itertools.cycle(work), rows, strict=False):
            number, result = row.pop(DRIVEN)
            write_sightings(of_detectors[i].sightings_file(number), result.score.sightings)
            with MapStore(of_detectors[i].folder / MAP_FILE, self.surveys[i].built.lot) as store:
                if not store.has(row["key"]):
                    store.add(result.session)

    def drives(self, results: Results) -> list[list[SurveyedDrive]]:
        """Return the finished drives of each survey, in order."""
        from parkenv.studies.sensing.detector_surveys import SurveyedDrive, read_sightings

        rows = results.rows(self.table)
        of_detectors = self.of_detectors(results.path)
        return [
            [
                SurveyedDrive(number, rows[key], read_sightings(of_detectors[i].sightings_file(number)))
                for number in range(self.sessions)
                if (key := self.keys([i], number)[0]) in rows
            ]
            for i in range(len(self.surveys))
        ]

    def summarise(self, results: Results) -> Row:
        """See `Study`."""
        from parkenv.studies.sensing.detector_surveys import CAUSES, comparison_table, reach_table

        table: list[Row] = []
        reach: list[Row] = []
        for survey, drives in zip(self.of_detectors(results.path), self.drives(results), strict=True):
            if drives:
                table += comparison_table(self.surveys[0].built, survey, drives)
                reach += reach_table(survey, drives)
        return {"rows": table, "reach": reach, "causes": CAUSES}

    def outputs(self, result: Result) -> list[Task[object]]:
        """See `Study`: the table, the reach of each detector, and the cars that it missed."""
        from parkenv.files.csv_tables import write_csv
        from parkenv.files.file_names import file_name
        from parkenv.show.figures.detectors import save_reach
        from parkenv.show.plurals import plural
        from parkenv.studies.sensing.detector_surveys import TABLE_COLUMNS, draw_misses

        name, folder = self.surveys[0].built.name, result.folder
        ylabel = f"cars found in a picture, {name}, {plural(self.sessions, 'drive')}"
        picture = folder / file_name(f"reach_{name}", ".png")
        tasks: list[Task[object]] = [
            partial(write_csv, folder / "table.csv", TABLE_COLUMNS, result.rows),
            partial(save_reach, result.summary["reach"], ylabel, picture),
        ]
        if self.misses:
            surveys, drives = self.of_detectors(folder), self.drives(result.results)
            scenario = self.surveys[0].built
            tasks.append(
                partial(draw_misses, scenario, surveys, drives, self.misses, self.seed, result.rows, folder)
            )
        return tasks
