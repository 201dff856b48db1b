"""Specification of many cars: scenarios, agents, information, shares and demands, all on the same days."""

from __future__ import annotations

import itertools
import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

from pydantic import BeforeValidator, model_validator
from pydantic_core import PydanticCustomError

from parkenv.errors import InputError
from parkenv.files.field_types import Probability
from parkenv.files.known_names import KNOWLEDGE, KnowledgeName
from parkenv.files.option import option, words_in
from parkenv.files.spec_file import Axis, FilePath
from parkenv.scenarios.spec import scenario_spec
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
    MEASURES,
    OWN,
    SETTING_COLUMNS,
    Demanded,
    Setting,
    times_demanded,
)
from parkenv.studies.results import Results, Row, Table
from parkenv.studies.study import Cell, Study

if TYPE_CHECKING:
    from parkenv.engine.fleet import Fleet
    from parkenv.scenarios.calibration import Calibration
    from parkenv.studies.fleet.day import Day
    from parkenv.studies.fleet.roads import Roads
    from parkenv.world.scenario import Scenario

MAX_SETTINGS = 10_000  # maximum number of settings of a study
MOST_LISTED = 8_000_000
"""Cars that are expected in all settings up to which `cars.csv` has a list of them for each day."""
NEAREST, MINDS_PRICES, IN_TOWNS = "greedy-drive", "greedy-total", "usual"
"""Default agents: in a lot, where parking has a price, and where there are facilities."""
OPTIONS = ("stay_s", "patience_s", "delay_s", "leaving_soon_s", "sees_cars")
"""Fields of the specification that all settings have in common."""


class FleetSpec(Study):
    """Days of many cars in settings: each setting has a scenario, an agent, information of members, and a demand."""

    table: ClassVar = Table(
        "days.csv",
        keys=(*SETTING_COLUMNS, "day"),
        columns=("cars", *MEASURES, *BY_HOUR),
        lists=("cars.csv", CAR_LISTS),
    )
    block: ClassVar = 1
    doing: ClassVar = "Driving"
    unit: ClassVar = "days"

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
        values = self.scenarios, self.agents or (NEAREST,), self.knows or KNOWLEDGE, self.shares, self.demands
        settings = math.prod(map(len, values))
        require_at_most(settings, axes, "settings", MAX_SETTINGS)
        require_at_most(settings * self.days, f"{axes} x days", "days")
        return self

    @property
    def demands(self) -> tuple[float | str, ...]:
        given = all(scenario.demand for scenario in self.scenarios)
        counted = all(scenario.occupancy.counts for scenario in self.scenarios)
        usual = (GIVEN,) if given else (COUNTED,) if counted else (60.0, 120.0, 240.0)
        return self.arrivals_per_hour or usual

    @cached_property
    def built(self) -> dict[str, Scenario]:
        from parkenv.scenarios.build import build

        scenarios = [build(spec).replace(stay_s=self.stay_s) for spec in self.scenarios]
        if self.calibration is not None:
            scenarios = [self.calibration.applied(scenario) for scenario in scenarios]
        return {scenario.name: scenario for scenario in scenarios}

    @property
    def drivers(self) -> tuple[AgentSpec, ...]:
        if self.agents:
            return self.agents
        if self._in_towns:
            return (AgentSpec(name=IN_TOWNS),)
        is_priced = any(scenario.is_priced for scenario in self.built.values())
        return (AgentSpec(name=MINDS_PRICES if is_priced else NEAREST),)

    @property
    def knowledge(self) -> tuple[str, ...]:
        return self.knows or ((OWN,) if self._in_towns else KNOWLEDGE)

    @property
    def _in_towns(self) -> bool:
        return any(scenario.lot.is_town for scenario in self.built.values())

    @cached_property
    def calibration(self) -> Calibration | None:
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
        if self.manoeuvre_s is not None:
            return self.manoeuvre_s
        return 0.0 if self.calibration is None else self.calibration.manoeuvre_s

    @cached_property
    def roads(self) -> dict[str, Roads]:
        from parkenv.studies.fleet.roads import Roads

        return {name: Roads(scenario) for name, scenario in self.built.items()}

    @cached_property
    def fleet_settings(self) -> list[Setting]:
        """All settings. Without members only `own` is left: it is not repeated for each share."""
        # Agents have no hash: their options may be lists.
        axes = self.demands, range(len(self.drivers)), self.knowledge, self.shares
        combinations = dict.fromkeys(
            (rate, number, OWN if share == 0.0 else knows, 0.0 if knows == OWN else share)
            for rate, number, knows, share in itertools.product(*axes)
        )
        return [
            Setting(name, self.drivers[number], knows, share, rate)
            for rate, number, knows, share in combinations
            for name in self.built
        ]

    def fleet(self, setting: Setting) -> tuple[Fleet, list[Any]]:
        """Return the fleet of a setting, and for each kind of driver its agent, or None if it is compiled."""
        from parkenv.engine.fleet import DriverKind, Fleet, FleetOptions
        from parkenv.studies.fleet.drivers import LimitedAgent, demand_in, policy_of

        scenario, rate, knows = self.built[setting.scenario], setting.arrivals_per_hour, setting.knows
        # Cars that see others count them instead.
        policy, agent = policy_of(setting.agent, scenario, None if self.sees_cars else rate)
        members = DriverKind(setting.share, policy, knows, shares=knows == "shared")
        own = {
            field.name: getattr(self, field.name)
            for field in fields(FleetOptions)
            if hasattr(self, field.name)
        }
        options = own | {
            "drivers": (members, DriverKind(1.0 - setting.share, policy)),
            "manoeuvre_s": self.blocked_s,
            "leave_full_lot": False,
        }
        demand = demand_in(self._followed(setting), rate, self.stay_s, self.patience_s)
        if agent is not None and self.decision_limit_s is not None:
            agent = LimitedAgent(agent, self.decision_limit_s)
        return Fleet(scenario, demand, FleetOptions(**options)), [agent, agent]

    def _followed(self, setting: Setting) -> Scenario:
        """Return the scenario whose cars arrive.

        That is its own if it has a demand, or else the first one with the same counts, log or process: in lots to
        compare, the same cars arrive.
        """
        if self.built[setting.scenario].demand is not None:
            return self.built[setting.scenario]
        worlds = {spec.title: spec.occupancy for spec in self.scenarios}
        return self.built[next(name for name in worlds if worlds[name] == worlds[setting.scenario])]

    def run_day(self, setting: Setting, number: int) -> Row:
        """Run a day of a setting; return its row of `days.csv`, and by their files the rows of the other tables."""
        import numpy as np

        from parkenv.studies.fleet.day import simulate
        from parkenv.studies.fleet.measures import car_lists, day_measures
        from parkenv.world.occupancy.process import Arrival

        fleet, agents = self.fleet(setting)
        try:
            day = simulate(fleet, agents, self.roads[setting.scenario], self.seed, number)
        except InputError as error:
            raise InputError(f"{setting}, day {number}, {error}") from error
        counted, occupancy = np.full(len(day.times), np.nan), fleet.scenario.occupancy
        follows = fleet.scenario.demand is None or setting.arrivals_per_hour == COUNTED
        if follows and (occupancy.recorded or isinstance(setting.arrivals_per_hour, str)):
            counted = occupancy.course(Arrival(fleet.begin, fleet.day.date), day.times).occupied
        key = {**setting.columns, "day": number}
        lists = car_lists(day) if self._lists_cars else {}
        others = {file: key | row for file, row in self.day_tables(day).items()}
        return {**key, **day_measures(day, counted), **lists, **others}

    @abstractmethod
    def day_tables(self, day: Day) -> dict[str, Row]:
        """Return a row of each further table, by its file, without setting and day."""

    @property
    def _lists_cars(self) -> bool:
        # Of counted demand, about a car an hour for each slot.
        most = max(scenario.lot.n_slots for scenario in self.built.values())
        rates = (setting.arrivals_per_hour for setting in self.fleet_settings)
        per_hour = sum(times_demanded(rate) * most if isinstance(rate, str) else rate for rate in rates)
        windows = [scenario.arrival for scenario in self.built.values()]
        hours = max(window.end_s - window.start_s for window in windows) / 3600.0
        return per_hour * hours * self.days <= MOST_LISTED

    def check(self) -> None:
        windows = {
            name: (scenario.arrival.start_s, scenario.arrival.end_s) for name, scenario in self.built.items()
        }
        first = next(iter(windows))
        for name, window in windows.items():
            if window != windows[first]:
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

    def label(self, work: Setting) -> str:
        return work.agent.label

    def finished_days(self, results: Results) -> list[list[Row]]:
        return [rows for cell in self.cells() if (rows := results.of(self, cell))]

    def cautions(self) -> dict[str, str]:
        from parkenv.lots.draft import read_provenance

        files = {spec.title: spec.lot.file for spec in self.scenarios}
        provenances = {
            name: read_provenance(file)
            for name, file in files.items()
            if file is not None and file.suffix in (".json", ".geojson")
        }
        return {name: origin.caution for name, origin in provenances.items() if origin and origin.caution}

    @property
    def title(self) -> str:
        from parkenv.show.plurals import plural

        lots = [f"{name}: {plural(scenario.lot.n_slots, 'slot')}" for name, scenario in self.built.items()]
        return f"{'; '.join(lots)}, {plural(self.days, 'day')}"
