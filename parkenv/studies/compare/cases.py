"""Compare agents in the same worlds: run their episodes in parallel and summarise them."""

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from parkenv.belief.slot_belief import SlotBelief
from parkenv.compiled.keyed_random import world_key
from parkenv.engine.search_record import SearchRecord
from parkenv.errors import InputError, require
from parkenv.files.known_names import UNBEATEN
from parkenv.scenarios.selection import seeds_by_scenario
from parkenv.studies.episodes import EpisodeRunner
from parkenv.studies.fields import AgentSpec, label_of
from parkenv.studies.results import EPISODES, SETTING_COLUMNS, Key, Row, decision_s
from parkenv.studies.statistics import (
    LEAST_PAIRS,
    columns_of,
    mean_interval,
    mean_over_days,
    paired_differences,
    summarize,
)
from parkenv.studies.workers import Workers
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.scenario import KMH, Scenario
from parkenv.world.sensor_model import SensorModel
from parkenv.world.week import DAY_S
from planners.agent import make_agent, shown_name
from planners.belief.agent import BeliefAgent
from planners.belief.best_path import is_compiled
from planners.names import BOUND
from planners.thesis.replanning import StaticAgent

BUDGET = "budget_ms"  # the option of agents that plan for a time, ms a decision
BLOCK = 50  # episodes per task of searches that are not saved


@dataclass(frozen=True, eq=False)
class Case:
    """One agent in one scenario, with the costs and speeds of one setting."""

    scenario: Scenario  # the scenario, with the setting's costs and speeds
    agent: str
    occupancy_level: float | None = None  # mean occupancy of the world; None for the scenario's own
    # simulated sensors that observe the slots; None to use the scenario's sensor model
    rig: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)  # options of the agent, for `make_agent`
    # detector for the rig's images, for `make_detector`; None for the packaged one
    detector: str | None = None
    every: float | None = None  # least distance between the rig's captures, m; None for the environment's

    @property
    def label(self) -> str:
        return label_of(shown_name(self.agent), dict(self.options))

    @property
    def planner(self) -> str:
        options = {name: value for name, value in self.options.items() if name != BUDGET}
        return label_of(shown_name(self.agent), options)

    @property
    def columns(self) -> Row:
        return {
            "scenario": self.scenario.name,
            "occupancy_level": self.occupancy_level,
            "agent": self.label,
            "failure_cost_s": float(self.scenario.failure_s),
            "v_walk_kmh": round(self.scenario.v_walk / KMH, 6),
            "v_drive_kmh": round(self.scenario.v_drive / KMH, 6),
        }

    def key(self, seed: int) -> tuple[Any, ...]:
        return EPISODES.key({**self.columns, "seed": seed})

    def run(self, seeds: Sequence[int]) -> list[Row]:
        runner = self.runner()
        if isinstance(runner.agent, BeliefAgent) and not is_compiled():
            # First runs: workers that all begin with the environment would wait for the one that compiles it.
            runner.agent.compile_ahead(_forecast_of(self.scenario, seeds[0]))
        return [{**self.columns, **runner.row(seed)} for seed in seeds]

    def runner(self) -> EpisodeRunner:
        agent = make_agent(self.agent, self.scenario, **self.options)
        return EpisodeRunner(self.scenario, self.label, agent, self.rig, self.detector, self.every)


def _forecast_of(scenario: Scenario, seed: int) -> SlotBelief:
    forecast = scenario.forecast(scenario.occupancy.draw_arrival(scenario.arrival, world_key(seed, 0)))
    days = forecast.day_error.level, forecast.day_error.slope
    return SlotBelief.of_forecast(forecast.p_occupied, forecast.decay_rate, days)


def require_distinct(cases: Iterable[Case]) -> None:
    """Check that no two cases would share their rows, as two of a user's agents with the same `name` would."""
    counts = Counter(tuple(case.columns.values()) for case in cases)
    if counts and (most := counts.most_common(1)[0])[1] > 1:
        raise InputError(f"two agents are called {most[0][2]!r}, want different names")


def settings_of(
    scenario: Scenario,
    failure_s: Sequence[float] | None = None,
    v_walk_kmh: Sequence[float] | None = None,
    v_drive_kmh: Sequence[float] | None = None,
) -> list[Scenario]:
    """Return the scenario in every combination of failure cost, s, and speeds, km/h; None keeps its own value."""
    axes = [
        [{"failure_s": value} for value in failure_s or ()],
        [{"v_walk": value * KMH} for value in v_walk_kmh or ()],
        [{"v_drive": value * KMH} for value in v_drive_kmh or ()],
    ]
    return [
        scenario.replace(**failure, **walk, **drive)
        for failure, walk, drive in itertools.product(*(axis or [{}] for axis in axes))
    ]


def at_occupancy(scenario: Scenario, level: float) -> Scenario:
    """Return the scenario with a mean occupancy of `level` at the middle of its arrival window, on its first day."""
    window = scenario.arrival
    middle = (window.start_s + window.end_s) / 2
    # Occupancy differs between days, so the level can hold on one day only.
    day = window.weekdays[0]
    moment = ArrivalWindow((day,), middle, middle)

    def adjusted(model: Any) -> Any:
        if model is None:
            return None
        require(
            model.adjustable,
            f"scenario {scenario.name!r}: a {type(model).__name__} cannot be made {level:.0%} full",
        )
        return model.at_mean_occupancy(level, day * DAY_S + middle)

    return scenario.replace(
        arrival=moment, occupancy=adjusted(scenario.occupancy), prior=adjusted(scenario.prior)
    )


def rows_of(
    agents: Sequence[AgentSpec],
    scenarios: Scenario | Sequence[Scenario],
    seeds: Sequence[int],
    workers: Workers,
    name: str | None = None,
) -> list[Row]:
    """Run searches without saving them, and return the `table` row of each agent.

    Of several scenarios each seed draws one as the environment does; `name` stands for them in the rows.
    """
    several = [scenarios] if isinstance(scenarios, Scenario) else scenarios
    work: list[tuple[Case, Sequence[int]]] = []
    for scenario, drawn in zip(several, seeds_by_scenario(seeds, len(several)), strict=True):
        cases = [Case(scenario, agent.name, options=agent.options) for agent in agents]
        require_distinct(cases)
        work += [(case, drawn[i : i + BLOCK]) for case in cases for i in range(0, len(drawn), BLOCK)]
    episodes: dict[str, list[Row]] = {case.label: [] for case in cases}
    for number, rows in workers.results([partial(case.run, block) for case, block in work]):
        episodes[work[number][0].label] += rows
    by_seed = {label: sorted(rows, key=lambda row: row["seed"]) for label, rows in episodes.items()}
    first = by_seed[cases[0].label]
    columns = {"scenario": several[0].name if name is None else name}
    return [
        summarize(case.columns | columns, by_seed[case.label], None if i == 0 else first)
        for i, case in enumerate(cases)
    ]


def plan_searches(
    settings: Sequence[Scenario], agent: AgentSpec, seed: int
) -> tuple[list[Row], list[SearchRecord]]:
    """Plan and run a search in each setting, by an agent that makes a plan: mdp or mdp-static.

    Return a row for each, with expected and total time, s, and the path; and the searches, for pictures.
    """
    rows, searches = list[Row](), list[SearchRecord]()
    for setting in settings:
        case = Case(setting, agent.name, options=agent.options)
        runner = case.runner()
        if not isinstance(runner.agent, StaticAgent):
            raise InputError(f"--agents {agent.label!r} makes no plan; known: mdp, mdp-static")
        search = runner.run(seed)
        expected = float(runner.agent.expected_time(search.forecast)[search.path[0]])
        ids, n = setting.lot.slot_ids, setting.lot.n_slots
        path = [ids[v] if v < n else f"junction {v}" for v in search.path]
        rows.append({
            **case.columns, "expected_s": expected, "slot": path[-1] if search.metrics["parked"] else "",
            **search.metrics, "path": path, "occupancy": float(np.mean(search.occupied)),
        })  # fmt: skip
        searches.append(search)
    return rows, searches


def check_worlds(scenario: Scenario, seeds: Sequence[int]) -> None:
    days = set()
    for seed in seeds:
        key = world_key(seed, 0)
        arrival = scenario.occupancy.draw_arrival(scenario.arrival, key)
        if arrival.day not in days:
            days.add(arrival.day)
            scenario.forecast(arrival)
            scenario.occupancy.world(key, arrival)


def table(cells: Iterable[tuple[Case, Sequence[int]]], finished: Mapping[Key, Row]) -> list[Row]:
    """Return a row for every case with finished episodes, in order; differences are to the first agent.

    If some agents plan for a given time, `planner` and `budget_ms` tell the two apart. If `bound` is among the agents,
    `gap_to_bound` is the relative excess of an agent's mean time over its.
    """
    rows, cells = [], list(cells)
    by_setting: dict[tuple[Any, ...], list[tuple[Row, list[Row]]]] = {}
    timed = any(BUDGET in case.options for case, _ in cells)
    blind = {case.scenario.name: case.scenario.sensor_model == SensorModel.blind() for case, _ in cells}
    for case, seeds in cells:
        episodes = [finished[key] for s in seeds if (key := case.key(s)) in finished]
        if not episodes:
            continue
        columns = case.columns
        setting = tuple(v for k, v in columns.items() if k != "agent")
        times = list(itertools.chain.from_iterable(decision_s(row) for row in episodes))
        agents = by_setting.setdefault(setting, [])
        rows.append(summarize(columns, episodes, agents[0][1] if agents else None, times))
        if timed:
            rows[-1] |= {"planner": case.planner, BUDGET: case.options.get(BUDGET)}
        if any(blind.values()):
            rows[-1]["blind"] = blind[case.scenario.name]
        agents.append((rows[-1], episodes))
    for agents in by_setting.values():
        _mark_leaders(agents)
    names = [c for c in SETTING_COLUMNS if c != "agent"]
    bounds = {tuple(r[c] for c in names): r["total_s"] for r in rows if r["agent"] == BOUND}
    for row in rows:
        bound = bounds.get(tuple(row[c] for c in names))
        if bound is not None:
            row["gap_to_bound"] = row["total_s"] / bound - 1.0
    return rows


def _mark_leaders(agents: Sequence[tuple[Row, list[Row]]]) -> None:
    """Set `leads` in the rows of a setting, given with their episodes.

    An agent leads unless the 95 % interval of its paired difference to the lowest mean lies above 0. Several lead where
    the searches cannot tell them apart. The oracle and the bound are no competitors.
    """
    acting = [agent for agent in agents if agent[0]["agent"] not in UNBEATEN] or agents[:1]
    _, best = min(acting, key=lambda agent: float(agent[0]["total_s"]))
    for row, episodes in agents:
        behind, days = paired_differences(episodes, best)
        shown = len(behind) >= LEAST_PAIRS and mean_over_days(behind, days)[1] > 0.0
        row["leads"] = row["agent"] not in UNBEATEN and not shown


def against_occupancy(rows: Sequence[Mapping[str, Any]], edges: Sequence[float]) -> list[Row]:
    """Return the mean total times of episodes in bins of the occupancy at arrival, which have ascending edges."""
    bins: dict[tuple[Any, ...], list[Mapping[str, Any]]] = defaultdict(list)
    for row in rows:
        number = int(np.searchsorted(edges, row["occupancy"], side="right")) - 1
        if 0 <= number < len(edges) - 1:
            bins[row["agent"], row["failure_cost_s"], number].append(row)
    result = []
    for (agent, failure, _), inside in sorted(bins.items(), key=lambda item: item[0][1:]):
        occupancy = float(np.mean([r["occupancy"] for r in inside]))
        row = {"agent": agent, "failure_cost_s": failure, "occupancy": occupancy, "episodes": len(inside)}
        result.append(row | columns_of("total_s", mean_interval([r["total_s"] for r in inside])))
    return result
