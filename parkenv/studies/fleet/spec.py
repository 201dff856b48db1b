"""What studies of many cars vary: scenarios, agents, information, shares and demands, all on the same days."""

from __future__ import annotations

import itertools
import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

from pydantic import BeforeValidator, model_validator

from parkenv.errors import InputError, require
from parkenv.files.field_types import Probability
from parkenv.files.known_names import KNOWLEDGE, KnowledgeName
from parkenv.files.option import option, words_in
from parkenv.files.spec_file import Axis, FilePath
from parkenv.scenarios.spec import scenario_spec
from parkenv.studies.fields import (
    Agents,
    AgentSpec,
    Figures,
    MeanStay,
    Patience,
    Scenarios,
    Seed,
    Values,
    listed,
    require_at_most,
    require_distinct_names,
    split_agents,
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
)
from parkenv.studies.results import Results, Row, Table, search_settings
from parkenv.studies.study import Cell, Study

if TYPE_CHECKING:
    from parkenv.engine.fleet import Fleet
    from parkenv.scenarios.calibration import Calibration
    from parkenv.studies.fleet.day import Day, Roads
    from parkenv.world.scenario import Scenario

MAX_SETTINGS = 10_000  # maximum number of settings of a study
# Default agents: in a lot, where parking has a price, and where there are facilities.
NEAREST, MINDS_PRICES, IN_TOWNS = "greedy-drive", "greedy-total", "usual"
# Fields of the specification that all settings have in common.
OPTIONS = ("stay_s", "patience_s", "delay_s", "sees_cars")


class FleetSpec(Study):
    """Settings of fleets, and the days that cars drive in them; subclasses say what is kept of a day."""

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
        is_priced = any(scenario.is_priced for scenario in self.built.values())
        usual = IN_TOWNS if self._in_towns else MINDS_PRICES if is_priced else NEAREST
        return self.agents or (AgentSpec(name=usual),)

    @property
    def knowledge(self) -> tuple[str, ...]:
        return self.knows or ((OWN,) if self._in_towns else KNOWLEDGE)

    @property
    def _in_towns(self) -> bool:
        return any(scenario.lot.is_town for scenario in self.built.values())

    @cached_property
    def calibration(self) -> Calibration | None:
        from parkenv.scenarios.calibration import Calibration

        if self.calibrated is None:
            return None
        calibration, names = Calibration.from_file(self.calibrated), [spec.title for spec in self.scenarios]
        if names != [calibration.scenario]:
            driven = f"{calibration.scenario!r}, the fleet drives on {' and '.join(map(repr, names))}"
            raise InputError(f"{self.calibrated} was measured on {driven}")
        return calibration

    @property
    def blocked_s(self) -> float:
        measured_s = 0.0 if self.calibration is None else self.calibration.manoeuvre_s
        return measured_s if self.manoeuvre_s is None else self.manoeuvre_s

    @cached_property
    def roads(self) -> dict[str, Roads]:
        from parkenv.studies.fleet.day import Roads

        return {name: Roads(scenario) for name, scenario in self.built.items()}

    @cached_property
    def fleet_settings(self) -> list[Setting]:
        # Without members only `own` is left. Agents have no hash: their options may be lists.
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
        from parkenv.engine.fleet import DriverKind, Fleet, FleetOptions
        from parkenv.studies.fleet.drivers import demand_in, policy_of

        scenario, rate, knows = self.built[setting.scenario], setting.arrivals_per_hour, setting.knows
        # Cars that see others count them instead.
        policy, agent = policy_of(setting.agent, scenario, None if self.sees_cars else rate)
        members = DriverKind(setting.share, policy, knows, shares=knows == "shared")
        names = [field.name for field in fields(FleetOptions) if hasattr(self, field.name)]
        own = {name: getattr(self, name) for name in names}
        drivers = members, DriverKind(1.0 - setting.share, policy)
        options = own | {"drivers": drivers, "manoeuvre_s": self.blocked_s, "leave_full_lot": False}
        demand = demand_in(self._followed(setting), rate, self.stay_s, self.patience_s)
        return Fleet(scenario, demand, FleetOptions(**options)), [agent, agent]

    def _followed(self, setting: Setting) -> Scenario:
        # In lots to compare that have no demand, but the same counts, log or process, the same cars arrive.
        if self.built[setting.scenario].demand is not None:
            return self.built[setting.scenario]
        worlds = {spec.title: spec.occupancy for spec in self.scenarios}
        return self.built[next(name for name in worlds if worlds[name] == worlds[setting.scenario])]

    def run_day(self, setting: Setting, number: int) -> Row:
        import numpy as np

        from parkenv.studies.fleet.day import car_lists, day_measures, simulate
        from parkenv.world.occupancy.process import Arrival

        # A row of `days.csv`, and under their files the rows of the other tables.
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
        others = {file: key | row for file, row in self.day_tables(day).items()}
        return key | day_measures(day, counted) | car_lists(day) | others

    @abstractmethod
    def day_tables(self, day: Day) -> dict[str, Row]: ...

    def check(self) -> None:
        (first, scenario), *others = self.built.items()
        for name, other in others:
            require(
                (other.arrival.start_s, other.arrival.end_s)
                == (scenario.arrival.start_s, scenario.arrival.end_s),
                f"arrivals.hours of {name!r} are not those of {first!r}, want equal hours; set --hours 08:00-12:00",
            )
        for setting in self.fleet_settings:
            self.fleet(setting)

    def settings(self) -> Row:
        return search_settings(self, *OPTIONS, "seed") | {"manoeuvre_s": self.blocked_s}

    def cells(self) -> list[Cell]:
        return [Cell(setting, range(self.days)) for setting in self.fleet_settings]

    def run(self, work: Setting, items: Sequence[int]) -> list[Row]:
        return [self.run_day(work, day) for day in items]

    def label(self, work: Setting) -> str:
        return work.agent.label

    def finished_days(self, results: Results) -> list[list[Row]]:
        return [rows for cell in self.cells() if (rows := self.rows_of(cell, results))]

    def cautions(self) -> dict[str, str]:
        from parkenv.lots.draft import read_provenance

        files = [(spec.title, spec.lot.file) for spec in self.scenarios]
        origins = [(name, read_provenance(f)) for name, f in files if f and f.suffix in (".json", ".geojson")]
        return {name: origin.caution for name, origin in origins if origin and origin.caution}

    @property
    def shown_settings(self) -> list[Setting]:
        # Of each scenario the last one where nobody knows more than it observes, if any.
        settings = sorted(self.fleet_settings, key=lambda setting: setting.knows == OWN)
        by_scenario = {setting.scenario: setting for setting in settings}
        return [by_scenario[name] for name in self.built]
