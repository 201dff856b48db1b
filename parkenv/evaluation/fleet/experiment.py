"""An experiment with many cars: agents, knowledge, shares and demand, all on the same days."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from parkenv.envs.fleet import DriverKind, Fleet
from parkenv.envs.fleet_records import KNOWLEDGE
from parkenv.envs.fleet_rules import RULES
from parkenv.errors import InputError, nearest
from parkenv.evaluation.experiments.agent_spec import AgentSpec
from parkenv.evaluation.experiments.statistics import mean_interval
from parkenv.evaluation.experiments.workers import Workers
from parkenv.evaluation.fleet.measures import MEANS, Roads, day_measures
from parkenv.scenarios.build import build
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.world.demand import ConstantTime, Demand, ExponentialTime, PoissonArrivals
from parkenv.world.scenario import Scenario
from planners.agent import ClairvoyantAgent, make_agent
from planners.names import EXPECTS_RIVALS

Row = dict[str, Any]

OWN, ASSIGNED = "own", "reserve"
SAMPLE_S = 300.0  # time between two samples of the occupancy, s
WITH_INTERVAL = ("total_s", "search_s", "members_s", "others_s")
"""Measures whose summary has a 95 % interval over days."""
DIFFERENCES = {
    "difference_s": "total_s",
    "members_difference_s": "members_s",
    "others_difference_s": "others_s",
}
"""Columns of paired differences, and the measures that are compared."""
_RESAMPLES = 9999


@dataclass(frozen=True)
class Setting:
    """What a row of the summary is about.

    Args:
        agents: agent that drives every car, with any options in brackets.
        knows: what members know, one of `KNOWLEDGE`.
        share: share of the cars that are members; the others know their own observations.
        arrivals_per_hour: cars an hour.
    """

    agents: str
    knows: str
    share: float
    arrivals_per_hour: float

    @property
    def columns(self) -> Row:
        """The columns that identify the row."""
        return {
            "agents": self.agents, "knows": self.knows, "share": self.share,
            "arrivals_per_hour": self.arrivals_per_hour,
        }  # fmt: skip


@dataclass(frozen=True)
class FleetExperiment:
    """Settings, and what they have in common.

    Args:
        scenario: lot, residents, hours of arrival, speeds and costs.
        agents: agents, each of which drives all cars in turn.
        knows: kinds of knowledge.
        shares: shares of the cars that have it.
        arrivals_per_hour: demand.
        days: number of days of each setting; the same arrivals, stays and residents in all.
        seed: seed of the days.
        stay_s: mean of the exponentially distributed stays, s.
        patience_s: time after which a searching car goes elsewhere, s.
        delay_s: age of the live map, s.

    Raises:
        InputError: a value out of its range, or an unknown name.
    """

    scenario: ScenarioSpec
    agents: tuple[str, ...]
    knows: tuple[str, ...] = KNOWLEDGE
    shares: tuple[float, ...] = (1.0,)
    arrivals_per_hour: tuple[float, ...] = (60.0, 120.0, 240.0)
    days: int = 10
    seed: int = 0
    stay_s: float = 3600.0
    patience_s: float = 600.0
    delay_s: float = 0.0

    def __post_init__(self) -> None:
        for name in self.knows:
            if name not in KNOWLEDGE:
                raise InputError(f"knows: there is no knowledge {name!r}; {nearest(name, KNOWLEDGE)}")
        for share in self.shares:
            if not 0.0 <= share <= 1.0:
                raise InputError(f"share is {share:g}, want a number from 0 to 1")
        if self.days < 1:
            raise InputError(f"days is {self.days}, want at least 1")

    def settings(self) -> list[Setting]:
        """Return all settings. Without members only `own` is left: it is not repeated for each share."""
        made = dict.fromkeys(
            Setting(agent, OWN if share == 0.0 else knows, 0.0 if knows == OWN else share, per_hour)
            for per_hour, agent, knows, share in itertools.product(
                self.arrivals_per_hour, self.agents, self.knows, self.shares
            )
        )
        return list(made)

    def demand(self, per_hour: float, scenario: Scenario) -> Demand:
        """Return the demand of a number of arrivals an hour in the hours of the scenario."""
        window = scenario.arrival
        return Demand(
            PoissonArrivals(per_hour, window.start_s, window.end_s),
            ExponentialTime(self.stay_s),
            ConstantTime(self.patience_s),
        )

    def fleet(self, setting: Setting, scenario: Scenario) -> tuple[Fleet, list[Any]]:
        """Return the fleet of a setting, and for each kind of driver its agent, or None if it is compiled."""
        spec = AgentSpec.of(setting.agents)
        rule = None if spec.options else RULES.get(spec.name)
        # Who expects rivals is told how many arrive, as a forecast of traffic would.
        told = {"arrivals_per_hour": setting.arrivals_per_hour} if spec.name == EXPECTS_RIVALS else {}
        agent = None if rule is not None else make_agent(spec.name, scenario, **{**told, **spec.options})
        if isinstance(agent, ClairvoyantAgent):
            raise InputError(
                f"agent {setting.agents!r} knows the future of single searches, and drives no fleet"
            )
        kinds = [
            DriverKind(setting.share, rule, setting.knows, shares=setting.knows == "shared"),
            DriverKind(1.0 - setting.share, rule, OWN),
        ]
        fleet = Fleet(
            scenario,
            self.demand(setting.arrivals_per_hour, scenario),
            background="residents",
            drivers=kinds,
            delay_s=self.delay_s,
            leave_full_lot=False,
        )
        return fleet, [agent, agent]

    def run_day(self, setting: Setting, day: int) -> Row:
        """Run a day of a setting, and return its measures."""
        scenario = build(self.scenario)
        fleet, agents = self.fleet(setting, scenario)
        fleet.reset(self.seed, day)
        window = scenario.arrival
        taken = []
        for second in np.arange(0.0, window.end_s - window.start_s, SAMPLE_S):
            fleet.run(agents, until=fleet.begin + second)
            taken.append(fleet.taken().mean())
        fleet.run(agents)
        members = fleet.cars["kind"] == 0
        measured = day_measures(fleet, Roads(scenario), members, float(np.mean(taken)))
        return {**setting.columns, "day": day, **measured}

    def run(self, workers: Workers, on_day: Callable[[], None] = lambda: None) -> Iterator[list[Row]]:
        """Run all settings; yield the days of each, in order, as soon as they are complete."""
        settings = self.settings()
        tasks = [partial(self.run_day, setting, day) for setting in settings for day in range(self.days)]
        made = workers.in_order(tasks)
        for _ in settings:
            days = []
            for _ in range(self.days):
                days.append(next(made))
                on_day()
            yield days


def summarize_days(settings: Sequence[list[Row]]) -> list[Row]:
    """Return the summary, a row for each setting, from the days of each.

    The *price of anarchy* of a row is the ratio of its mean total time to that of `reserve` for all cars, with the same
    agents and demand; its interval is a bootstrap over days. Differences are paired: to the mean total time of all cars
    on the same days if nobody knows more than what it observes. Both are null where the other setting was not run.
    """
    names = ("agents", "knows", "share", "arrivals_per_hour")
    by_setting = {tuple(days[0][name] for name in names): days for days in settings}

    def alike(days: list[Row], knows: str, share: float) -> list[Row] | None:
        return by_setting.get((days[0]["agents"], knows, share, days[0]["arrivals_per_hour"]))

    return [
        {
            **{name: days[0][name] for name in names},
            "days": len(days),
            "cars": sum(day["cars"] for day in days),
            **_means(days),
            **_differences(days, alike(days, OWN, 0.0)),
            **_price(days, alike(days, ASSIGNED, 1.0)),
        }
        for days in settings
    ]


def _differences(days: list[Row], own: list[Row] | None) -> Row:
    row: Row = {}
    for name, column in DIFFERENCES.items():
        paired = [
            one[column] - other["total_s"] for one, other in zip(days, own or (), strict=own is not None)
        ]
        row[name], low, high = mean_interval([value for value in paired if not math.isnan(value)])
        row[f"{name}_ci95"] = [low, high]
    return row


def _means(days: list[Row]) -> Row:
    row: Row = {}
    for name in MEANS:
        # On a day without members, or without others, there is no mean of theirs.
        values = [day[name] for day in days if not math.isnan(day[name])]
        if name in WITH_INTERVAL:
            row[name], low, high = mean_interval(values)
            row[f"{name}_ci95"] = [low, high]
        else:
            row[name] = float(np.mean(values))
    return row


def _price(days: list[Row], assigned: list[Row] | None) -> Row:
    if assigned is None:
        return {"price_of_anarchy": float("nan"), "price_of_anarchy_ci95": [float("nan")] * 2}
    mine, theirs = (np.array([day["total_s"] * day["cars"] for day in one]) for one in (days, assigned))
    drawn = np.random.default_rng(0).integers(0, len(mine), (_RESAMPLES, len(mine)))
    ratios = mine[drawn].sum(axis=1) / theirs[drawn].sum(axis=1)
    low, high = np.percentile(ratios, [2.5, 97.5])
    return {
        "price_of_anarchy": float(mine.sum() / theirs.sum()),
        "price_of_anarchy_ci95": [float(low), float(high)],
    }
