"""Comparisons: all agents search in the same worlds, in every scenario and setting."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from parkenv.errors import InputError, require
from parkenv.files.field_types import Probability
from parkenv.files.known_names import UNBEATEN
from parkenv.files.option import Option, numbers_in, option
from parkenv.files.spec_file import FilePath, Spec
from parkenv.scenarios.spec import Cost, ScenarioSpec, SensorModelSpec, Speed, scenario_spec
from parkenv.show.tables import SETTING_AXES, plural
from parkenv.studies.fields import (
    AGENTS_HELP,
    MAX_EPISODES,
    Agents,
    AgentSpec,
    Detector,
    Figures,
    Level,
    Rig,
    Scenarios,
    Seed,
    Values,
    require_agents,
    require_at_most,
    require_distinct_names,
    require_rig,
    split_agents,
)
from parkenv.studies.results import Results, Row, search_settings
from parkenv.studies.study import Cell, ReplayJob, ReportOptions, Study
from parkenv.studies.workers import Task
from parkenv.world.cost_terms import COST_FIELDS
from parkenv.world.sensor_model import SensorModel
from planners.names import BOUND, HUMAN

if TYPE_CHECKING:
    from parkenv.scenarios.calibration import Calibration
    from parkenv.studies.compare.cases import Case
    from parkenv.world.scenario import Scenario

DEFAULT_AGENTS = (
    "mdp", "belief", "mdp-tuned", "greedy-goal", "greedy-drive", "first-free", "random", "oracle",
)  # fmt: skip
LEVELS = (0.5, 0.7, 0.8, 0.9, 0.95, 0.99)  # occupancy levels of the command
# Failure costs of `--failure-cost sweep`, s.
FAILURE_COST_SWEEP = (0.0, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0)
# Agents that require observations of slots before an attempt.
NEEDS_OBSERVATIONS = ("belief", "belief-rivals", "mdp-tuned", "network")
# Separator between the name of a scenario and the constant probability of its forecast.
CONSTANT_FORECAST = "-constant-forecast-"


def _failure_costs(text: str) -> object:
    return FAILURE_COST_SWEEP if text == "sweep" else numbers_in(text)


_COSTS = "Costs and speeds"
Milliseconds = Annotated[float, Field(gt=0.0, le=600_000.0)]


class Grid(Spec):
    """Settings to vary; every combination is run. Scenarios keep their own values for missing axes."""

    failure_s: Values[Cost] | None = option(
        None,
        "Cost of a failed attempt, s: the world charges it, and planners assume it unless their "
        "own options differ. sweep: 0 to 120 s, and again as scenario NAME-blind, in which no "
        "slot is observed before an attempt, for agents that need no observations.",
        name="--failure-cost",
        takes="S[,S...]|sweep",
        default="the scenario's, 10",
        panel=_COSTS,
        parse=_failure_costs,
    )
    v_walk_kmh: Values[Speed] | None = option(
        None, "Walking speed, km/h.", takes="V[,V...]", default="the scenario's, 4", panel=_COSTS
    )
    v_drive_kmh: Values[Speed] | None = option(
        None, "Driving speed, km/h.", takes="V[,V...]", default="the scenario's, 10", panel=_COSTS
    )
    occupancy_levels: Annotated[tuple[Level, ...], AfterValidator(lambda v: tuple(sorted(set(v))))] = option(
        (),
        "Also run at these mean occupancies of the lot, with a sixth of the episodes each, for "
        "the figure of time against occupancy. Searches in a recorded log are binned instead.",
        takes="P[,...]|none",
        default="0.5,0.7,0.8,0.9,0.95,0.99; none with --failure-cost sweep",
        panel="World",
        strict=False,
        max_length=100,
    )
    constant_forecast: Annotated[tuple[Probability, ...], AfterValidator(lambda v: tuple(sorted(set(v))))] = (
        option(
            (),
            "Also run with wrong forecasts that give every slot this probability of being taken; "
            "draws total time against it.",
            takes="P[,...]",
            panel="World",
            default="none",
            strict=False,
            max_length=100,
        )
    )
    budget_ms: Annotated[tuple[Milliseconds, ...], AfterValidator(lambda v: tuple(sorted(set(v))))] = option(
        (),
        "Run agents with the option budget_ms at each of these times per decision, ms. Use an idle machine.",
        takes="MS[,...]",
        default="none",
        strict=False,
        max_length=100,
    )
    blind: bool = Field(
        False,
        description="Also run without observations of slots before an attempt, for agents that need no "
        "observations.",
    )
    calibrated: FilePath | None = option(
        None,
        "Also compare at the failure cost and driving speed in a calibrated.json of `parkenv calibrate`, "
        "in the same worlds.",
        panel=_COSTS,
    )


class CaseStudy(Study):
    """A study whose cells are cases: an agent in a scenario, with the seeds of its searches."""

    shown: ClassVar = {
        "rows": (
            "scenario", "blind", *SETTING_AXES, "agent", "episodes", "total_s", "median_s", "gave_up_fraction",
            "difference_s", "regret_s", "gap_to_bound", *COST_FIELDS, "parked_fraction", "replans",
            "decision_ms", "decision_ms_p99",
        )
    }  # fmt: skip

    def run(self, work: Case, items: Sequence[int]) -> list[Row]:
        return work.run(items)

    def label(self, work: Case) -> str:
        return f"{work.label} in {work.scenario.name}"

    def replays(self, folder: Path, options: ReportOptions) -> Sequence[ReplayJob]:
        from parkenv.studies.compare.search_replay import search_replay

        return [search_replay(_driven(self.cells()), folder, options)]


class Comparison(CaseStudy):
    """Episode i has the same seed for every agent, hence the same cars at the same times.

    The table gives the mean total time (drive + failed attempts + walk) with its 95 % interval, the paired difference
    to the first agent, and the regret to the clairvoyant bound. Options are shortcuts for an experiment file for
    `parkenv run`.
    """

    heading: ClassVar = "Agents compared"
    table_titles: ClassVar = {"rows": "Results", "occupancy_rows": "By occupancy level"}
    writes: ClassVar = "experiment.json, episodes.csv, summary.json and the figures"
    examples: ClassVar = """
        parkenv compare --scenario campus,jam --failure-cost 10,90 --out results
        parkenv compare --agents "mdp(failure_s=90),belief,oracle" --report
        parkenv compare --agents mdp,mdp-tuned,oracle --failure-cost sweep
        parkenv compare --scenario lots --report
        parkenv compare --lot lot.geojson --occupancy log.csv.gz -n 300
        parkenv compare --resume --episodes 1000
        """

    kind: Literal["compare"] = "compare"
    agents: Annotated[
        Agents, Option(takes="NAME[,...]", parse=split_agents, default=",".join(DEFAULT_AGENTS))
    ] = Field(
        tuple(AgentSpec(name=name) for name in DEFAULT_AGENTS),
        description=f"{AGENTS_HELP} Differences are to the first.",
    )
    scenarios: Scenarios = (scenario_spec("campus"),)
    grid: Grid = Grid()
    episodes: int = option(200, "Episodes of each agent in each setting.", short="-n", ge=1, le=MAX_EPISODES)
    seed: Seed = 0
    rig: Rig = None
    detector: Detector = None
    figures: Figures = True

    @model_validator(mode="after")
    def _bounded(self) -> Self:
        require_distinct_names(self.agents, self.scenarios)
        require_rig(self.rig, self.detector)
        require_at_most(self.episode_count, "agents x scenarios x grid x episodes", "searches")
        return self

    @property
    def episode_count(self) -> int:
        grid = self.grid
        failure, walk, drive = (
            len(axis or [0]) for axis in (grid.failure_s, grid.v_walk_kmh, grid.v_drive_kmh)
        )
        worlds = len(self.scenarios) * (1 + len(grid.constant_forecast)) * (1 + grid.blind)
        settings = (
            failure * walk * drive + (walk if grid.calibrated else 0) + failure * len(grid.occupancy_levels)
        )
        return len(self.agents) * max(len(grid.budget_ms), 1) * worlds * settings * self.episodes

    @cached_property
    def budgeted_agents(self) -> list[AgentSpec]:
        """The agents; those that have the option `budget_ms`, and were not given it, once with each of the grid."""
        from parkenv.studies.compare.cases import BUDGET
        from planners.agent import agent_options

        budgets, agents = self.grid.budget_ms, list[AgentSpec]()
        for agent in self.agents:
            is_timed = budgets and BUDGET not in agent.options and BUDGET in agent_options(agent.name)
            timed = [AgentSpec(name=agent.name, **{**agent.options, BUDGET: ms}) for ms in budgets]
            agents += timed if is_timed else [agent]
        return agents

    @cached_property
    def _base_scenarios(self) -> list[Scenario]:
        from parkenv.scenarios.build import build

        return [build(_seen_through(spec, self.rig)) for spec in self.scenarios]

    @cached_property
    def constant_forecasts(self) -> dict[str, tuple[Scenario, float]]:
        from parkenv.world.occupancy.process import ConstantForecast

        variants = {}
        for p_occupied in self.grid.constant_forecast:
            for scenario in self._base_scenarios:
                name = f"{scenario.name}{CONSTANT_FORECAST}{p_occupied:g}"
                wrong = ConstantForecast(p_occupied, scenario.prior or scenario.occupancy)
                variants[name] = (scenario.replace(name=name, prior=wrong), p_occupied)
        return variants

    @cached_property
    def built(self) -> list[Scenario]:
        from parkenv.scenarios.selection import blind_scenario

        scenarios = self._base_scenarios + [flat for flat, _ in self.constant_forecasts.values()]
        if not self.grid.blind:
            return scenarios
        return [s for scenario in scenarios for s in (scenario, blind_scenario(scenario))]

    @cached_property
    def calibration(self) -> Calibration | None:
        from parkenv.scenarios.calibration import Calibration

        return None if self.grid.calibrated is None else Calibration.from_file(self.grid.calibrated)

    @property
    def seeds(self) -> range:
        return range(self.seed, self.seed + self.episodes)

    def with_options(self, given: Mapping[str, Any], *, resumed: bool) -> Self:
        """See `Study`; a sweep of failure costs has no occupancy levels by default, and also blind searches."""
        grid, sweep = self.grid, given.get("--failure-cost") == "sweep"
        if "--occupancy-levels" not in given and not resumed:
            grid = grid.changed(occupancy_levels=() if sweep else LEVELS)
        if sweep or "--failure-cost" in given:
            grid = grid.changed(blind=sweep)
        return self.changed(grid=grid)

    def check(self) -> None:
        from parkenv.studies.compare.cases import BUDGET, check_worlds, require_distinct

        require_agents(self.agents, self._base_scenarios)
        if self.rig is not None:
            from parkenv.perception.detector_registry import make_detector

            for name in {self.detector or scenario.detector for scenario in self._base_scenarios}:
                make_detector(name)
        names, labels = (
            [scenario.name for scenario in self.built],
            ", ".join(agent.label for agent in self.agents),
        )
        require(
            not self.grid.blind or any(map(_works_blind, self.agents)),
            f"blind searches have no observations, and all agents plan on observations: {labels}; add one that does "
            "not, such as mdp",
        )
        require(
            not self.grid.budget_ms or self.budgeted_agents != list(self.agents),
            f"{BUDGET} is {', '.join(f'{ms:g}' for ms in self.grid.budget_ms)}, and no agent takes it: {labels}; add "
            "one that does, such as belief",
        )
        if repeated := [name for name in names if names.count(name) > 1]:
            raise InputError(
                f"two scenarios are called {repeated[0]!r}, want different names; rename one of them"
            )
        if (measured := self.calibration) is not None and names != [measured.scenario]:
            raise InputError(
                f"{self.grid.calibrated} was measured on {measured.scenario!r}, here are {', '.join(names)}; "
                "compare that scenario alone, neither blind nor with constant forecasts"
            )
        require_distinct(case for case, _ in self.cases)
        for case, seeds in self.cases:
            if _is_person(case.agent):
                from parkenv.studies.play import require_same_worlds

                require_same_worlds(case, seeds)
        for scenario in self.built:
            check_worlds(scenario, self.seeds)

    def settings(self) -> Row:
        return search_settings(self, "rig")

    def cells(self) -> list[Cell]:
        return [*self.cases, *self.occupancy_cases]

    @cached_property
    def cases(self) -> list[Cell]:
        from parkenv.studies.compare.cases import settings_of

        grid, measured, cells = self.grid, self.calibration, list[Cell]()
        for scenario in self.built:
            settings = settings_of(scenario, grid.failure_s, grid.v_walk_kmh, grid.v_drive_kmh)
            if measured is not None:
                settings += settings_of(measured.applied(scenario), v_walk_kmh=grid.v_walk_kmh)
            agents = self._agents_in(scenario)
            cells += [
                Cell(self._case(setting, agent), self.seeds) for setting in settings for agent in agents
            ]
        return cells

    @cached_property
    def occupancy_cases(self) -> list[Cell]:
        """The cases at the occupancy levels, with a sixth of the episodes, at the first speeds of the grid."""
        from parkenv.studies.compare.cases import at_occupancy, settings_of

        failure, walk, drive = self.grid.failure_s, self.grid.v_walk_kmh, self.grid.v_drive_kmh
        return [
            Cell(self._case(setting, agent, level), self.seeds[: max(1, self.episodes // 6)])
            for scenario in self.built
            if scenario.occupancy.adjustable and scenario.name not in self.constant_forecasts
            for level in self.grid.occupancy_levels
            for setting in settings_of(
                at_occupancy(scenario, level), failure, walk and walk[:1], drive and drive[:1]
            )
            for agent in self._agents_in(scenario)
            # Nobody has played in worlds of another occupancy.
            if not _is_person(agent.name)
        ]

    def _agents_in(self, scenario: Scenario) -> list[AgentSpec]:
        blind = scenario.sensor_model == SensorModel.blind()
        return [agent for agent in self.budgeted_agents if not blind or _works_blind(agent)]

    def _case(self, scenario: Scenario, agent: AgentSpec, level: float | None = None) -> Case:
        from parkenv.studies.compare.cases import Case

        return Case(scenario, agent.name, level, self.rig, agent.options, self.detector)

    def prepare(self, results: Results, *, continues: bool) -> None:
        from parkenv.studies.compare.figures import remove_figures

        remove_figures(results.path)

    def summarise(self, results: Results) -> Row:
        from parkenv.studies.compare.cases import table

        episodes, measured = results.rows(self.table), self.calibration
        return {
            "rows": table(self.cases, episodes),
            "occupancy_rows": table(self.occupancy_cases, episodes),
            "calibrated": None if measured is None else dataclasses.asdict(measured),
        }

    def outputs(self, results: Results, summary: Row) -> list[Task[object]]:
        from parkenv.studies.compare.figures import ComparisonResults, draw_figures

        flat = {
            name: (name.partition(CONSTANT_FORECAST)[0], p)
            for name, (_, p) in self.constant_forecasts.items()
        }
        data = ComparisonResults(
            _driven(self.cases),
            results.rows(self.table),
            [row for row in summary["rows"] if row["agent"] != BOUND],
            summary["occupancy_rows"],
            flat,
            self.seed,
        )
        return [partial(draw_figures, data, results.path)]

    @classmethod
    def findings(cls, summary: Row) -> list[str]:
        """See `Study`: the fastest agent of the first setting, and those that the searches cannot tell from it."""

        def setting(row: Row) -> tuple[Any, ...]:
            return row["scenario"], *(row[name] for name in SETTING_AXES)

        first, *_ = rows = summary["rows"]
        agents = [row for row in rows if setting(row) == setting(first) and row["agent"] not in UNBEATEN]

        where = f"On {first['scenario']}, failure cost {first['failure_cost_s']:g} s"
        for axis, what in (("v_walk_kmh", "walking"), ("v_drive_kmh", "driving")):
            if len({row[axis] for row in rows}) > 1:
                where += f", {what} at {first[axis]:g} km/h"
        findings = []
        if len(agents) > 1:
            best, *unsure = sorted(
                (row for row in agents if row["leads"]), key=lambda row: float(row["total_s"])
            )
            named = ", ".join(f"{row['agent']} ({row['total_s']:.1f} s)" for row in unsure)
            searches = plural(best["episodes"], "search", "searches")
            rest = f"{searches} cannot tell {named} from it" if unsure else "all others are slower"
            findings.append(f"{where}, {best['agent']} is fastest ({best['total_s']:.1f} s); {rest}.")
        if (measured := summary.get("calibrated")) is not None:
            findings.append(
                f"Calibrated over {plural(measured['trips'], 'trip')}: failure cost {measured['failure_s']:.4g} s, "
                f"drive {3.6 * measured['v_drive']:.4g} km/h. Parking takes {measured['manoeuvre_s']:.1f} s more for "
                "the manoeuvre into the slot, under either cost; the tables leave that out."
            )
        return findings


def _driven(cells: Sequence[Cell]) -> list[Cell]:
    return [cell for cell in cells if cell.work.agent != BOUND]


def _works_blind(agent: AgentSpec) -> bool:
    return agent.name not in NEEDS_OBSERVATIONS and not _is_person(agent.name)


def _is_person(agent: str) -> bool:
    return agent.startswith(f"{HUMAN}:")


def _seen_through(spec: ScenarioSpec, rig: str | None) -> ScenarioSpec:
    """Return the scenario with the rig's fitted sensor model, unless the scenario names another."""
    model = spec.sensor_model
    is_named = model.name not in (None, "perfect") or model.hit_rate is not None or model.file is not None
    if rig is None or is_named:
        return spec
    measured = SensorModelSpec(name="stereo" if rig == "stereo" else "laser", view_range=model.view_range)
    return spec.changed(sensor_model=measured)
