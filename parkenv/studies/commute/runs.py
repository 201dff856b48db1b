"""Runs of a commute: drivers come day after day, and their map learns from every trip.

A run is one driver, or a fleet whose drivers share a map, over all days. Every day is a new day of the world; the
trips of a day go into the map in the evening. All agents and maps meet the same worlds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np

from parkenv.compiled.keyed_random import world_key
from parkenv.errors import InputError
from parkenv.files.file_names import file_name
from parkenv.mapping.learned_map import GIVEN_MAP, NO_MAP, EmptyMap, LearnedMap, ReversedMap
from parkenv.mapping.trips import Trip
from parkenv.studies.agent_spec import AgentSpec, label_of
from parkenv.studies.commute.tables import FIXED, NONE
from parkenv.studies.episodes import EpisodeRunner, TripRecorder
from parkenv.studies.results import Row, timed_row
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.process import PriorModel
from parkenv.world.scenario import Scenario
from parkenv.world.week import DAY_S
from planners.agent import make_agent, shown_name

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
    """Return the days on which drivers come: the next weekdays, or the recorded days, of the scenario's arrivals.

    A log with fewer days than wanted ends the commute early.
    """
    occupancy, window = scenario.occupancy, scenario.arrival
    if occupancy.recorded:
        dates = sorted(occupancy.days_in(window))[:days]
        counts = [date.fromisoformat(day).toordinal() for day in dates]
        first_monday = counts[0] - date.fromisoformat(dates[0]).weekday()
        return [
            Day(i + 1, count - first_monday, day)
            for i, (count, day) in enumerate(zip(counts, dates, strict=True))
        ]
    weekdays = sorted(window.weekdays)
    return [Day(i + 1, 7 * (i // len(weekdays)) + weekdays[i % len(weekdays)], "") for i in range(days)]


def map_file(folder: Path, run: CommuteRun) -> Path:
    return folder / MAPS_FOLDER / file_name("_".join(str(value) for value in run.columns.values()), ".sqlite")


@dataclass(frozen=True, eq=False)
class CommuteRun:
    """One driver, or a fleet that shares a map, with one agent and one map to start from."""

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
        return {
            "scenario": self.scenario.name, "map": self.map, "agent": self.label, "course": self.number,
        }  # fmt: skip

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
        """Run some days, in order; return a row for each search, with its trip under `TRIP` if trips go into a map."""
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
                error = record.forecast - record.occupied
                time = day.count * DAY_S + scenario.arrival.start_s
                trips.append(recorder.trip(f"{day.number:05}-{driver:04}", time, day.date))
                rows.append(
                    {
                        **self.columns,
                        "day_number": day.number,
                        "driver": driver,
                        **timed_row(record),
                        "forecast_error": None if self.map == NONE else float(np.mean(error**2)),
                        TRIP: trips[-1] if self.learns else None,
                    }
                )
            if isinstance(known, LearnedMap):
                trips.sort(key=lambda trip: (trip.time, trip.key))
                known.learn(trips)
        return rows

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


def with_fixed_slots(scenario: Scenario) -> Scenario:
    """Return a scenario in which every slot is the same one on all days of a log."""
    fixed = scenario.occupancy.with_fixed_slots(scenario.arrival)
    return scenario.replace(occupancy=fixed, prior=scenario.prior and scenario.prior.for_world(fixed))
