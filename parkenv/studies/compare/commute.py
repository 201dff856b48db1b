"""Commute: drivers come day after day, and their map learns from every trip.

A course is one driver, or a fleet whose drivers share a map, over all days. Every day is a new day of the world; the
trips of a day go into the map in the evening. All agents and maps meet the same worlds.
"""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from parkenv import __version__
from parkenv.compiled.keyed_random import world_key
from parkenv.errors import InputError
from parkenv.files.file_names import file_name
from parkenv.mapping.learned_map import GIVEN_MAP, NO_MAP, EmptyMap, LearnedMap, ReversedMap
from parkenv.mapping.store import MapStore
from parkenv.mapping.trips import Trip
from parkenv.scenarios.build import build
from parkenv.studies.agent_spec import AgentSpec, label_of
from parkenv.studies.compare.experiment import spec_fingerprint
from parkenv.studies.episodes import EpisodeRunner
from parkenv.studies.results import OUTCOME_COLUMNS, EpisodeTable, ResultFolder, Row
from parkenv.studies.spec import SPEC_FILE, CommuteSpec
from parkenv.studies.statistics import mean_interval, trimmed_mean_interval
from parkenv.studies.trip_recorder import TripRecorder
from parkenv.studies.workers import HERE, Workers
from parkenv.world.occupancy.constant_map import FlatMap
from parkenv.world.occupancy.counted import CountedOccupancy
from parkenv.world.occupancy.process import ArrivalWindow, PriorModel
from parkenv.world.occupancy.recorded import RecordedOccupancy
from parkenv.world.scenario import Scenario
from parkenv.world.week import DAY_S
from planners.agent import make_agent, shown_name
from planners.names import WITHOUT_FORECAST

FIXED, NONE = "fixed", "none"
"""Names in the column `map` of the references: a right map that does not learn; an agent that uses no map."""
KEYS = ("scenario", "map", "agent", "course", "day_number", "driver")
TABLE = EpisodeTable(keys=KEYS, columns=("seed", *OUTCOME_COLUMNS, "forecast_error"))
MAPS_FOLDER = "maps"
BLOCK_DAYS = 10
"""Days per task: an interruption loses few of them, and the map of a course is seldom rebuilt from its trips."""
TRIMMED = 0.1
"""Share of the courses, at either end, that a robust mean leaves out."""
_COURSES_APART, _DRIVERS_APART = 1_000_000, 1_000
_MOST_TRIES = 100_000


@dataclass(frozen=True)
class Day:
    """A day of a commute."""

    number: int  # 1, 2, ...
    count: int  # days since the first Monday
    date: str  # ISO date of a recorded day; else empty


def calendar(scenario: Scenario, days: int) -> list[Day]:
    """Return the days on which drivers come: the next weekdays, or the recorded days, of the scenario's arrivals.

    A log with fewer days than wanted ends the commute early.
    """
    occupancy, window = scenario.occupancy, scenario.arrival
    if isinstance(occupancy, RecordedOccupancy | CountedOccupancy):
        dates = sorted(occupancy.days_in(window))[:days]
        counts = [date.fromisoformat(day).toordinal() for day in dates]
        first_monday = counts[0] - date.fromisoformat(dates[0]).weekday()
        return [
            Day(i + 1, count - first_monday, day)
            for i, (count, day) in enumerate(zip(counts, dates, strict=True))
        ]
    weekdays = sorted(window.weekdays)
    return [Day(i + 1, 7 * (i // len(weekdays)) + weekdays[i % len(weekdays)], "") for i in range(days)]


@dataclass(frozen=True, eq=False)
class Course:
    """One driver, or a fleet that shares a map, with one agent and one map to start from.

    Args:
        scenario: the scenario.
        agent: the agent.
        map: empty, right, wrong, `FIXED` or `NONE`.
        number: number of the repetition, from 0.
        fleet: number of drivers.
        seed: seed of the commute.
    """

    scenario: Scenario
    agent: AgentSpec
    map: str
    number: int
    fleet: int
    seed: int

    @property
    def learns(self) -> bool:
        """Whether trips go into a map."""
        return self.map not in (FIXED, NONE)

    @property
    def columns(self) -> Row:
        """Columns that identify the course."""
        label = label_of(shown_name(self.agent.name), self.agent.options)
        return {"scenario": self.scenario.name, "map": self.map, "agent": label, "course": self.number}

    def keys(self, day: Day) -> list[tuple[Any, ...]]:
        """Return the keys of a day's episodes in the result folder."""
        return [(*self.columns.values(), day.number, driver) for driver in range(self.fleet)]

    def start_map(self) -> PriorModel:
        """Return the map before any trip."""
        scenario = self.scenario
        walk = scenario.lot.walk_m(scenario.goal)
        match self.map:
            case "empty":
                return LearnedMap(EmptyMap(scenario.lot.n_slots), walk, NO_MAP)
            case "right":
                return LearnedMap(scenario.occupancy, walk, GIVEN_MAP)
            case "wrong":
                return LearnedMap(scenario.prior or ReversedMap(scenario.occupancy, walk), walk, GIVEN_MAP)
        return scenario.occupancy

    def run(
        self, days: Sequence[Day], before: Sequence[Trip]
    ) -> tuple[list[Row], list[Row], list[Trip], list[str]]:
        """Run some days.

        Args:
            days: the days, in order.
            before: all trips of the days before.

        Returns:
            Rows of `episodes.csv` and of `timings.csv`, the trips of these days, and warnings.
        """
        rows: list[Row] = []
        timings: list[Row] = []
        made: list[Trip] = []
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("default")
            known = self.start_map()
            agent = make_agent(self.agent.name, self.scenario, **self.agent.options)
            if isinstance(known, LearnedMap):
                known.learn(before)
            for day in days:
                if isinstance(known, LearnedMap):
                    known.pass_time(day.count)
                trips = []
                for driver in range(self.fleet):
                    scenario, seed = self._search(day, driver, known)
                    recorder = TripRecorder()
                    runner = EpisodeRunner(scenario, self.columns["agent"], agent)
                    episode = runner.run(seed, (recorder,))
                    error = episode.trace.forecast - episode.trace.occupied
                    key = {**self.columns, "day_number": day.number, "driver": driver}
                    rows.append(
                        {
                            **key,
                            **episode.row,
                            "forecast_error": None if self.map == NONE else float(np.mean(error**2)),
                        }
                    )
                    microseconds = " ".join(str(round(1e6 * s)) for s in episode.decision_s)
                    timings.append({**key, "decisions_us": microseconds})
                    time = day.count * DAY_S + scenario.arrival.start_s
                    trips.append(recorder.trip(f"{day.number:05}-{driver:04}", time, day.date))
                if isinstance(known, LearnedMap):
                    trips.sort(key=lambda trip: (trip.time, trip.key))
                    known.learn(trips)
                    made += trips
        return (
            rows,
            timings,
            made,
            [f"{self.agent.label} in {self.scenario.name}: {w.message}" for w in caught],
        )

    def _search(self, day: Day, driver: int, known: PriorModel) -> tuple[Scenario, int]:
        """Return the scenario of a driver's search, at the same time every day, and the seed of the day's world."""
        scenario = self.scenario
        first = self.seed + self.number * _COURSES_APART
        second = scenario.arrival.draw_second(world_key(first, 1 + driver))
        window = ArrivalWindow((day.count % 7,), second, second)
        scenario = scenario.replace(arrival=window, prior=known)
        # All drivers of a fleet meet the same day. A log draws one of its days, so take a seed that draws this one.
        seeds = range(first + day.number * _DRIVERS_APART, first + day.number * _DRIVERS_APART + _MOST_TRIES)
        for seed in seeds:
            if scenario.occupancy.draw_arrival(window, world_key(seed, 0)).day == day.date:
                return scenario, seed
        raise InputError(
            f"scenario {scenario.name!r}: no world of {day.date or 'a day'} in {_MOST_TRIES} seeds"
        )


@dataclass(frozen=True, eq=False)
class Commute:
    """A commute with its scenarios made and its agents checked.

    Raises:
        InputError: a scenario or an agent cannot be made.
    """

    spec: CommuteSpec
    _scenarios: list[Scenario] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "_scenarios", [_with_fixed_slots(build(spec)) for spec in self.spec.scenarios]
        )
        for scenario in self._scenarios:
            for agent in self.spec.agents:
                make_agent(agent.name, scenario, **agent.options)
        labels = [tuple(course.columns.values()) for course in self.courses]
        if repeated := [label for label, count in _counted(labels).items() if count > 1]:
            raise InputError(f"two agents are called {repeated[0][2]!r}, want different names")
        for course in self.courses[:: self.spec.drivers]:
            course.start_map()

    @cached_property
    def courses(self) -> list[Course]:
        """All courses: every agent with every map, and the references."""
        spec = self.spec
        return [
            Course(scenario, agent, name, number, spec.fleet, spec.seed)
            for scenario in self._scenarios
            for agent in spec.agents
            for name in ((NONE,) if agent.name in WITHOUT_FORECAST else (*spec.maps, FIXED))
            for number in range(spec.drivers)
        ]

    @cached_property
    def calendars(self) -> dict[str, list[Day]]:
        """The days of each scenario, by its name."""
        return {scenario.name: calendar(scenario, self.spec.days) for scenario in self._scenarios}

    def fingerprint(self) -> Row:
        """Return everything that affects the outcome of a day; a resumed run must have the same settings."""
        return {**spec_fingerprint(self.spec), "seed": self.spec.seed, "fleet": self.spec.fleet}


def _with_fixed_slots(scenario: Scenario) -> Scenario:
    """Return a scenario in which every slot is the same one on all days of a log."""
    occupancy, prior = scenario.occupancy, scenario.prior
    if not isinstance(occupancy, RecordedOccupancy):
        return scenario
    fixed = occupancy.with_fixed_slots(scenario.arrival)
    if isinstance(prior, FlatMap):
        prior = FlatMap(prior.p_occupied, fixed)
    return scenario.replace(occupancy=fixed, prior=prior)


@dataclass(frozen=True, eq=False)
class CommuteResult:
    """Result of a commute."""

    rows: list[Row]  # one row per scenario, map, agent and day, as in `summary.json`
    weeks: list[Row]  # the same by week, with the difference to the first agent that uses no map
    complete: bool  # whether all days are finished


def run_commute(
    spec: CommuteSpec,
    out: Path,
    *,
    command: Iterable[str] = (),
    resume: bool = False,
    overwrite: bool = False,
    workers: Workers = HERE,
    on_start: Callable[[int], None] = lambda _: None,
    on_progress: Callable[[int], None] = lambda _: None,
) -> CommuteResult:
    """Run a commute, and write its results; skip days that the folder already holds.

    The folder gets the specification (`experiment.json`), every search (`episodes.csv`), the map of every course
    (`maps/*.sqlite`), and the tables (`summary.json`). Ctrl-C stops the run; finished days stay in the folder.

    Args:
        spec: specification of the commute.
        out: result folder.
        command: command line to record in the summary.
        resume: continue an earlier run.
        overwrite: replace the results of another run.
        workers: where searches run; results do not depend on it.
        on_start: called with the number of searches before the first one starts.
        on_progress: called with the number of searches just finished.

    Raises:
        InputError: a scenario or an agent cannot be made, or the folder cannot be used.
    """
    commute = Commute(spec)
    with workers:
        folder = ResultFolder(
            out, commute.fingerprint(), table=TABLE, kind="commute", resume=resume, overwrite=overwrite
        )
        maps = out / MAPS_FOLDER
        maps.mkdir(exist_ok=True)
        if not resume:
            for old in maps.glob("*.sqlite"):
                old.unlink()
        spec.write(out / SPEC_FILE)
        days = commute.calendars
        on_start(sum(len(days[course.scenario.name]) * spec.fleet for course in commute.courses))
        try:
            for block in range(-(-spec.days // BLOCK_DAYS)):
                part = slice(block * BLOCK_DAYS, (block + 1) * BLOCK_DAYS)
                _run_block(commute, part, folder, maps, workers, on_progress)
            complete = True
        except KeyboardInterrupt:
            complete = False
    order = [k for course in commute.courses for day in days[course.scenario.name] for k in course.keys(day)]
    episodes = [folder.episodes[key] for key in order if key in folder.episodes]
    result = CommuteResult(day_rows(episodes), week_rows(episodes), complete)
    summary = {
        "command": list(command),
        "version": __version__,
        "seed": spec.seed,
        "complete": complete,
        "rows": result.rows,
        "weeks": result.weeks,
    }
    folder.finish(order, summary, complete=complete)
    return result


def _run_block(
    commute: Commute,
    part: slice,
    folder: ResultFolder,
    maps: Path,
    workers: Workers,
    on_progress: Callable[[int], None],
) -> None:
    """Run some days of every course, and write their trips and episodes."""
    tasks, courses = [], []
    for course in commute.courses:
        its = commute.calendars[course.scenario.name]
        missing = [day for day in its[part] if any(key not in folder.episodes for key in course.keys(day))]
        on_progress((len(its[part]) - len(missing)) * course.fleet)
        if not missing:
            continue
        before: list[Trip] = []
        if course.learns:
            with MapStore(_map_file(maps, course), course.scenario.lot) as store:
                before = [trip for trip in store.trips() if trip.time < missing[0].count * DAY_S]
        tasks.append(partial(course.run, missing, before))
        courses.append(course)
    told = set()
    for number, (rows, timings, trips, messages) in workers.results(tasks):
        if trips:
            # Trips before episodes: a day in `episodes.csv` is finished, and would not run again for its trips.
            with MapStore(_map_file(maps, courses[number]), courses[number].scenario.lot) as store:
                for trip in trips:
                    if not store.has_trip(trip.key):
                        store.add_trip(trip)
        folder.add(rows, timings)
        on_progress(len(rows))
        for message in messages:
            if (topic := message.partition(":")[0]) not in told:
                told.add(topic)
                warnings.warn(message, stacklevel=2)


def _map_file(maps: Path, course: Course) -> Path:
    return maps / file_name("_".join(str(value) for value in course.columns.values()), ".sqlite")


def day_rows(episodes: Sequence[Row]) -> list[Row]:
    """Return a row per scenario, map, agent and day: mean total time and forecast error, with 95 % intervals.

    The forecast error is the Brier score of the forecast at the arrival: the mean squared difference of P(taken) and
    the true state, over slots. The excess is the time beyond that of the first agent with the right map, which does not
    learn, in the same worlds: a 10 % trimmed mean, since a full lot may add the give-up penalty to one of the two.
    Intervals are over courses: a fleet's drivers meet the same day.
    """
    cases = _grouped(episodes, lambda row: row["day_number"])
    return [
        {
            **dict(zip(("scenario", "map", "agent"), case, strict=True)),
            "day": day,
            "courses": len(by_course),
            **_mean("total_s", its),
            **_mean("forecast_error", its),
            **_difference("excess_s", by_course, _reference(cases, case[0], FIXED).get(day, {}), _robust),
        }
        for case, by_day in cases.items()
        for day, by_course in sorted(by_day.items())
        for its in [list(by_course.values())]
    ]


def week_rows(episodes: Sequence[Row]) -> list[Row]:
    """Return a row per scenario, map, agent and five days, with the paired difference to the first agent without a map.

    The difference is paired by course: the same driver on the same days.
    """
    cases = _grouped(episodes, lambda row: (row["day_number"] - 1) // 5 + 1)
    last = max((row["day_number"] for row in episodes), default=0)
    return [
        {
            **dict(zip(("scenario", "map", "agent"), case, strict=True)),
            "days": f"{5 * week - 4}-{min(5 * week, last)}",
            "courses": len(by_course),
            **_mean("total_s", its),
            **_mean("forecast_error", its),
            **_difference("difference_s", by_course, _reference(cases, case[0], NONE).get(week, {})),
            **_difference("excess_s", by_course, _reference(cases, case[0], FIXED).get(week, {}), _robust),
        }
        for case, by_week in cases.items()
        for week, by_course in sorted(by_week.items())
        for its in [list(by_course.values())]
    ]


_Courses = dict[int, list[Row]]
_Cases = dict[tuple[str, str, str], dict[int, _Courses]]


def _reference(cases: _Cases, scenario: str, map: str) -> dict[int, _Courses]:
    """Return the first agent with a map in a scenario, by period."""
    return next((its for case, its in cases.items() if case[0] == scenario and case[1] == map), {})


def _difference(
    name: str,
    courses: _Courses,
    reference: _Courses,
    interval: Callable[[Sequence[float]], tuple[float, float, float]] = mean_interval,
) -> Row:
    paired = [
        _course_mean("total_s", its) - _course_mean("total_s", reference[course])
        for course, its in courses.items()
        if len(reference.get(course, ())) == len(its)
    ]
    if not paired:
        return {}
    mean, low, high = interval(paired)
    return {name: mean, f"{name}_ci95": [low, high]}


def _grouped(episodes: Sequence[Row], period: Callable[[Row], int]) -> _Cases:
    """Group episodes by scenario, map and agent; then by period; then by course."""
    found: dict[Any, Any] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for row in episodes:
        found[row["scenario"], row["map"], row["agent"]][period(row)][row["course"]].append(row)
    return found


def _course_mean(name: str, episodes: Sequence[Mapping[str, Any]]) -> float:
    return float(np.mean([np.nan if row[name] is None else row[name] for row in episodes]))


def _robust(values: Sequence[float]) -> tuple[float, float, float]:
    return trimmed_mean_interval(values, TRIMMED)


def _mean(name: str, courses: Iterable[Sequence[Row]]) -> Row:
    means = [_course_mean(name, its) for its in courses]
    # Agents without a map have no forecast error.
    mean, low, high = mean_interval(means) if np.isfinite(means).all() else (np.nan,) * 3
    return {name: mean, f"{name}_ci95": [low, high]}


def _counted(labels: Iterable[Any]) -> dict[Any, int]:
    counts: dict[Any, int] = defaultdict(int)
    for label in labels:
        counts[label] += 1
    return counts
