"""The demo: a survey, and searches on other days that use only its map: a few through sensors, many without images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field

from parkenv.files.known_names import RigName
from parkenv.files.option import Inside, option
from parkenv.scenarios.spec import scenario_spec
from parkenv.show.tables import plural
from parkenv.studies.compare.comparison import CaseStudy, Comparison
from parkenv.studies.fields import MAX_EPISODES, CaptureDistance, Detector, OneScenario, Seed
from parkenv.studies.results import EPISODES, Results, Row, Table, fingerprints, flat_tables
from parkenv.studies.sensing.sessions import MAP_FILE, SESSIONS
from parkenv.studies.sensing.survey_study import PICTURES, SHOWN, SurveyStudy
from parkenv.studies.study import Cell, ReplayJob, ReportOptions, Stage, run_tasks
from parkenv.studies.workers import Task
from parkenv.version import __version__
from parkenv.world.occupancy.arrival_window import DAY_NAMES
from parkenv.world.sensor_model import SensorModel

if TYPE_CHECKING:
    from parkenv.mapping.inference import SessionLog
    from parkenv.mapping.survey import SessionResult, SurveySettings
    from parkenv.world.scenario import Scenario

AGENTS = ("mdp", "belief", "first-free", "greedy-drive", "oracle")
FILMED = "belief"
FILM, LOT = "search.gif", "lot.png"
# What is added to the name of the scenario in searches with the error rates of the sensors.
WITHOUT_IMAGES = " without images"
FIGURES = ("time_split", "time_distribution")  # names of figures of comparisons
QUICK = {"sessions": 2, "episodes": 2, "more": 100, "every": 4.0}  # settings of a shorter demo
RIG: RigName = "laser"
_HOURS = ("08:00-09:30", "09:30-11:00", "11:00-12:30", "12:30-13:00")
_ONE_CAPTURE_M = 1e6  # between captures, of a short survey
_APART = 1_000_000  # offset between the seeds of survey and searches, so that their worlds differ


class _RecordedSurvey(SurveyStudy):
    doing: ClassVar = "1/3 survey drives"

    def drive(self, number: int) -> tuple[SessionResult, Any]:
        from parkenv.show.report.drive_recording import record_drive

        return record_drive(self.survey, number, PICTURES) if number == 0 else super().drive(number)


class Demo(CaseStudy):
    """1. Survey: a car with a side camera and a laser passes every slot; parked cars are detected, located and mapped.

    2. Map: the probability that each slot is taken at the hour of the search, from these sessions only.

    3. Searches on other days, with camera, laser and detector: the thesis's planner, the planner in belief space and
    two heuristic baselines, all with the same map, in the same worlds; and an oracle that knows every slot's future.
    Many more searches follow without images, with the error rates of the sensors: enough to separate the agents.

    4. A report with replays, and a film of one search.
    """

    block: ClassVar = 1
    heading: ClassVar = "From a survey to a search"
    table_titles: ClassVar = {"rows": "Searches with simulated sensors"}
    further_tables: ClassVar[tuple[Table, ...]] = (SESSIONS,)
    writes: ClassVar = "everything"
    examples: ClassVar = """
        parkenv demo
        parkenv demo --quick --out results/quick
        """

    kind: Literal["demo"] = "demo"
    scenario: Annotated[OneScenario, Inside(only=())] = scenario_spec("campus")
    sessions: int = option(3, "Survey drives.", ge=1, le=100_000)
    episodes: int = option(
        4, "Searches of each agent through the sensors.", short="-n", ge=2, le=MAX_EPISODES
    )
    more: int = option(
        200,
        "Further searches of each agent, enough to separate agents: with the sensors' error "
        "rates, without images.",
        ge=0,
        le=MAX_EPISODES,
    )
    every: CaptureDistance = option(
        4.0, "Metres between captures, in the survey and in the searches.", takes="M", panel="Sensors"
    )
    detector: Detector = None
    seed: Seed = Field(0, description="Seed of drives and searches.")

    @cached_property
    def survey(self) -> SurveyStudy:
        return _RecordedSurvey(
            scenario=self.scenario,
            sessions=self.sessions,
            rig=RIG,
            hours=_HOURS,
            every=self.every,
            seed=self.seed,
            detector=self.detector,
        )

    def check(self) -> None:
        self.survey.check()

    def settings(self) -> Row:
        from parkenv.perception.detector_registry import detector_version

        varied = {"jobs", "backend", "address", "episodes", "more"}
        return {
            "version": __version__,
            **flat_tables(self.model_dump(mode="json", exclude=varied)),
            "files": fingerprints(self.files()),
            "detector": detector_version(self.detector or self.scenario.detector),
        }

    def prepare(self, results: Results, *, continues: bool) -> None:
        from parkenv.show.figures.lot import save_lot_picture

        self.survey.prepare(results, continues=continues)
        save_lot_picture(self.survey.built.lot, results.path / LOT)
        results.progress(f"The lot: {results.path / LOT}", 1, 1)

    def stages(self, results: Results) -> Iterator[Stage]:
        first: list[Task[object]] = [partial(_short_survey, self.survey.drive_settings), _short_searches]
        run_tasks("Compiling, once per installation", first, results.workers, results.progress)
        yield from self.survey.stages(results)
        yield Stage("2/3 searches through the sensors", self, self.cases_in(results.path))
        yield Stage("3/3 searches without images", self, self.more_cases_in(results.path))

    def cases_in(self, folder: Path) -> list[Cell]:
        return self._cases_of(folder, "", self.episodes, rig=RIG, detector=self.detector, every=self.every)

    def more_cases_in(self, folder: Path) -> list[Cell]:
        return self._cases_of(folder, WITHOUT_IMAGES, self.more)

    def _cases_of(self, folder: Path, ending: str, episodes: int, **sensors: Any) -> list[Cell]:
        from parkenv.mapping.learned_map import map_prior
        from parkenv.studies.compare.cases import Case

        scenario = self.survey.built
        prior = map_prior(self._log(folder), (), scenario.lot.walk_m(scenario.goal))
        known = scenario.replace(
            name=scenario.name + ending, prior=prior, sensor_model=SensorModel.named(RIG)
        )
        begin = self.seed + _APART * (2 if ending else 1)
        cases = [Case(known, name, **({} if name == "oracle" else sensors)) for name in AGENTS]
        return [Cell(case, range(begin, begin + episodes)) for case in cases]

    def _log(self, folder: Path) -> SessionLog:
        from parkenv.mapping.store import MapStore

        with MapStore(folder / MAP_FILE, self.survey.built.lot, create=False) as store:
            return store.log()

    def summarise(self, results: Results) -> Row:
        from parkenv.studies.compare.cases import table

        episodes = results.rows(EPISODES)
        surveyed = self.survey.summarise(results)["rows"]
        return {
            "rows": table([*self.cases_in(results.path), *self.more_cases_in(results.path)], episodes)
            if episodes
            else [],
            "survey": surveyed[0] if surveyed else None,
        }

    def outputs(self, results: Results, summary: Row) -> list[Task[object]]:
        from parkenv.show.figures.survey import save_detections, save_session
        from parkenv.studies.compare.figures import ComparisonResults, draw_figures
        from parkenv.studies.compare.search_film import film_search

        folder, scenario = results.path, self.survey.built
        cells = self.cases_in(folder)
        filmed = next(case for case, _ in cells if case.agent == FILMED)
        drawn = self.more_cases_in(folder) if self.more else cells
        shown = [row for row in summary["rows"] if row["scenario"] == drawn[0].work.scenario.name]
        data = ComparisonResults(drawn, results.rows(EPISODES), shown)
        tasks: list[Task[object]] = [
            partial(film_search, filmed, cells[0].items[0], folder / FILM),
            partial(_draw_map, scenario, self._log(folder), self.sessions, folder / "map.png"),
            partial(draw_figures, data, folder, FIGURES),
        ]
        if (kept := results.kept.get(SHOWN)) is not None:
            tasks += [
                partial(save_detections, kept[0], folder / "detections.png"),
                partial(save_session, scenario.lot, kept[0], folder / "session.png"),
            ]
        return tasks

    @classmethod
    def findings(cls, summary: Row) -> list[str]:
        return [*SurveyStudy.findings({"rows": [summary["survey"]]}), *Comparison.findings(summary)]

    @classmethod
    def page_tables(cls, summary: Row, folder: Path) -> list[Row]:
        surveyed = SurveyStudy.page_tables({"rows": [summary["survey"]]}, folder)
        return [*super().page_tables(summary, folder), *surveyed]

    def replays(self, folder: Path, options: ReportOptions) -> Sequence[ReplayJob]:
        from parkenv.studies.compare.search_replay import search_replay

        return [search_replay(self.cases_in(folder), folder, options), *self.survey.replays(folder, options)]


def _short_survey(settings: SurveySettings) -> None:
    from parkenv.mapping.survey import Survey

    Survey(_small_scenario(), replace(settings, every=_ONE_CAPTURE_M, weather="sunny")).drive(0)


def _short_searches() -> None:
    from parkenv.studies.compare.cases import Case

    # With errors of the sensors, as in the searches of the demo: another function steps without them.
    scenario = _small_scenario().replace(sensor_model=SensorModel.named(RIG))
    for name in AGENTS:
        Case(scenario, name).run([0])


def _small_scenario() -> Scenario:
    from parkenv.scenarios.build import make_scenario
    from parkenv.world.traffic import Traffic

    return make_scenario("mini", traffic=Traffic(cars=2, pedestrians=2))


def _draw_map(scenario: Scenario, log: SessionLog, sessions: int, path: Path) -> None:
    from parkenv.studies.sensing.surveys import draw_map

    shown = replace(scenario.arrival, weekdays=scenario.arrival.weekdays[:2][-1:])
    hour, minute = divmod(int(0.5 * (shown.start_s + shown.end_s) // 60), 60)
    time = f"{DAY_NAMES[shown.weekdays[0]]} {hour:02d}:{minute:02d}"
    draw_map(scenario, log, shown, f"{scenario.name}, {time}, {plural(sessions, 'session')}", path)
