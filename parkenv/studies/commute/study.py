"""Commutes: drivers come day after day, with a map that learns from their trips."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from parkenv.errors import require
from parkenv.files.known_names import FIXED, NONE, MapName
from parkenv.files.option import option
from parkenv.files.spec_file import Axis
from parkenv.scenarios.spec import scenario_spec
from parkenv.show.tables import Column, shared, spread, table_of
from parkenv.studies.fields import (
    Agents,
    AgentSpec,
    Figures,
    Scenarios,
    Seed,
    listed,
    require_agents,
    require_at_most,
    require_distinct_names,
)
from parkenv.studies.results import EPISODES, OUTCOME_COLUMNS, Key, Results, Row, Table, search_settings
from parkenv.studies.study import Cell, Stage, Study
from parkenv.studies.workers import Task
from planners.names import WITHOUT_FORECAST

if TYPE_CHECKING:
    from parkenv.studies.commute.runs import CommuteRun, Day
    from parkenv.world.scenario import Scenario

MAX_DAYS = 3_650  # maximum number of days of a commute
PICTURE = "commute.png"


class Commute(Study):
    """Each driver comes at the same time of day, on the next of the scenario's weekdays or recorded days.

    In the evening, the observations of the search update the driver's map, with the sensor's error rates, and correct
    the next day's forecast. The map gets no other data.

    The table and the figure show mean total time and forecast error (Brier score of P(taken) at the arrival, over all
    slots) against the day. For comparison, each agent also drives with the right map without learning (fixed); agents
    without a map (first-free, greedy-drive, ...) have one level. All run in the same worlds.
    """

    table: ClassVar = Table(
        "episodes.csv",
        keys=("scenario", "map", "agent", "course", "day_number", "driver"),
        columns=("seed", *OUTCOME_COLUMNS, "forecast_error"),
        lists=EPISODES.lists,
    )
    doing: ClassVar = "Driving"
    unit: ClassVar = "searches"
    heading: ClassVar = "Maps that learn from every trip"
    table_titles: ClassVar = {"rows": "Results", "weeks": "By five days"}
    columns: ClassVar = (
        *shared("scenario"),
        Column(
            "map",
            "map at first",
            help="fixed: right, does not learn; none: the agent uses no map",
            setting=True,
        ),
        *shared("agent", "total_s", "difference_s"),
        Column("day", "day", digits=0),
        Column("days", "days", setting=True),
        Column("courses", "drivers", digits=0),
        Column("forecast_error", "forecast error", digits=3, help="Brier score of P(taken) at the arrival"),
    )
    writes: ClassVar = "experiment.json, episodes.csv, summary.json, commute.png and the maps"
    examples: ClassVar = """
        parkenv commute --scenario jam --map wrong
        parkenv commute --scenario campus,jam --map empty,wrong --days 20
        parkenv commute --agents belief,first-free --drivers 100
        parkenv commute --fleet 5 --map empty
        parkenv commute --resume --days 60
        """

    kind: Literal["commute"] = "commute"
    agents: Agents = Field(
        tuple(AgentSpec(name=name) for name in ("belief", "mdp", "first-free", "greedy-drive")),
        description="Agents, with any options in brackets; differences in `weeks` of summary.json are to the "
        "first agent without a map.",
    )
    scenarios: Scenarios = (scenario_spec("campus"),)
    maps: Annotated[Axis[MapName], BeforeValidator(listed)] = option(
        ("empty",),
        "The map on the first day. empty: 50 % for every slot. right: the forecast of the "
        "scenario's occupancy. wrong: the scenario's own forecast if it differs from that (jam), "
        "else the right one with near and far slots exchanged.",
        name="--map",
    )
    days: int = option(
        30, "Number of days of each driver, at most those of a recorded log.", ge=1, le=MAX_DAYS
    )
    drivers: int = option(
        40,
        "Number of drivers (or fleets), each with a separate map; more drivers give narrower intervals.",
        ge=1,
        le=100_000,
    )
    fleet: int = option(1, "Number of daily drivers who share a map.", ge=1, le=1_000)
    seed: Seed = Field(0, description="Seed of days and drivers.")
    figures: Figures = True

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        require_distinct_names(self.agents, self.scenarios)
        axes = self.agents, self.scenarios, (*self.maps, "fixed")
        count = math.prod(map(len, axes)) * self.days * self.drivers * self.fleet
        require_at_most(count, "agents x scenarios x maps x days x drivers", "searches")
        return self

    @cached_property
    def built(self) -> list[Scenario]:
        from parkenv.scenarios.build import build
        from parkenv.studies.commute.runs import with_fixed_slots

        return [with_fixed_slots(build(spec)) for spec in self.scenarios]

    @cached_property
    def runs(self) -> list[CommuteRun]:
        from parkenv.studies.commute.runs import CommuteRun

        return [
            CommuteRun(scenario, agent, name, number, self.fleet, self.seed)
            for scenario in self.built
            for agent in self.agents
            for name in ((NONE,) if agent.name in WITHOUT_FORECAST else (*self.maps, FIXED))
            for number in range(self.drivers)
        ]

    @cached_property
    def calendars(self) -> dict[str, list[Day]]:
        from parkenv.studies.commute.runs import calendar

        return {scenario.name: calendar(scenario, self.days) for scenario in self.built}

    def check(self) -> None:
        require_agents(self.agents, self.built)
        name, count = Counter(tuple(run.columns.values()) for run in self.runs).most_common(1)[0]
        require(count <= 1, f"two agents are called {name[2]!r}, want different names")
        for run in self.runs[:: self.drivers]:
            run.start_map()

    def settings(self) -> Row:

        return search_settings(self, "seed", "fleet")

    def cells(self) -> list[Cell]:
        return [Cell(run, self.calendars[run.scenario.name]) for run in self.runs]

    def keys(self, work: CommuteRun, item: Day) -> list[Key]:
        return [(*work.columns.values(), item.number, driver) for driver in range(work.fleet)]

    def label(self, work: CommuteRun) -> str:
        return f"{work.agent.label} in {work.scenario.name}"

    def stages(self, results: Results) -> Iterator[Stage]:
        from parkenv.studies.commute.runs import open_map

        # A block of days needs the maps of the days before.
        for first in range(0, self.days, self.block):
            doing = f"{self.doing}, days {first + 1} to {min(first + self.block, self.days)}"
            cells = []
            for run, days in self.cells():
                if run.learns:
                    with open_map(results.path, run) as store:
                        run = replace(run, before=store.trips())
                cells.append(Cell(run, days[first : first + self.block]))
            yield Stage(doing, self, cells)

    def run(self, work: CommuteRun, items: Sequence[Day]) -> list[Row]:
        return work.run(items)

    def save_artifacts(self, work: CommuteRun, rows: Sequence[Row], results: Results) -> None:
        from parkenv.studies.commute.runs import TRIP, open_map

        trips = [trip for row in rows if (trip := row.pop(TRIP)) is not None]
        if trips:
            with open_map(results.path, work) as store:
                for trip in sorted(trips, key=lambda trip: (trip.time, trip.key)):
                    if not store.has_trip(trip.key):
                        store.add_trip(trip)

    def prepare(self, results: Results, *, continues: bool) -> None:
        from parkenv.studies.commute.runs import MAPS_FOLDER

        maps = results.path / MAPS_FOLDER
        maps.mkdir(exist_ok=True)
        for old in () if continues else maps.glob("*.sqlite"):
            old.unlink()

    def summarise(self, results: Results) -> Row:
        from parkenv.studies.commute.runs import day_rows, week_rows

        episodes = [row for cell in self.cells() for row in self.rows_of(cell, results)]
        return {"rows": day_rows(episodes), "weeks": week_rows(episodes)}

    @classmethod
    def printed(cls, summary: Row, folder: Path) -> list[Row]:

        weeks, tables = summary["weeks"], []
        for title, measure, digits in (
            ("Mean total time, s", "total_s", 1),
            ("Forecast error", "forecast_error", 3),
        ):
            days = dict.fromkeys(row["days"] for row in weeks)
            columns = *cls.columns, *(Column(day, f"days {day}", digits=digits) for day in days)
            rows = spread(weeks, ("scenario", "map", "agent"), "days", measure)
            tables.append(table_of("weeks", f"{title}, by days", rows, columns))
        return tables

    def outputs(self, results: Results, summary: Row) -> list[Task[object]]:
        from parkenv.show.figures.times import save_commute_curves

        return [partial(save_commute_curves, summary["rows"], results.path / PICTURE)]
