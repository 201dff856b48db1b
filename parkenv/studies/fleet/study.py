"""Days on which many cars search one lot: agents, knowledge, shares and demand, all on the same days."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, model_validator
from pydantic_core import PydanticCustomError

from parkenv.errors import InputError
from parkenv.files.csv_tables import NUMBER_OR_NAN, TEXT, WHOLE
from parkenv.files.known_names import KNOWLEDGE, KnowledgeName
from parkenv.files.option import Inside, Option, option
from parkenv.files.spec_file import Axis, FilePath
from parkenv.scenarios.spec import Probability, scenario_spec
from parkenv.studies.agent_spec import AgentSpec, split_agents
from parkenv.studies.fields import (
    TRAFFIC,
    Agents,
    ArrivalRate,
    Figures,
    MeanStay,
    OneScenario,
    Patience,
    Seed,
    Values,
    listed,
    require_at_most,
    require_distinct_names,
)
from parkenv.studies.fleet.setting import MEASURES, OWN, SETTING_COLUMNS, Setting
from parkenv.studies.results import CsvTable, Results, Row
from parkenv.studies.study import Cell, Study
from parkenv.studies.workers import Task

if TYPE_CHECKING:
    from parkenv.engine.fleet import Fleet
    from parkenv.scenarios.calibration import Calibration
    from parkenv.show.report.page import Page
    from parkenv.studies.fleet.measures import Roads
    from parkenv.studies.report import Replay
    from parkenv.studies.runner import Result
    from parkenv.world.scenario import Scenario

MAX_SETTINGS = 10_000
"""Maximum number of settings of a study."""
SAMPLE_S = 300.0
"""Time between two samples of the occupancy, s."""
OPTIONS = ("stay_s", "patience_s", "delay_s", "leaving_soon_s", "sees_cars")
"""Fields of the specification that all settings have in common."""
PICTURE = "fleet.png"


class FleetStudy(Study):
    """Days on which many cars search one lot, and what they know."""

    table: ClassVar = CsvTable(
        "days.csv",
        keys=(*SETTING_COLUMNS, "day"),
        columns=("cars", *MEASURES),
        kinds=dict.fromkeys(("scenario", "agents", "knows"), TEXT)
        | dict.fromkeys(("day", "cars"), WHOLE)
        | dict.fromkeys(("members_s", "others_s"), NUMBER_OR_NAN),
        timings=None,
    )
    block: ClassVar = 1
    doing: ClassVar = "Driving"
    unit: ClassVar = "days"
    heading: ClassVar = "Many cars"

    kind: Literal["fleet"] = "fleet"
    agents: Annotated[Agents, Option(takes="NAME[,...]", parse=split_agents)] = Field(
        (AgentSpec(name="greedy-drive"),),
        description="Agents, each of which drives all cars in turn, with any options in brackets. greedy-drive, "
        "first-free and random are compiled; any other agent decides in Python.",
    )
    scenario: Annotated[OneScenario, Inside(without=TRAFFIC)] = scenario_spec("campus")
    knows: Annotated[Axis[KnowledgeName], BeforeValidator(listed)] = option(
        KNOWLEDGE,
        "What members know. own: what they observe; shared: also a live map of what members observe; "
        "reserve: the slot that a guidance system has reserved; full: the state of every slot.",
        panel="Knowledge",
    )
    shares: Values[Probability] = option(
        (1.0,),
        "Shares of the cars that are members, from 0 to 1; the others know what they observe.",
        name="--share",
        panel="Knowledge",
    )
    arrivals_per_hour: Values[ArrivalRate] = option(
        (60.0, 120.0, 240.0), "Cars an hour that arrive.", panel="Demand"
    )
    days: int = option(10, "Days of each setting.", name="--episodes", short="-n", ge=1, le=100_000)
    stay_s: MeanStay = 3600.0
    patience_s: Patience = 600.0
    delay_s: float = option(0.0, "Age of the live map, s.", name="--delay", panel="Knowledge", ge=0.0, le=1e5)
    manoeuvre_s: float | None = option(
        None,
        "Seconds for which a car that parks or leaves blocks its lane; queues form behind it, and behind a "
        "car that stands.",
        name="--manoeuvre",
        panel="Interactions",
        default="as in --calibrated; else 0, cars pass through each other",
        ge=0.0,
        le=3600.0,
    )
    leaving_soon_s: float = option(
        0.0,
        "Seconds for which cars show that they leave; a car that stands before such a slot holds it.",
        name="--leaving-soon",
        panel="Interactions",
        ge=0.0,
        le=3600.0,
    )
    sees_cars: bool = option(
        False,
        "Let agents observe other cars in view, in a further key of the observation.",
        panel="Interactions",
    )
    calibrated: FilePath | None = option(
        None,
        "Take driving speed, failure cost and manoeuvre from a calibrated.json of `parkenv calibrate`.",
        panel="Interactions",
    )
    decision_limit_s: float | None = option(
        None,
        "Stop the run if an agent in Python takes longer for a decision, in seconds of wall time, "
        "compiling included.",
        name="--decision-limit",
        panel="Agents",
        default="none",
        ge=0.01,
        le=1e5,
    )
    seed: Seed = 0
    figures: Figures = True

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        require_distinct_names(self.agents)
        if self.decision_limit_s is not None and self.backend == "dask":
            raise PydanticCustomError(
                "whole",
                "decision_limit_s requires the backend loky or ray; threads of Dask get no timer signal",
            )
        settings = len(self.agents) * len(self.knows) * len(self.shares) * len(self.arrivals_per_hour)
        axes = "agents x knows x shares x arrivals_per_hour"
        require_at_most(settings, axes, "settings", MAX_SETTINGS)
        require_at_most(settings * self.days, f"{axes} x days", "days")
        return self

    @cached_property
    def built(self) -> Scenario:
        """Lot, residents, hours of arrival, speeds and costs."""
        from parkenv.scenarios.build import build

        scenario = build(self.scenario)
        return scenario if self.calibration is None else self.calibration.applied(scenario)

    @cached_property
    def calibration(self) -> Calibration | None:
        """The measured speed, failure cost and manoeuvre, if any."""
        from parkenv.scenarios.build import build
        from parkenv.scenarios.calibration import Calibration

        if (path := self.calibrated) is None:
            return None
        measured = Calibration.from_file(path)
        if measured.scenario != (name := build(self.scenario).name):
            raise InputError(f"{path} was measured on {measured.scenario!r}, the fleet drives on {name!r}")
        return measured

    @property
    def blocked_s(self) -> float:
        """Time for which a car that parks or leaves blocks its lane, s."""
        if self.manoeuvre_s is not None:
            return self.manoeuvre_s
        return 0.0 if self.calibration is None else self.calibration.manoeuvre_s

    @cached_property
    def _roads(self) -> Roads:
        from parkenv.studies.fleet.measures import Roads

        return Roads(self.built)

    @cached_property
    def fleet_settings(self) -> list[Setting]:
        """All settings. Without members only `own` is left: it is not repeated for each share."""
        # Agents have no hash: their options may be lists.
        made = dict.fromkeys(
            (per_hour, number, OWN if share == 0.0 else knows, 0.0 if knows == OWN else share)
            for per_hour, number, knows, share in itertools.product(
                self.arrivals_per_hour, range(len(self.agents)), self.knows, self.shares
            )
        )
        name = self.built.name
        return [
            Setting(name, self.agents[number], knows, share, per_hour)
            for per_hour, number, knows, share in made
        ]

    def fleet(self, setting: Setting) -> tuple[Fleet, list[Any]]:
        """Return the fleet of a setting, and for each kind of driver its agent, or None if it is compiled.

        Raises:
            InputError: the demand is out of range, or the agent cannot be made or drives no fleet.
        """
        from parkenv.engine.fleet import DriverKind, Fleet
        from parkenv.studies.fleet.decision_limit import LimitedAgent
        from parkenv.studies.fleet.drivers import demand_in, policy_of

        policy, agent = policy_of(setting.agent, self.built, setting.arrivals_per_hour)
        kinds = [
            DriverKind(setting.share, policy, setting.knows, shares=setting.knows == "shared"),
            DriverKind(1.0 - setting.share, policy),
        ]
        fleet = Fleet(
            self.built,
            demand_in(self.built, setting.arrivals_per_hour, self.stay_s, self.patience_s),
            background="residents",
            drivers=kinds,
            leave_full_lot=False,
            manoeuvre_s=self.blocked_s,
            **{name: getattr(self, name) for name in ("delay_s", "leaving_soon_s", "sees_cars")},
        )
        if agent is not None and self.decision_limit_s is not None:
            agent = LimitedAgent(agent, self.decision_limit_s)
        return fleet, [agent, agent]

    def run_day(self, setting: Setting, day: int) -> Row:
        """Run a day of a setting; return its row of `days.csv`.

        Raises:
            InputError: an agent raised an error or took too long; the message names setting, day, car and time.
        """
        import numpy as np

        from parkenv.studies.fleet.clairvoyant_bound import clairvoyant_bound_s
        from parkenv.studies.fleet.measures import day_measures

        fleet, agents = self.fleet(setting)
        fleet.reset(self.seed, day)
        bound_s = clairvoyant_bound_s(self._roads.parking_day(fleet))
        window = self.built.arrival
        taken = []
        try:
            for second in np.arange(0.0, window.end_s - window.start_s, SAMPLE_S):
                fleet.run(agents, until=fleet.begin + second)
                taken.append(fleet.taken().mean())
            fleet.run(agents)
        except InputError as error:
            raise InputError(f"{setting}, day {day}, {error}") from error
        members = fleet.cars["kind"] == 0
        measured = day_measures(fleet, self._roads, members, float(np.mean(taken)), bound_s)
        return {**setting.columns, "day": day, **measured}

    def check(self) -> None:
        """See `Study`."""
        for setting in self.fleet_settings:
            self.fleet(setting)

    def settings(self) -> Row:
        """See `Study`."""
        from parkenv.studies.fingerprints import search_settings

        return search_settings(self, *OPTIONS, "seed") | {"manoeuvre_s": self.blocked_s}

    def cells(self) -> list[Cell]:
        """See `Study`."""
        return [Cell(setting, range(self.days)) for setting in self.fleet_settings]

    def run(self, work: Setting, items: Sequence[int]) -> list[Row]:
        """See `Study`."""
        return [self.run_day(work, day) for day in items]

    def label(self, work: Setting) -> str:
        """See `Study`."""
        return work.agent.label

    def summarise(self, results: Results) -> Row:
        """See `Study`."""
        from parkenv.studies.fleet.tables import summarize_days

        days = [rows for cell in self.cells() if (rows := results.of(self, cell))]
        options = {name: getattr(self, name) for name in OPTIONS}
        return {"manoeuvre_s": self.blocked_s, **options, "rows": summarize_days(days)}

    @property
    def title(self) -> str:
        """Title of the table and of the picture."""
        from parkenv.show.plurals import plural

        return f"{self.built.name}: {self.built.lot.n_slots} slots, {plural(self.days, 'day')}"

    def outputs(self, result: Result) -> list[Task[object]]:
        """See `Study`: the picture."""
        from parkenv.show.figures.fleet import save_fleet_figure
        from parkenv.studies.fleet.measures import looks_s

        return [
            partial(
                save_fleet_figure,
                result.rows,
                partial(looks_s, self.built),
                self.title,
                result.folder / PICTURE,
            )
        ]

    @classmethod
    def findings(cls, summary: Row) -> list[str]:
        """See `Study`: what competition costs, for each agent and demand."""
        rows = summary["rows"]
        shown: dict[tuple[Any, ...], Row] = {}
        for row in sorted(rows, key=lambda row: row["knows"] != OWN):
            shown.setdefault((row["agents"], row["arrivals_per_hour"]), row)
        findings = []
        for agent, per_hour in dict.fromkeys((row["agents"], row["arrivals_per_hour"]) for row in rows):
            row = shown[agent, per_hour]
            finding = (
                f"{agent}, {per_hour:g} cars an hour, {row['occupancy']:.0%} of the slots taken: {row['total_s']:.1f} "
                f"s a car, {row['balked_fraction']:.1%} find no slot"
            )
            low, high = row["price_of_anarchy_ci95"]
            if None not in (row["price_of_anarchy"], low, high) and row["knows"] == OWN:
                finding += f"; the price of anarchy is {row['price_of_anarchy']:.3f} [{low:.3f}, {high:.3f}]"
            findings.append(f"{finding}.")
        return findings

    @classmethod
    def page(cls, summary: Row, folder: Path) -> Page:
        """See `Study`; some columns mean something else than in other tables."""
        from parkenv.show.report.tables import OF_FLEETS, tables_of

        tables = tables_of(summary, cls.table_titles, OF_FLEETS)
        return super().page(summary, folder)._replace(tables=tables)

    def replays(self, folder: Path) -> Sequence[Replay]:
        """See `Study`."""
        from parkenv.studies.fleet.day_replay import FleetReplay

        return [FleetReplay(self, folder)]
