"""Days on which many cars search a lot: lots, agents, knowledge, shares and demand, all on the same days."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import BeforeValidator, model_validator
from pydantic_core import PydanticCustomError

from parkenv.errors import InputError
from parkenv.files.known_names import KNOWLEDGE, KnowledgeName
from parkenv.files.option import option, words_in
from parkenv.files.spec_file import Axis, FilePath
from parkenv.scenarios.spec import Probability, scenario_spec
from parkenv.studies.agent_spec import AgentSpec, split_agents
from parkenv.studies.fields import (
    Agents,
    Figures,
    MeanStay,
    Patience,
    Scenarios,
    Seed,
    Values,
    listed,
    require_at_most,
    require_distinct_names,
)
from parkenv.studies.fleet.setting import (
    BY_HOUR,
    CAR_LISTS,
    COUNTED,
    GIVEN,
    KINDS,
    MEASURES,
    OWN,
    SETTING_COLUMNS,
    Demanded,
    Setting,
    rate_text,
    times_demanded,
)
from parkenv.studies.results import CsvTable, Results, Row, Table
from parkenv.studies.study import Cell, Study
from parkenv.studies.workers import Task

if TYPE_CHECKING:
    from parkenv.compiled.arrays import FloatArray, IntArray
    from parkenv.engine.fleet import Fleet
    from parkenv.scenarios.calibration import Calibration
    from parkenv.show.report.page import Page
    from parkenv.studies.fleet.blocks import Tally
    from parkenv.studies.fleet.measures import Roads
    from parkenv.studies.report import Replay
    from parkenv.studies.runner import Result
    from parkenv.world.scenario import Scenario

MAX_SETTINGS = 10_000
"""Maximum number of settings of a study."""
SAMPLE_S = 300.0
"""Time between two samples of the occupancy, s."""
MOST_LISTED = 8_000_000
"""Cars that are expected in all settings up to which `cars.csv` has a list of them for each day."""
NEAREST, MINDS_PRICES, IN_TOWNS = "greedy-drive", "greedy-total", "usual"
"""Default agents: in a lot, where parking has a price, and where there are facilities."""
OPTIONS = ("stay_s", "patience_s", "delay_s", "leaving_soon_s", "sees_cars")
"""Fields of the specification that all settings have in common."""
PICTURE = "fleet.png"
MOST_BLOCKS = 60
"""Rows of blocks up to which the page has a table of them."""


class FleetStudy(Study):
    """Days on which many cars search a lot: what they know, and what changes with the lot."""

    table: ClassVar = CsvTable(
        "days.csv",
        keys=(*SETTING_COLUMNS, "day"),
        columns=("cars", *MEASURES, *BY_HOUR),
        kinds=KINDS,
        lists=("cars.csv", CAR_LISTS),
    )
    block: ClassVar = 1
    doing: ClassVar = "Driving"
    unit: ClassVar = "days"
    heading: ClassVar = "Many cars"
    table_titles: ClassVar = {
        "changes": "What changes for whom",
        "rows": "Results",
        "purposes": "Purposes, a day",
        "zones": "Zones, a day",
        "blocks": "Blocks, a day",
        "hours": "Occupancy by hour, simulated and as counted",
    }

    kind: Literal["fleet"] = "fleet"
    agents: Agents | None = option(
        None,
        "Agents, with any options in brackets; in each setting one of them drives all cars. The "
        "heuristics are compiled; any other agent decides in Python.",
        takes="NAME[,...]",
        parse=split_agents,
        default=f"{NEAREST}; where parking has a price, {MINDS_PRICES}; in towns, {IN_TOWNS}",
    )
    scenarios: Scenarios = (scenario_spec("campus"),)
    knows: Annotated[Axis[KnowledgeName], BeforeValidator(listed)] | None = option(
        None,
        "Information of members. own: their observations; shared: also a live map of all members' "
        "observations; reserve: the slot that a guidance system has reserved; full: the state of "
        "every slot.",
        panel="Knowledge",
        default=f"{', '.join(KNOWLEDGE)}; in towns, {OWN}",
    )
    shares: Values[Probability] = option(
        (1.0,),
        "Shares of the cars that are members, from 0 to 1; the others know only their own observations.",
        name="--share",
        panel="Knowledge",
    )
    arrivals_per_hour: Values[Demanded] | None = option(
        None,
        "Arriving cars per hour. given: the scenario's own demand; counted: the demand that "
        "reproduces the occupancy of the scenario's world (its counts, log or process) hour by "
        "hour; 1.2x: 1.2 times as many as given, or else counted.",
        takes="X|given|counted|1.2x[,...]",
        panel="Demand",
        default="given; without a demand of the scenario 60,120,240, of a car park that was counted, counted",
        parse=words_in,
    )
    days: int = option(10, "Days of each setting.", name="--episodes", short="-n", ge=1, le=100_000)
    stay_s: MeanStay = 3600.0
    patience_s: Patience = 600.0
    delay_s: float = option(0.0, "Age of the live map, s.", name="--delay", panel="Knowledge", ge=0.0, le=1e5)
    manoeuvre_s: float | None = option(
        None,
        "Seconds for which a car that parks or leaves blocks its lane; queues form behind it, and "
        "behind a car that stands still.",
        name="--manoeuvre",
        panel="Interactions",
        default="as in --calibrated; else 0, cars pass through each other",
        ge=0.0,
        le=3600.0,
    )
    leaving_soon_s: float = option(
        0.0,
        "Seconds for which cars signal that they are about to leave; a car that waits at such a "
        "slot holds it.",
        name="--leaving-soon",
        panel="Interactions",
        ge=0.0,
        le=3600.0,
    )
    sees_cars: bool = option(
        False,
        "Let agents observe other cars in view, in a further key of the observation. `belief-rivals` then counts them "
        "and is not told how many arrive.",
        panel="Interactions",
    )
    calibrated: FilePath | None = option(
        None,
        "Use driving speed, failure cost and manoeuvre of a calibrated.json of `parkenv calibrate`.",
        panel="Interactions",
    )
    decision_limit_s: float | None = option(
        None,
        "Stop the run if a decision of a Python agent takes longer, in seconds of wall time, "
        "including compilation.",
        name="--decision-limit",
        panel="Agents",
        default="none",
        ge=0.01,
        le=1e5,
    )
    seed: Seed = 0
    figures: Figures = True

    @model_validator(mode="before")
    @classmethod
    def _one_scenario(cls, tables: Any) -> Any:
        """A file may name one `scenario`."""
        if isinstance(tables, Mapping) and "scenario" in tables:
            return {**{k: v for k, v in tables.items() if k != "scenario"}, "scenarios": [tables["scenario"]]}
        return tables

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        require_distinct_names(self.agents or (), self.scenarios)
        if self.decision_limit_s is not None and self.backend == "dask":
            raise PydanticCustomError(
                "whole",
                "decision_limit_s requires the backend loky or ray; threads of Dask get no timer signal",
            )
        axes = "scenarios x agents x knows x shares x arrivals_per_hour"
        lengths = map(
            len,
            (self.scenarios, self.agents or (NEAREST,), self.knows or KNOWLEDGE, self.shares, self.demands),
        )
        settings = math.prod(lengths)
        require_at_most(settings, axes, "settings", MAX_SETTINGS)
        require_at_most(settings * self.days, f"{axes} x days", "days")
        return self

    @property
    def demands(self) -> tuple[float | str, ...]:
        """Cars an hour, or multiples of the demand that is given or counted."""
        given = all(scenario.demand for scenario in self.scenarios)
        counted = all(scenario.occupancy.counts for scenario in self.scenarios)
        usual = (GIVEN,) if given else (COUNTED,) if counted else (60.0, 120.0, 240.0)
        return self.arrivals_per_hour or usual

    @cached_property
    def built(self) -> dict[str, Scenario]:
        """Lot, residents, hours of arrival, speeds and costs of each scenario, by its name."""
        from parkenv.scenarios.build import build

        built = [build(spec).replace(stay_s=self.stay_s) for spec in self.scenarios]
        return {one.name: one if self.calibration is None else self.calibration.applied(one) for one in built}

    @property
    def drivers(self) -> tuple[AgentSpec, ...]:
        """The agents; by default one that minds prices, where there are any, or that knows a town."""
        if self.agents:
            return self.agents
        if self._in_towns:
            return (AgentSpec(name=IN_TOWNS),)
        is_priced = any(scenario.is_priced for scenario in self.built.values())
        return (AgentSpec(name=MINDS_PRICES if is_priced else NEAREST),)

    @property
    def knowledge(self) -> tuple[str, ...]:
        """What members know, in turn; by default everything that there is to know, but in towns."""
        return self.knows or ((OWN,) if self._in_towns else KNOWLEDGE)

    @property
    def _in_towns(self) -> bool:
        return any(scenario.lot.is_town for scenario in self.built.values())

    @cached_property
    def calibration(self) -> Calibration | None:
        """The measured speed, failure cost and manoeuvre, if any."""
        from parkenv.scenarios.calibration import Calibration

        if (path := self.calibrated) is None:
            return None
        measured, names = Calibration.from_file(path), [spec.title for spec in self.scenarios]
        if names != [measured.scenario]:
            driven = " and ".join(map(repr, names))
            raise InputError(f"{path} was measured on {measured.scenario!r}, the fleet drives on {driven}")
        return measured

    @property
    def blocked_s(self) -> float:
        """Time for which a car that parks or leaves blocks its lane, s."""
        if self.manoeuvre_s is not None:
            return self.manoeuvre_s
        return 0.0 if self.calibration is None else self.calibration.manoeuvre_s

    @cached_property
    def _roads(self) -> dict[str, Roads]:
        from parkenv.studies.fleet.measures import Roads

        return {name: Roads(scenario) for name, scenario in self.built.items()}

    @cached_property
    def fleet_settings(self) -> list[Setting]:
        """All settings. Without members only `own` is left: it is not repeated for each share."""
        # Agents have no hash: their options may be lists.
        made = dict.fromkeys(
            (per_hour, number, OWN if share == 0.0 else knows, 0.0 if knows == OWN else share)
            for per_hour, number, knows, share in itertools.product(
                self.demands, range(len(self.drivers)), self.knowledge, self.shares
            )
        )
        return [
            Setting(name, self.drivers[number], knows, share, per_hour)
            for per_hour, number, knows, share in made
            for name in self.built
        ]

    @property
    def shown_settings(self) -> list[Setting]:
        """One setting of each scenario, to be drawn: the last one where nobody knows more than it observes, if any."""
        by_scenario: dict[str, Setting] = {}
        for setting in sorted(self.fleet_settings, key=lambda one: one.knows == OWN):
            by_scenario[setting.scenario] = setting
        return [by_scenario[name] for name in self.built]

    def fleet(self, setting: Setting) -> tuple[Fleet, list[Any]]:
        """Return the fleet of a setting, and for each kind of driver its agent, or None if it is compiled."""
        from parkenv.engine.fleet import DriverKind, Fleet
        from parkenv.studies.fleet.drivers import LimitedAgent, demand_in, policy_of

        scenario, rate, knows = self.built[setting.scenario], setting.arrivals_per_hour, setting.knows
        # Cars that see others count them instead.
        policy, agent = policy_of(setting.agent, scenario, None if self.sees_cars else rate)
        members = DriverKind(setting.share, policy, knows, shares=knows == "shared")
        fleet = Fleet(
            scenario,
            demand_in(self._followed(setting), rate, self.stay_s, self.patience_s),
            drivers=[members, DriverKind(1.0 - setting.share, policy)],
            leave_full_lot=False,
            manoeuvre_s=self.blocked_s,
            delay_s=self.delay_s,
            leaving_soon_s=self.leaving_soon_s,
            sees_cars=self.sees_cars,
        )
        if agent is not None and self.decision_limit_s is not None:
            agent = LimitedAgent(agent, self.decision_limit_s)
        return fleet, [agent, agent]

    def _followed(self, setting: Setting) -> Scenario:
        """Return the scenario whose cars arrive.

        That is its own if it has a demand, or else the first one with the same counts, log or process: in lots to
        compare, the same cars arrive.
        """
        if self.built[setting.scenario].demand is not None:
            return self.built[setting.scenario]
        its = {spec.title: spec.occupancy for spec in self.scenarios}
        return self.built[next(name for name in its if its[name] == its[setting.scenario])]

    def run_day(self, setting: Setting, day: int) -> Row:
        """Run a day of a setting; return its row of `days.csv`."""
        import numpy as np

        from parkenv.studies.fleet.blocks import Tally
        from parkenv.studies.fleet.measures import car_lists, day_measures, filling
        from parkenv.world.occupancy.process import Arrival

        fleet, agents = self.fleet(setting)
        fleet.reset(self.seed, day)
        roads = self._roads[setting.scenario]
        bound_s = roads.clairvoyant_s(fleet)
        window, occupancy = fleet.scenario.arrival, fleet.scenario.occupancy
        times = fleet.begin + np.arange(0.0, window.end_s - window.start_s, SAMPLE_S)
        taken, tally = [], Tally(fleet, roads)
        try:
            for time in times:
                fleet.run(agents, until=float(time))
                taken.append(fleet.counts())
                tally.update()
            fleet.run(agents)
            tally.update()
        except InputError as error:
            raise InputError(f"{setting}, day {day}, {error}") from error
        counted = np.full(len(times), np.nan)
        follows = fleet.scenario.demand is None or setting.arrivals_per_hour == COUNTED
        if follows and (occupancy.recorded or isinstance(setting.arrivals_per_hour, str)):
            counted = occupancy.course(Arrival(fleet.begin, fleet.day.date), times).occupied
        members = fleet.cars["kind"] == 0
        filled = filling(times, np.sum(taken, axis=1) / fleet.scenario.lot.capacity.sum(), counted)
        measured = day_measures(fleet, roads, members, filled, bound_s)
        lists = car_lists(fleet, members) if self._lists_cars else {}
        row = {**setting.columns, "day": day}
        of_tables = self.day_tables(fleet, tally, times, np.array(taken))
        return {**row, **measured, **lists, **{file: row | its for file, its in of_tables.items()}}

    def day_tables(self, fleet: Fleet, tally: Tally, times: FloatArray, taken: IntArray) -> dict[str, Row]:
        """Return what a day tells besides its row: a row of each further table, by its file; see `day_rows`."""
        from parkenv.studies.fleet.blocks import Blocks, day_rows

        cruised_m = self._roads[fleet.scenario.name].cruised_m(fleet.cars)
        return day_rows(fleet, Blocks.of(fleet.scenario.lot), tally, cruised_m, times, taken)

    @property
    def _lists_cars(self) -> bool:
        # Of counted demand, about a car an hour for each slot.
        most = max(one.lot.n_slots for one in self.built.values())
        rates = (setting.arrivals_per_hour for setting in self.fleet_settings)
        per_hour = sum(times_demanded(rate) * most if isinstance(rate, str) else rate for rate in rates)
        windows = [one.arrival for one in self.built.values()]
        hours = max(window.end_s - window.start_s for window in windows) / 3600.0
        return per_hour * hours * self.days <= MOST_LISTED

    def check(self) -> None:
        """See `Study`: days are equal only in equal hours."""
        hours = {name: scenario.arrival for name, scenario in self.built.items()}
        for name, its in hours.items():
            first = next(iter(hours))
            if (its.start_s, its.end_s) != (hours[first].start_s, hours[first].end_s):
                raise InputError(
                    f"arrivals.hours of {name!r} are not those of {first!r}, want equal hours, in which the same cars "
                    "arrive; set --hours, e.g. 08:00-12:00"
                )
        for setting in self.fleet_settings:
            self.fleet(setting)

    def settings(self) -> Row:
        from parkenv.studies.fingerprints import search_settings

        return search_settings(self, *OPTIONS, "seed") | {"manoeuvre_s": self.blocked_s}

    def cells(self) -> list[Cell]:
        return [Cell(setting, range(self.days)) for setting in self.fleet_settings]

    def run(self, work: Setting, items: Sequence[int]) -> list[Row]:
        return [self.run_day(work, day) for day in items]

    @property
    def all_tables(self) -> tuple[Table, ...]:  # type: ignore[override]
        """See `Study`: what happens in blocks, lanes and hours, too."""
        from parkenv.studies.fleet.blocks import TABLES

        return (self.table, *TABLES)

    def keep(self, work: Setting, rows: Sequence[Row], results: Results) -> None:
        """See `Study`: what happened in blocks, lanes and hours."""
        del work
        for table in self.all_tables[1:]:
            results.add([row.pop(table.file) for row in rows], table, sync=False)

    def label(self, work: Setting) -> str:
        return work.agent.label

    def summarise(self, results: Results) -> Row:
        from parkenv.studies.fleet.blocks import ALL, BLOCKS, has_zones, summarize_blocks, zone_prices
        from parkenv.studies.fleet.tables import summarize_changes, summarize_days, summarize_hours

        days = [rows for cell in self.cells() if (rows := results.of(self, cell))]
        keys = [key for work, items in self.cells() for item in items for key in self.keys(work, item)]
        blocks = results.rows(BLOCKS)
        shown = [blocks[key] for key in keys if key in blocks]
        zoned = [row for row in shown if has_zones(self.built[row["scenario"]])]
        grouped = [row for row in shown if self.built[row["scenario"]].lot.is_town]
        mixed = [row for row in shown if set(row["purpose"]) != {ALL}]
        options = {name: getattr(self, name) for name in OPTIONS}
        first = next(iter(self.built.values())).arrival.start_s // 3600.0
        prices = {name: zone_prices(its) for name, its in self.built.items()}
        purposes = {
            name: [purpose.name for purpose in its.demand.purposes]
            for name, its in self.built.items()
            if its.demand is not None
        }
        return {
            "manoeuvre_s": self.blocked_s,
            **options,
            "rows": summarize_days(days),
            "changes": summarize_changes(days, prices, purposes),
            "hours": summarize_hours(days, int(first)),
            "zones": summarize_blocks(zoned, "zone", prices),
            "blocks": summarize_blocks(grouped, "block", prices),
            "purposes": summarize_blocks(mixed, "purpose"),
            "reach": [{"scenario": name, **roads.reach()} for name, roads in self._roads.items()],
            "cautions": self._cautions(),
        }

    def _cautions(self) -> dict[str, str]:
        """Return what to know of the import of each lot, by scenario, if there is something."""
        from parkenv.lots.draft import read_provenance

        files = {spec.title: spec.lot.file for spec in self.scenarios}
        found = {
            name: read_provenance(file)
            for name, file in files.items()
            if file is not None and file.suffix in (".json", ".geojson")
        }
        return {name: its.caution for name, its in found.items() if its is not None and its.caution}

    @property
    def title(self) -> str:
        """Title of the table and of the picture."""
        from parkenv.show.plurals import plural

        lots = [f"{name}: {plural(its.lot.n_slots, 'slot')}" for name, its in self.built.items()]
        return f"{'; '.join(lots)}, {plural(self.days, 'day')}"

    def outputs(self, result: Result) -> list[Task[object]]:
        """See `Study`: a picture of each scenario, and a page with maps."""
        from parkenv.files.file_names import file_name
        from parkenv.show.figures.fleet import save_fleet_figure, save_zones_figure
        from parkenv.show.plurals import plural
        from parkenv.studies.fleet.blocks import BLOCKS, TABLES, by_hour, has_zones
        from parkenv.studies.fleet.day_map import write_map_page
        from parkenv.studies.fleet.measures import looks_s

        tasks: list[Task[object]] = [
            partial(
                save_fleet_figure,
                [row for row in result.rows if row["scenario"] == name],
                partial(looks_s, scenario),
                f"{name}: {plural(scenario.lot.n_slots, 'slot')}, {plural(self.days, 'day')}",
                result.folder / (PICTURE if len(self.built) == 1 else file_name(f"fleet_{name}", ".png")),
                [row for row in result.summary["hours"] if row["scenario"] == name],
            )
            for name, scenario in self.built.items()
        ]
        rows = {table.file: list(result.results.rows(table).values()) for table in TABLES}
        tasks.append(partial(write_map_page, self, result.summary, rows, result.folder))
        for setting in self.shown_settings:
            scenario = self.built[setting.scenario]
            days = [row for row in rows[BLOCKS.file] if setting.holds(row)]
            if has_zones(scenario) and days:
                name = "zones" if len(self.built) == 1 else f"zones_{setting.scenario}"
                title = f"{setting.scenario}: zones, {setting.agent.label}, {rate_text(setting.arrivals_per_hour)}"
                _, hours, courses = by_hour(days, "zone")
                path = result.folder / file_name(name, ".png")
                tasks.append(partial(save_zones_figure, scenario.lot, title, hours, courses, path))
        return tasks

    @classmethod
    def findings(cls, summary: Row) -> list[str]:
        """See `Study`: the first setting, and what to mind of the lots and the days."""
        row = summary["rows"][0]
        findings = [
            f"{row['agents']} on {row['scenario']}, {rate_text(row['arrivals_per_hour'])}: {row['total_s']:.1f} s a "
            f"car, {row['balked_fraction']:.1%} find no slot."
        ]
        findings += [f"On {name}, {caution}" for name, caution in summary["cautions"].items()]
        findings += [
            f"On {reach['scenario']}, most spaces are out of reach of {reach['entries_cut_off']} of the "
            f"{reach['entries']} entries (parkenv lot show --graph)."
            for reach in summary["reach"]
            if reach["entries_cut_off"]
        ]
        if row["days"] == 1:
            findings.append("One day has no interval; five days or more (-n 5) show what is chance.")
        return findings

    @classmethod
    def page(cls, summary: Row, folder: Path) -> Page:
        """See `Study`; some columns mean something else than in other tables."""
        from parkenv.show.report.tables import OF_FLEETS, tables_of

        # Of a town with many streets the map tells, and blocks.csv.
        blocks = summary["blocks"] if len(summary["blocks"]) <= MOST_BLOCKS else []
        tables = tables_of({**summary, "blocks": blocks}, cls.table_titles, OF_FLEETS)
        return super().page(summary, folder)._replace(tables=tables)

    def replays(self, folder: Path) -> Sequence[Replay]:
        from parkenv.studies.fleet.day_map import DayMaps
        from parkenv.studies.fleet.day_replay import FleetReplay

        return [DayMaps(self, folder), FleetReplay(self, folder)]
