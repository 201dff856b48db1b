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
from parkenv.mapping.odometry import PoseNoise
from parkenv.scenarios.spec import Hours, scenario_spec
from parkenv.show.tables import Column, plural, shared, slots_text, table_of
from parkenv.studies.fields import PRICES, CaptureDistance, Detector, OneScenario, Seed, with_traffic
from parkenv.studies.results import SETTINGS, Key, Results, Row, without_nan
from parkenv.studies.sensing.sessions import MAP_FILE, SESSIONS
from parkenv.studies.study import Cell, ReplayJob, ReportOptions, Stage, Study
from parkenv.studies.workers import Task
from parkenv.world.occupancy.arrival_window import ArrivalWindow

if TYPE_CHECKING:
    from parkenv.mapping.survey import SessionResult, Survey, SurveySettings
    from parkenv.world.scenario import Scenario

PICTURES = 4  # number of perception results of the first session that are kept for figures
DRIVEN = "driven"  # key of what a session found in its row; the map keeps it
# Key of the first session in `Results.kept`: its result, with perception results for figures, and its recording.
SHOWN = "shown"


_METHODS = (
    ("fitted", "rectangle fitted to the beams"), ("thesis", "middle of the beams, as in the thesis")
)  # fmt: skip
_CAR_ERRORS = (
    Column("range_error_m", "distance, median error", "m", 3),
    Column("range_error_p95_m", "distance, 95th percentile", "m", 2),
    Column("place_error_m", "position, median error", "m", 2),
    Column("heading_error_deg", "heading, median error", "°", 1),
)
COLUMNS = (
    *shared("scenario"),
    Column("key", "drive"),
    Column("rig", "rig"),
    Column("detector", "detector"),
    Column("weather", "weather"),
    Column("distance_m", "distance", "m", 0),
    Column("in_frame", "cars in frames", digits=0),
    Column("detected", "detected", digits=0),
    Column("rate", "share detected", share=True, help="In frames in which the car is not occluded"),
    Column("occupied_fraction", "slots taken", share=True, digits=0),
    Column("parked", "parked", digits=0),
    Column("found", "found", digits=0),
    Column("detections", "detections", digits=0),
    Column("right", "correct", digits=0),
    Column("sessions", "drives", digits=0),
    Column("slots", "slots", digits=0),
    Column("car_detection_rate", "parked cars found", share=True, help="Detected at least once"),
    Column("detection_precision", "detections that are cars", share=True),
    Column("range_abs_error_m.median", "distance of a car, median error", "m", 3),
    Column("range_abs_error_m.p95", "distance of a car, 95th percentile", "m", 2),
    *(
        column._replace(key=f"car_pose.{key}.{column.key}", label=f"{name}: {column.label}")
        for key, name in _METHODS
        for column in _CAR_ERRORS
    ),
    Column("localise", "localisation"),
    Column("pose_error_m.odometry", "position by odometry, error", "m", 2, help="Root mean square, of a drive"),
    Column("pose_error_m.estimated", "position as estimated, error", "m", 2),
    Column("pose_error_m.max", "position as estimated, greatest error", "m", 2),
    Column("slot_accuracy", "slot accuracy", share=True, help="Slots never in view count as wrong"),
    Column("slot_accuracy_seen", "slot accuracy, slots in view", share=True),
    Column("unknown_fraction", "slots never in view", share=True),
    *_CAR_ERRORS,
    Column("slots_found.precision", "discovered slots, precision", share=True),
    Column("slots_found.recall", "discovered slots, recall", share=True),
    Column("slots_found.error", "discovered slots, mean position error", "m", 2),
    Column("slots_found.yaw_error", "discovered slots, mean heading error", "rad", 3),
    Column("occupancy_mae", "map error", digits=3, help="Mean absolute error of P(taken)"),
    Column("occupancy_mae_expected", "map error of raw counts", digits=3, help="Of as many drives at that hour"),
    Column("seconds_per_frame", "perception time per frame", "s", 3),
)  # fmt: skip
SHOWN_OF_SESSIONS = (
    "key", "weather", "occupied_fraction", "parked", "found", "detections", "right", "slot_accuracy",
    "slot_accuracy_seen", "unknown_fraction", "place_error_m", "heading_error_deg", "seconds_per_frame",
)  # fmt: skip


class SurveyStudy(Study):
    """Parked cars are detected in the camera images and located with the laser (or the stereo camera).

    A Bayes filter estimates the state of each slot. Every drive is one session of the map. Sessions are added to the
    map in --out: --resume adds further ones to it.
    """

    table: ClassVar = SESSIONS
    block: ClassVar = 1
    doing: ClassVar = "Driving (compiles first after an installation)"
    unit: ClassVar = "sessions"
    heading: ClassVar = "Survey"
    columns: ClassVar = COLUMNS
    shown: ClassVar = {"survey": (), "by_weather": (), "detection_by_distance": ()}
    writes: ClassVar = "map.sqlite, pictures and summary.json"
    examples: ClassVar = """
        parkenv survey --sessions 21
        parkenv survey --scenario street --rig stereo --weather rain
        parkenv survey --hours 12:00-13:00 --days weekend
        parkenv survey --odometry-drift 0.02 --localise scan-matching
        """

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
        from parkenv.scenarios.build import build

        return build(self.scenario)

    @cached_property
    def drive_settings(self) -> SurveySettings:
        from parkenv.mapping.survey import SurveySettings

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
        return [(self.survey.key_of(item),)]

    def run(self, work: Any, items: Sequence[int]) -> list[Row]:
        from parkenv.studies.sensing.surveys import session_row

        driven = [self.drive(number) for number in items]
        return [session_row(result) | {DRIVEN: (result, recording)} for result, recording in driven]

    def drive(self, number: int) -> tuple[SessionResult, Any]:
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
        from parkenv.mapping.store import MapStore

        with MapStore(results.path / MAP_FILE, self.built.lot) as store:
            for row in rows:
                result, recording = row.pop(DRIVEN)
                if not store.has(row["key"]):
                    store.add(result.session)
                if row["key"] == self.survey.key_of(0):
                    results.kept[SHOWN] = result, recording

    def summarise(self, results: Results) -> Row:
        from parkenv.studies.sensing.surveys import summarize

        rows = self.rows_of(self.cells()[0], results)
        file = results.path / MAP_FILE
        return {"rows": [summarize(self.built, self.drive_settings, rows, file)] if rows else []}

    def outputs(self, results: Results, summary: Row) -> list[Task[object]]:
        from parkenv.studies.sensing.surveys import draw_survey

        shown, _ = results.kept.get(SHOWN, (None, None))
        return [
            partial(draw_survey, self.built, self.drive_settings, summary["rows"][0], shown, results.path)
        ]

    @classmethod
    def findings(cls, summary: Row) -> list[str]:
        (row,) = summary["rows"]
        right, unknown = row["slot_accuracy"], row["unknown_fraction"]
        return [
            f"{plural(row['sessions'], 'drive')} past {plural(row['slots'], 'slot')}: {row['car_detection_rate']:.1%} "
            f"of the parked cars were detected; slots: {slots_text(right, unknown)}."
        ]

    @classmethod
    def page_tables(cls, summary: Row, folder: Path) -> list[Row]:
        (surveyed,) = summary["rows"]
        tables = [table_of("survey", "The survey", [surveyed], cls.columns, facts=True)]
        for name, title, rows in (
            ("by_weather", "By weather", [{"weather": w, **r} for w, r in surveyed["by_weather"].items()]),
            ("detection_by_distance", "Detection rate by distance", surveyed["detection_by_distance"]),
            (
                "sessions",
                "Survey drives",
                [{c: row[c] for c in SHOWN_OF_SESSIONS} for row in SESSIONS.read(folder)],
            ),
        ):
            if rows:
                plain = [row | {"weather": row["weather"].replace("_", " ")} for row in without_nan(rows)]
                tables.append(table_of(name, title, plain, cls.columns))
        return tables

    def replays(self, folder: Path, options: ReportOptions) -> Sequence[ReplayJob]:

        count = 0 if options.drives is not None else min(options.sessions, len(self.table.read(folder)))
        frames = options.frames // max(count, 1)
        return [ReplayJob([partial(_recorded, self.survey, number, frames) for number in range(count)])]


def _recorded(survey: Survey, number: int, frames: int) -> Row:
    from parkenv.show.report.drive_recording import record_drive

    return record_drive(survey, number, most_frames=frames)[1]
