"""Surveys: drives past every slot with simulated sensors, recorded in a map file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, Field

from parkenv.files.known_names import LocaliserName, RigName, WeatherName
from parkenv.files.option import Inside, option
from parkenv.files.spec_file import Several
from parkenv.scenarios.spec import Hours, scenario_spec
from parkenv.show.plurals import plural, slots_text
from parkenv.studies.fields import PRICES, CaptureDistance, Detector, OneScenario, Seed, with_traffic
from parkenv.studies.results import SETTINGS, Key, Results, Row, without_nan
from parkenv.studies.sensing.sessions import MAP_FILE, SESSIONS
from parkenv.studies.study import Cell, Stage, Study
from parkenv.studies.workers import Task

if TYPE_CHECKING:
    from parkenv.mapping.survey import SessionResult, Survey, SurveySettings
    from parkenv.show.report.page import Page
    from parkenv.studies.report import Replay
    from parkenv.studies.runner import Result
    from parkenv.world.scenario import Scenario

PICTURES = 4
"""Number of perception results of the first session that are kept for figures."""
DRIVEN = "driven"
"""Key of what a session found in its row; the map keeps it."""
SHOWN = "shown"
"""Key of the first session in `Results.kept`: its result, with perception results for figures, and its recording."""


class SurveyStudy(Study):
    """A survey: drives past every slot with simulated sensors, recorded in a map file."""

    table: ClassVar = SESSIONS
    block: ClassVar = 1
    doing: ClassVar = "Driving (compiles first after an installation)"
    unit: ClassVar = "sessions"
    heading: ClassVar = "Survey"

    kind: Literal["survey"] = "survey"
    scenario: Annotated[
        OneScenario, AfterValidator(with_traffic), Inside(without=("--sensor-model", "--view-range", *PRICES))
    ] = Field(scenario_spec("campus"), validate_default=True)
    sessions: int = option(6, "Survey drives; the thesis has 21.", ge=1, le=100_000)
    rig: RigName | None = option(
        None,
        "laser: a camera and a 270° laser; stereo: a stereo camera alone; both_sides: a laser and a camera "
        "to each side; camera: a camera alone.",
        panel="Sensors",
        default="the scenario's, laser",
    )
    detector: Detector = None
    hours: Several[Hours] = option(
        ("08:00-10:00", "11:00-14:00", "16:00-18:00"),
        "When sessions begin, on the scenario's days; the windows are used in turn.",
        takes="HH:MM-HH:MM[,...]",
        panel="World",
        default="08:00-10:00,11:00-14:00,16:00-18:00",
        min_length=1,
        max_length=1_000,
    )
    weather: WeatherName | None = option(
        None, "Weather of all sessions.", panel="Sensors", default="drawn each time"
    )
    every: CaptureDistance = option(1.25, "Metres between captures.", takes="M")
    pose_noise: float = option(
        0.0, "Localisation error of the car, m.", takes="M", panel="Sensors", ge=0.0, le=100.0
    )
    odometry_drift: float = option(
        0.0,
        "Error of the odometry after 100 m, as a share of the distance: 0.02 is 2 m.",
        takes="P",
        panel="Sensors",
        ge=0.0,
        le=0.5,
    )
    localise: LocaliserName = option(
        "none", "scan-matching: correct the odometry by parked cars, walls and slots.", panel="Sensors"
    )
    picture_width: int | None = option(
        None,
        "Width of the cameras' pictures; searches have 400.",
        takes="PX",
        panel="Sensors",
        default="640",
        ge=64,
        le=4_096,
    )
    seed: Seed = Field(0, description="Seed of the drives.")

    @cached_property
    def built(self) -> Scenario:
        """The scenario."""
        from parkenv.scenarios.build import build

        return build(self.scenario)

    @cached_property
    def drive_settings(self) -> SurveySettings:
        """Settings of the drives."""
        from parkenv.mapping.odometry import PoseNoise
        from parkenv.mapping.survey import SurveySettings
        from parkenv.world.occupancy.arrival_window import ArrivalWindow

        days = self.scenario.arrivals.days
        return SurveySettings(
            rig=self.rig or self.scenario.rig,
            every=self.every,
            weather=self.weather,
            windows=tuple(ArrivalWindow.parse(hours, days) for hours in self.hours),
            pose_noise=PoseNoise(self.pose_noise, 0.02 * self.pose_noise, drift=self.odometry_drift),
            localise=self.localise,
            seed=self.seed,
            detector=self.detector or self.scenario.detector,
            picture_width=self.picture_width,
        )

    @cached_property
    def survey(self) -> Survey:
        """The drives."""
        from parkenv.mapping.survey import Survey

        return Survey(self.built, self.drive_settings)

    def check(self) -> None:
        self.survey.key_of(0)

    def settings(self) -> Row:
        """See `Study`: none, since the keys of sessions hold all; a map goes on with any others."""
        return {}

    def cells(self) -> list[Cell]:
        return [Cell("survey", range(self.sessions))]

    def keys(self, work: Any, item: int) -> list[Key]:
        del work
        return [(self.survey.key_of(item),)]

    def run(self, work: Any, items: Sequence[int]) -> list[Row]:
        from parkenv.studies.sensing.surveys import session_row

        del work
        driven = [self.drive(number) for number in items]
        return [session_row(result) | {DRIVEN: (result, recording)} for result, recording in driven]

    def drive(self, number: int) -> tuple[SessionResult, Any]:
        """Drive a session, the first one with results for figures; return it with its recording, if any."""
        return self.survey.drive(number, pictures=PICTURES if number == 0 else 0), None

    def prepare(self, results: Results, *, continues: bool) -> None:
        """See `Study`; a map without a run, such as that of recorded drives, stays and goes on."""
        from parkenv.mapping.store import MapStore

        file = results.path / MAP_FILE
        if not continues and (results.path / SETTINGS).exists():
            file.unlink(missing_ok=True)
        MapStore(file, self.built.lot).close()

    def stages(self, results: Results) -> Iterator[Stage]:
        """See `Study`; sessions that are not in the map are driven again."""
        from parkenv.mapping.store import MapStore

        with MapStore(results.path / MAP_FILE, self.built.lot) as store:
            rows = results.rows(self.table).items()
            results.replace([row for (key,), row in rows if store.has(key)], self.table)
        yield Stage(self.doing, self, self.cells())

    def save_artifacts(self, work: Any, rows: Sequence[Row], results: Results) -> None:
        """See `Study`: sessions go into the map."""
        from parkenv.mapping.store import MapStore

        del work
        with MapStore(results.path / MAP_FILE, self.built.lot) as store:
            for row in rows:
                result, recording = row.pop(DRIVEN)
                if not store.has(row["key"]):
                    store.add(result.session)
                if row["key"] == self.survey.key_of(0):
                    results.kept[SHOWN] = result, recording

    def summarise(self, results: Results) -> Row:
        from parkenv.studies.sensing.surveys import summarize

        rows = results.of(self, self.cells()[0])
        file = results.path / MAP_FILE
        return {"rows": [summarize(self.built, self.drive_settings, rows, file)] if rows else []}

    def outputs(self, result: Result) -> list[Task[object]]:
        """See `Study`: pictures of the map; those of the first session only if it was driven in this run."""
        from parkenv.studies.sensing.surveys import draw_survey

        shown, _ = result.results.kept.get(SHOWN, (None, None))
        return [partial(draw_survey, self.built, self.drive_settings, result.rows[0], shown, result.folder)]

    @classmethod
    def findings(cls, summary: Row) -> list[str]:
        (row,) = summary["rows"]
        right, unknown = row["slot_accuracy"], row["unknown_fraction"]
        return [
            f"{plural(row['sessions'], 'drive')} past {plural(row['slots'], 'slot')}: {row['car_detection_rate']:.1%} "
            f"of the parked cars were detected; slots: {slots_text(right, unknown)}."
        ]

    @classmethod
    def page(cls, summary: Row, folder: Path) -> Page:
        from parkenv.show.report.tables import survey_tables

        tables = survey_tables(summary["rows"][0], without_nan(cls.table.read(folder)))
        return super().page(summary, folder)._replace(tables=tables)

    def replays(self, folder: Path) -> Sequence[Replay]:
        from parkenv.studies.sensing.surveys import DriveReplay

        return [DriveReplay(self.built, self.drive_settings, len(self.table.read(folder)))]
