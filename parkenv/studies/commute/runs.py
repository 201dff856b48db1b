"""Runs of a commute: drivers come day after day, and their map learns from every trip.

A run is one driver, or a fleet whose drivers share a map, over all days. Every day is a new day of the world; the
trips of a day go into the map in the evening. All agents and maps meet the same worlds.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from parkenv.compiled.keyed_random import world_key
from parkenv.errors import InputError
from parkenv.files.file_names import file_name
from parkenv.files.known_names import FIXED, NONE
from parkenv.mapping.learned_map import GIVEN_MAP, NO_MAP, EmptyMap, LearnedMap, ReversedMap
from parkenv.mapping.store import MapStore
from parkenv.mapping.trips import Trip
from parkenv.studies.episodes import EpisodeRunner, TripRecorder
from parkenv.studies.fields import AgentSpec, label_of
from parkenv.studies.results import Row, timed_row
from parkenv.studies.statistics import columns_of, mean_interval, trimmed_mean_interval
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.process import PriorModel
from parkenv.world.scenario import Scenario
from parkenv.world.week import DAY_S
from planners.agent import make_agent, shown_name

_Runs = dict[int, list[Row]]


def day_rows(episodes: Sequence[Row]) -> list[Row]:
    """Return a row per scenario, map, agent and day: mean total time and forecast error, with 95 % intervals.

    The forecast error is the Brier score at the arrival, over slots. The excess is the time beyond that of the first
    agent with the right map, which does not learn: a 10 % trimmed mean, since a full lot may add the give-up penalty to
    one of the two. Intervals are over courses: a fleet's drivers meet the same day.
    """
    return [
        {**case, "day": day, **row, **excess}
        for case, day, row, _, excess in _periods(episodes, lambda row: row["day_number"])
    ]


def week_rows(episodes: Sequence[Row]) -> list[Row]:
    """Return a row per scenario, map, agent and five days, with the paired difference to the first agent without a map.

    The difference is paired by course: the same driver on the same days.
    """
    last = max((row["day_number"] for row in episodes), default=0)
    weeks = _periods(episodes, lambda row: (row["day_number"] - 1) // 5 + 1)
    return [
        {**case, "days": f"{5 * week - 4}-{min(5 * week, last)}", **row, **difference, **excess}
        for case, week, row, difference, excess in weeks
    ]


def _periods(
    episodes: Sequence[Row], period: Callable[[Row], int]
) -> Iterator[tuple[Row, int, Row, Row, Row]]:
    cases: dict[Any, Any] = defaultdict(lambda: defaultdict(lambda: defaultdict(list)))
    for row in episodes:
        cases[row["scenario"], row["map"], row["agent"]][period(row)][row["course"]].append(row)
    for case, by_period in cases.items():
        # The first agents with these maps.
        none, fixed = (
            next((cases[other] for other in cases if other[:2] == (case[0], name)), dict[int, _Runs]())
            for name in (NONE, FIXED)
        )
        columns = dict(zip(("scenario", "map", "agent"), case, strict=True))
        for number, courses in sorted(by_period.items()):
            means = {"courses": len(courses)} | _mean("total_s", courses) | _mean("forecast_error", courses)
            difference = _difference("difference_s", courses, none.get(number, {}), mean_interval)
            robust = partial(trimmed_mean_interval, cut=0.1)
            excess = _difference("excess_s", courses, fixed.get(number, {}), robust)
            yield columns, number, means, difference, excess


def _difference(
    name: str, courses: _Runs, reference: _Runs, interval: Callable[[Sequence[float]], Any]
) -> Row:
    paired = [
        _course_mean("total_s", searches) - _course_mean("total_s", reference[course])
        for course, searches in courses.items()
        if len(reference.get(course, ())) == len(searches)
    ]
    return columns_of(name, interval(paired)) if paired else {}


def _course_mean(name: str, episodes: Sequence[Mapping[str, Any]]) -> float:
    return float(np.mean([np.nan if row[name] is None else row[name] for row in episodes]))


def _mean(name: str, courses: _Runs) -> Row:
    means = [_course_mean(name, searches) for searches in courses.values()]
    # Agents without a map have no forecast error.
    return columns_of(name, mean_interval(means) if np.isfinite(means).all() else (np.nan, np.nan, np.nan))


MAPS_FOLDER = "maps"
_COURSES_APART, _DRIVERS_APART = 1_000_000, 1_000
_MOST_TRIES = 100_000


TRIP = "trip"  # key of a search's trip in a row; the map of the run keeps it


@dataclass(frozen=True)
class Day:
    number: int  # 1, 2, ...
    count: int  # days since the first Monday
    date: str  # ISO date of a recorded day; else empty


def calendar(scenario: Scenario, days: int) -> list[Day]:
    occupancy, window = scenario.occupancy, scenario.arrival
    if occupancy.recorded:
        dates = sorted(occupancy.days_in(window))[:days]
        counts = [date.fromisoformat(day).toordinal() for day in dates]
        first_monday = counts[0] - date.fromisoformat(dates[0]).weekday()
        return [
            Day(i, n - first_monday, day) for i, (n, day) in enumerate(zip(counts, dates, strict=True), 1)
        ]
    weekdays = sorted(window.weekdays)
    return [Day(i + 1, 7 * (i // len(weekdays)) + weekdays[i % len(weekdays)], "") for i in range(days)]


def open_map(folder: Path, run: CommuteRun) -> MapStore:
    name = file_name("_".join(map(str, run.columns.values())), ".sqlite")
    return MapStore(folder / MAPS_FOLDER / name, run.scenario.lot)


@dataclass(frozen=True, eq=False)
class CommuteRun:
    scenario: Scenario
    agent: AgentSpec
    map: str  # empty, right, wrong, `FIXED` or `NONE`
    number: int  # of the repetition, from 0
    fleet: int  # number of drivers
    seed: int
    before: Sequence[Trip] = ()  # all trips so far, of which those of earlier days are known

    @property
    def learns(self) -> bool:
        return self.map not in (FIXED, NONE)

    @property
    def label(self) -> str:
        return label_of(shown_name(self.agent.name), self.agent.options)

    @property
    def columns(self) -> Row:
        return {"scenario": self.scenario.name, "map": self.map, "agent": self.label, "course": self.number}

    def start_map(self) -> PriorModel:
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

    def run(self, days: Sequence[Day]) -> list[Row]:
        rows: list[Row] = []
        known = self.start_map()
        agent = make_agent(self.agent.name, self.scenario, **self.agent.options)
        if isinstance(known, LearnedMap):
            known.learn([trip for trip in self.before if trip.time < days[0].count * DAY_S])
        for day in days:
            if isinstance(known, LearnedMap):
                known.pass_time(day.count)
            trips = []
            for driver in range(self.fleet):
                scenario, seed = self._search(day, driver, known)
                recorder = TripRecorder()
                record = EpisodeRunner(scenario, self.label, agent).run(seed, (recorder,))
                error = float(np.mean((record.forecast - record.occupied) ** 2))
                time = day.count * DAY_S + scenario.arrival.start_s
                trips.append(recorder.trip(f"{day.number:05}-{driver:04}", time, day.date))
                row = {**self.columns, "day_number": day.number, "driver": driver, **timed_row(record)}
                row["forecast_error"] = None if self.map == NONE else error
                rows.append(row | {TRIP: trips[-1] if self.learns else None})
            if isinstance(known, LearnedMap):
                trips.sort(key=lambda trip: (trip.time, trip.key))
                known.learn(trips)
        return rows

    def _search(self, day: Day, driver: int, known: PriorModel) -> tuple[Scenario, int]:
        # A driver comes at the same time every day; the seed is that of the day's world.
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


def with_fixed_slots(scenario: Scenario) -> Scenario:
    # Every slot is the same one on all days of a log.
    fixed = scenario.occupancy.with_fixed_slots(scenario.arrival)
    return scenario.replace(occupancy=fixed, prior=scenario.prior and scenario.prior.for_world(fixed))
