"""Search for a policy that reaches a town's aims, compared with SFpark's rule and no change."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field

from parkenv.errors import InputError
from parkenv.files.option import option, words_in
from parkenv.scenarios.spec import scenario_spec
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.fields import Figures, OneAgent, OneScenario, Seed, Values
from parkenv.studies.fleet.setting import GIVEN, OWN, Demanded, Setting, middle_of, rate_text, times_demanded
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.policy.spec import Aims, Levers
from parkenv.studies.results import JsonTable, Results, Row, Table
from parkenv.studies.study import Cell, Stage, Study

if TYPE_CHECKING:
    from pathlib import Path

    from parkenv.compiled.arrays import FloatArray
    from parkenv.show.report.page import Page
    from parkenv.studies.policy.town import Policy, PolicyTown
    from parkenv.studies.report import Replay
    from parkenv.studies.runner import Result
    from parkenv.studies.workers import Task
    from parkenv.world.scenario import Scenario

PICTURE = "policy.png"
TODAY, RULE, OURS = "today", "SFpark", "ours"
POLICIES = (TODAY, RULE, OURS)
"""The policies of the answer."""
LEARNING = 4
"""Rounds in which drivers learn the policies that are compared."""
HELD_OUT = (0.9, 1.0, 1.1)
"""Default demands of the held-out days, times that of the search."""


class Trial(NamedTuple):
    """A policy that is tried."""

    method: str  # what proposed it
    round: int
    number: int  # in the round
    policy: Policy

    @property
    def columns(self) -> Row:
        """Columns that identify it."""
        return {"method": self.method, "round": self.round, "number": self.number}


def _tried(row: Row) -> Row:
    if np.array(row["occupancy"], np.float64).ndim != 2:
        raise ValueError(row["occupancy"])
    np.array(
        [row["cruised_km"], row["time_s"], row["revenue"], *row["purpose_s"], *row["taken"][0]], np.float64
    )
    return row


TRIALS = JsonTable("trials.jsonl", ("method", "round", "number", "day"), _tried, "day of a policy")
"""Days of policies that were tried; see `PolicyTown.day`."""


class PolicyStudy(Study):
    """Find the policy of a town that is nearest to its aims, and evaluate it on held-out days and demands.

    All policies are simulated on the same days. First the town as it is today, and the rounds of SFpark's rule; then
    prices that follow the occupancy in decreasing steps (stochastic approximation; Robbins and Monro 1951, averaged as
    by Polyak and Juditsky 1992); then an evolution strategy for noisy and expensive functions (CMA-ES with margin;
    Hamano et al. 2022), which changes the prices of each zone and hour, and every other lever. The candidate that is
    best on further days is ours.
    """

    table: ClassVar[Table] = TRIALS
    block: ClassVar = 1
    doing: ClassVar = "Trying policies"
    unit: ClassVar = "days"
    heading: ClassVar = "Policy for a town"
    table_titles: ClassVar = {
        "answer": "The answer, on held-out days",
        "losers": "Gains and losses against today",
        "policy_blocks": "Block by block: spaces taken and prices, today and with this policy",
        "assumed": "What was assumed",
    }

    kind: Literal["policy"] = "policy"
    scenario: OneScenario = Field(default_factory=lambda: scenario_spec("town"))
    agent: OneAgent = AgentSpec(name="usual")
    aims: Aims = Aims()
    levers: Levers = Levers()
    arrivals_per_hour: Values[Demanded] = option(
        (GIVEN,),
        "Demands of the search, on alternating days: given (the scenario's), 1.2x, or cars an hour.",
        takes="given|1.2x[,...]",
        panel="Demand",
        parse=words_in,
    )
    held_out: Values[Demanded] | None = option(
        None,
        "Demands at which the answer is evaluated.",
        takes="1.1x[,...]",
        panel="Demand",
        parse=words_in,
        default="0.9, 1 and 1.1 times the first one of the search",
    )
    budget: int = option(400, "Days that the search may simulate.", ge=20, le=1_000_000)
    days_each: int = option(2, "Days for each trial of a policy.", ge=1, le=1_000)
    rounds: int = option(
        10, "Rounds of SFpark's rule; the city changed prices ten times in two years.", ge=1, le=1_000
    )
    learns: bool = option(
        True,
        "Whether drivers learn the occupancy of each block by hour under a policy, if the "
        "scenario has a log; else they expect the occupancy of its days.",
    )
    episodes: int = option(6, "Held-out days of each demand.", short="-n", ge=1, le=10_000)
    seed: Seed = 0
    figures: Figures = True

    @property
    def all_tables(self) -> tuple[Table, ...]:  # type: ignore[override]
        """See `Study`."""
        return (TRIALS, *FleetStudy().all_tables)

    @cached_property
    def town(self) -> PolicyTown:
        """The town and its levers.

        Raises:
            InputError: see `PolicyTown`.
        """
        from parkenv.scenarios.build import build
        from parkenv.studies.policy.town import PolicyTown

        return PolicyTown(build(self.scenario), self.levers, self.aims)

    def check(self) -> None:
        """See `Study`."""
        from parkenv.studies.policy.town import Policy

        if self.town.scenario.demand is None:
            raise InputError(f"{self.scenario.source}: has no demand, want tables such as [demand.shoppers]")
        _ = self.town.columns
        for pick in range(max((len(its) for its in self.levers.choices.values()), default=1)):
            its = tuple(min(pick, len(one) - 1) for one in self.levers.choices.values())
            self._fleet(Policy(self.town.today, its), 0)

    def settings(self) -> Row:
        """See `Study`."""
        from parkenv.studies.fingerprints import flat_tables, search_settings

        more = ("arrivals_per_hour", "budget", "days_each", "rounds", "learns", "seed")
        tables = {name: getattr(self, name).model_dump(mode="json") for name in ("aims", "levers")}
        return search_settings(self, *more) | {"agent": self.agent.label} | flat_tables(tables)

    def _fleet(self, policy: Policy, day: int) -> Any:
        from parkenv.studies.fleet.drivers import demand_in, guided_fleet

        rate = self.arrivals_per_hour[day % len(self.arrivals_per_hour)]
        arrays = (None if its is None else its.tobytes() for its in (policy.prices, policy.expects))
        key = *arrays, policy.picks, rate
        if self.town.fleet is not None and self.town.fleet[0] == key:
            return self.town.fleet[1]
        scenario, guidance = self.town.with_policy(policy), (self.levers.guidance, self.town.guided(policy))
        demand = demand_in(scenario, rate, scenario.stay_s, np.inf)
        self.town.fleet = key, guided_fleet(self.agent, scenario, demand, guidance, rate)
        return self.town.fleet[1]

    def run(self, work: Trial, items: Sequence[int]) -> list[Row]:
        """See `Study`."""
        rows = []
        for day in items:
            fleet, agent = self._fleet(work.policy, day)
            fleet.reset(self.seed, day)
            rows.append({**work.columns, "day": day, **self.town.day(fleet, [agent, agent])})
        return rows

    def label(self, work: Trial) -> str:
        """See `Study`."""
        return work.method

    # ---- the search

    def stages(self, results: Results) -> Iterator[Stage]:
        """See `Study`: every stage proposes from the rows of those before, so that a resumed run is an unbroken one."""
        search = Search(self, results)
        yield from search.stages()
        results.kept["policies"] = chosen = search.chosen
        results.kept["tried"] = search.tried
        held_out = self.held_out_study({name: self._answer(policy) for name, policy in chosen.items()})
        yield Stage("Driving held-out days", held_out, held_out.cells())

    def _answer(self, policy: Policy) -> Row:
        """Return what a policy is, in plain values."""
        picked = {
            name: list(its) if isinstance(its, tuple) else its
            for name, its in self.town.picked(policy).items()
        }
        is_open = self.town.is_open(policy)
        shut = [self.town.blocks.names[i] for i in self.town.counted[~is_open]]
        return {
            "zones": self.town.tables(policy),
            "picked": picked,
            "guided": self.town.guided(policy),
            "expects": None if policy.expects is None else policy.expects.round(4).tolist(),
            "closed": shut,
        }

    def held_out_study(self, policies: Mapping[str, Row]) -> HeldOut:
        """Return the study of held-out days, from `policies` of the summary."""
        scenarios = []
        for name, its in policies.items():
            zones = {**self.scenario.tables().get("zones", {})}
            for zone, table in its["zones"].items():
                zones[zone] = zones.get(zone, {}) | table
            scenarios.append(self.scenario.changed(name=name, zones=zones))
        first = self.arrivals_per_hour[0]
        times = times_demanded(first) if isinstance(first, str) else first
        unit = "x" if isinstance(first, str) else ""
        demands = self.held_out or tuple(f"{factor * times:g}{unit}" for factor in HELD_OUT)
        return HeldOut(
            scenarios=tuple(scenarios),
            agents=(self.agent,),
            arrivals_per_hour=demands,
            days=self.episodes,
            seed=(self.seed + 1) % 2**31,
            guided=tuple(its["guided"] for its in policies.values()),
            expects=tuple(its.get("expects") for its in policies.values()),
            guidance=self.levers.guidance,
            jobs=self.jobs,
        )

    # ---- the answer

    def summarise(self, results: Results) -> Row:
        """See `Study`."""
        from parkenv.studies.policy.answer import answer_rows, assumed_rows, block_rows, driven, loser_rows

        policies = results.kept.get("policies")
        if policies is None:
            return {"rows": []}
        told = {name: self._answer(policy) for name, policy in policies.items()}
        held_out = self.held_out_study(told)
        days = driven(held_out, results)
        return {
            **held_out.summarise(results),
            "answer": answer_rows(self, days, told),
            "losers": loser_rows(days, held_out.built),
            "policy_blocks": block_rows(self, days, held_out.middle_rate, told),
            "assumed": assumed_rows(self, held_out),
            "tried": results.kept["tried"],
            "aims": self.aims.model_dump(mode="json"),
            "policies": told,
        }

    def outputs(self, result: Result) -> list[Task[object]]:
        """See `Study`: maps before and after, a page with the days on a map, and a scenario file for each policy."""
        from functools import partial

        from parkenv.show.figures.policy import save_policy_maps
        from parkenv.studies.fleet.blocks import TABLES
        from parkenv.studies.fleet.day_map import write_map_page

        held_out = self.held_out_study(result.summary["policies"])
        tasks: list[Task[object]] = [
            partial(spec.write, result.folder / f"{spec.name}.json") for spec in held_out.scenarios
        ]
        rows = {table.file: list(result.results.rows(table).values()) for table in TABLES}
        tasks.append(partial(write_map_page, held_out, result.summary, rows, result.folder))
        if blocks := result.summary["policy_blocks"]:
            of_block = np.full(len(self.town.blocks.names), -1)
            of_block[self.town.counted] = np.arange(len(blocks))
            of_slot = of_block[self.town.blocks.of_slot]

            def by_slot(column: str) -> FloatArray:
                values = np.array([*(row[column] for row in blocks), np.nan], np.float64)
                return np.asarray(values[of_slot])

            title = (
                f"{self.scenario.title}, {self.aims.hours}, {rate_text(held_out.middle_rate)}, held-out days"
            )
            panels = [(name, by_slot(f"taken_{name}")) for name in result.summary["policies"]]
            price = "ours: mean price of an hour", by_slot("price_ours")
            path = result.folder / PICTURE
            tasks.append(
                partial(save_policy_maps, self.town.scenario.lot, panels, self.aims.band, price, title, path)
            )
        return tasks

    @classmethod
    def findings(cls, summary: Row) -> list[str]:
        """See `Study`."""
        from parkenv.studies.policy.answer import sentences

        return sentences(summary)

    @classmethod
    def page(cls, summary: Row, folder: Path) -> Page:
        """See `Study`."""
        from parkenv.show.report.page import Page
        from parkenv.show.report.tables import OF_POLICIES, tables_of
        from parkenv.studies.policy.answer import headlines, middle_only

        del folder
        shown = {**summary, "losers": middle_only(summary)}
        tables = tables_of(shown, cls.table_titles, OF_POLICIES)
        return Page(cls.heading, cls.findings(summary), tables, headlines=headlines(summary))

    def replays(self, folder: Path) -> Sequence[Replay]:
        """See `Study`: maps before and after."""
        from parkenv.files.limited_reading import read_json
        from parkenv.studies.fleet.day_map import DayMaps
        from parkenv.studies.results import SUMMARY

        return [DayMaps(self.held_out_study(read_json(folder / SUMMARY)["policies"]), folder)]


class HeldOut(FleetStudy):
    """Days of several policies, each with guidance of its own, and what its drivers expect."""

    guided: tuple[float, ...] = ()
    guidance: str = "shared"
    expects: tuple[list[list[float]] | None, ...] = ()

    @cached_property
    def built(self) -> dict[str, Scenario]:
        """See `FleetStudy`."""
        from parkenv.studies.fleet.blocks import Blocks
        from parkenv.studies.policy.town import expecting

        built = super().built
        blocks = Blocks.of(built[TODAY].lot)
        return {
            name: expecting(one, blocks, None if expects is None else np.array(expects))
            for (name, one), expects in zip(built.items(), self.expects, strict=True)
        }

    @cached_property
    def fleet_settings(self) -> list[Setting]:
        """See `FleetStudy`."""
        return [
            Setting(name, self.drivers[0], self.guidance if share else OWN, share, rate)
            for rate in self.demands
            for name, share in zip(self.built, self.guided, strict=True)
        ]

    @property
    def middle_rate(self) -> float | str:
        """The demand that maps are about; see `middle_of`."""
        return middle_of(self.demands)

    @property
    def shown_settings(self) -> list[Setting]:
        """See `FleetStudy`."""
        return [one for one in self.fleet_settings if one.arrivals_per_hour == self.middle_rate]


class Search:
    """The search for a policy: what is tried next follows from what was found, in the order of the rounds.

    Args:
        study: aims, levers and budget.
        results: where the rows are.

    Attributes:
        tried: a row for each round: what it reached.
        chosen: the policies that are told, by their names, when all stages are over.
    """

    def __init__(self, study: PolicyStudy, results: Results) -> None:
        self.study, self.town, self._results = study, study.town, results
        self._learns = study.learns and study.town.has_log
        self.tried: list[Row] = []
        self._used = self._day = 0
        self._today: list[Row] = []
        self._found: dict[str, Policy] = {}
        self.chosen: dict[str, Policy] = {}

    def stages(self) -> Iterator[Stage]:
        """Yield the rounds."""
        from parkenv.studies.policy.town import Policy

        days, today = 2 * self.study.days_each, Policy()
        self._today = yield from self._days(TODAY, 0, [today], days, found=True)
        if self._learns:
            today = today.learned(self._today, 1.0)
            self._today = yield from self._days(TODAY, 1, [today], days, found=True)
        self._found[TODAY] = self._learned(today, self._today, 0.5)
        yield from self._rule()
        if self.study.aims.in_band:
            yield from self._balance()
        yield from self._evolve()
        if self._learns:
            yield from self._learn()
        yield from self._choose()

    def _learned(self, policy: Policy, days: Sequence[Row], weight: float) -> Policy:
        """Return a policy with drivers who also know these days of it, or as it is if drivers do not learn."""
        return policy.learned(days, weight) if self._learns else policy

    def _learn(self) -> Iterator[Stage]:
        """Yield rounds in which drivers learn all policies that were found."""
        for number in range(LEARNING):
            names = list(self._found)
            yield from self._days("learning", number, list(self._found.values()), self.study.days_each)
            for name, rows in zip(names, self._rows, strict=True):
                self._found[name] = self._found[name].learned(rows, 1.0 / (number + 3))

    def _days(
        self, method: str, number: int, policies: Sequence[Policy], days: int, *, found: bool = False
    ) -> Generator[Stage, None, list[Row]]:
        """Yield a stage in which policies are tried on the same new days; return their rows, the first one's alone."""
        items = range(self._day, self._day + days)
        self._day, self._used = items.stop, self._used + days * len(policies)
        trials = [Trial(method, number, k, policy) for k, policy in enumerate(policies)]
        cells = [Cell(trial, items) for trial in trials]
        yield Stage(f"{method}, round {number + 1}" if not found else method, self.study, cells)
        self._rows = [self._results.of(self.study, cell) for cell in cells]
        return self._rows[0]

    def _measures(self, rows: Sequence[Row], policy: Policy, today: Sequence[Row] = ()) -> Row:
        return self.town.measures(rows, self.town.is_open(policy), today or self._today)

    def _score(self, measures: Row) -> float:
        """Return what aims lack, and a little of what is beyond them: the lower the better."""
        lacks = self.town.lacks(measures).values()
        return sum(max(lack, 0.0) + 0.01 * lack for lack in lacks)

    def _note(self, method: str, number: int, measures: Row) -> None:
        score = self._score(measures)
        self.tried.append(
            {"method": method, "round": number + 1, "days": self._used, "score": score, **measures}
        )

    def _occupancy(self, rows: Sequence[Row]) -> FloatArray:
        """Return the occupancy of each unit in each band, (n_units, n_bands), mean over its blocks and the days."""
        town = self.town
        share = np.mean([row["occupancy"] for row in rows], axis=0)
        slots = town.blocks.slots[town.counted].astype(float)
        hours = [[k for k, hour in enumerate(town.hours) if hour in band] for band in self.study.levers.bands]
        by_band = np.stack(
            [share[:, its].mean(axis=1) if its else np.full(len(share), np.nan) for its in hours], axis=1
        )
        total = np.zeros((len(town.units), len(hours)))
        np.add.at(total, town.unit_of_block, by_band * slots[:, None])
        return total / np.bincount(town.unit_of_block, slots, len(town.units))[:, None]

    def _rule(self) -> Iterator[Stage]:
        """Yield the rounds of SFpark's rule, which ends with the prices of the last one.

        Above 80 % the price of a block and band rises by a step, from 30 to 60 % it falls by one, and below 30 % by two
        (SFMTA, SFpark pilot project evaluation, 2014; Pierce and Shoup 2013).
        """
        from parkenv.studies.policy.town import Policy

        prices, step = self.town.posted(self.town.today), self.study.levers.rule_step
        expects = self._found[TODAY].expects
        for number in range(self.study.rounds):
            policy = Policy(prices, expects=expects)
            rows = yield from self._days(RULE, number, [policy], self.study.days_each)
            self._found[RULE] = policy
            self._note(RULE, number, self._measures(rows, policy))
            share = self._occupancy(rows)
            change = np.select([share > 0.8, share < 0.3, share < 0.6], [step, -2 * step, -step], 0.0)
            prices = self.town.posted(prices + change)
            expects = self._learned(policy, rows, 0.5).expects

    def _balance(self) -> Iterator[Stage]:
        """Yield rounds in which prices follow occupancy to the middle of the band in smaller and smaller steps.

        They have half of what is left of the budget, without other levers three quarters; the means over the later half
        of the rounds are what was found. Drivers who learn do so with the same weights: were they to expect no more
        than the last days, all would go where it was empty.
        """
        from parkenv.studies.policy.town import Policy

        each, levers, aim = self.study.days_each, self.study.levers, float(np.mean(self.study.aims.band))
        share = 0.5 if levers.choices else 0.75
        rounds = max(int(share * (self.study.budget - self._used)) // each, 2)
        prices, expects, later = self.town.today, self._found[TODAY].expects, []
        for number in range(rounds):
            policy = Policy(prices, expects=expects)
            rows = yield from self._days("balance", number, [policy], each)
            self._note("balance", number, self._measures(rows, policy))
            taken = self._occupancy(rows)
            # A full block says nothing of how many more would come.
            excess = np.nan_to_num(np.where(taken > 0.97, 1.2, taken) - aim)
            weight = 1.0 / (1 + number) ** 0.75
            prices = np.clip(prices + 2 * levers.spread * excess * weight, 0.0, levers.most)
            expects = self._learned(policy, rows, weight).expects
            if 2 * number >= rounds:
                later.append((prices, expects))
        mean = [None if its[0] is None else np.mean(its, axis=0) for its in zip(*later, strict=True)]
        self._found["balance"] = Policy(mean[0], expects=mean[1])

    def _evolve(self) -> Iterator[Stage]:
        """Yield generations of the evolution strategy, which starts from the best that was found."""
        from cmaes import CMAwM

        from parkenv.studies.policy.town import Policy

        balanced = self._found.get("balance")
        base = self.town.today if balanced is None or balanced.prices is None else balanced.prices
        expects = (balanced or self._found[TODAY]).expects
        levers, choices = self.study.levers, self.study.levers.choices
        zones = list(dict.fromkeys(zone for zone, _ in self.town.units))
        of_unit = [zones.index(zone) for zone, _ in self.town.units]
        n_shifts = len(zones) * len(levers.hours)
        most = levers.most / levers.spread
        bounds = np.array([(-most, most)] * n_shifts + [(0, len(its) - 1) for its in choices.values()], float)
        steps = np.array([0.0] * n_shifts + [1.0] * len(choices))
        if len(bounds) < 2:
            bounds, steps = np.vstack([bounds, [(-1.0, 1.0)]]), np.append(steps, 0.0)  # it needs two
        # Balanced prices are near to the best: 50 cents more empty a zone.
        sigma = 1.0 if balanced is None else 0.2
        strategy = CMAwM(np.zeros(len(bounds)), sigma, bounds, steps, seed=self.study.seed)

        def policy_of(x: FloatArray) -> Policy:
            shift = x[:n_shifts].reshape(len(zones), -1)[of_unit] * levers.spread
            picks = tuple(round(k) for k in x[n_shifts : n_shifts + len(choices)])
            return Policy(np.clip(base + shift, 0.0, levers.most), picks, expects)

        each, size = self.study.days_each, strategy.population_size
        number = 0
        while self._used + each * size <= self.study.budget and not strategy.should_stop():
            asked = [strategy.ask() for _ in range(size)]
            policies = [policy_of(x) for x, _ in asked]
            yield from self._days("evolution", number, policies, each)
            measures = [
                self._measures(rows, policy) for rows, policy in zip(self._rows, policies, strict=True)
            ]
            scores = [self._score(one) for one in measures]
            best = int(np.argmin(scores))
            self._note("evolution", number, measures[best])
            strategy.tell([(x, score) for (_, x), score in zip(asked, scores, strict=True)])
            self._found["evolution, best"] = policies[best]
            number += 1
        if number:
            self._found["evolution"] = policy_of(np.asarray(strategy.mean))

    def _choose(self) -> Iterator[Stage]:
        """Yield the days on which everything that was found is compared."""
        names = list(self._found)
        yield from self._days("choice", 0, list(self._found.values()), 4 * self.study.days_each, found=True)
        scores = {}
        for name, rows in zip(names, self._rows, strict=True):
            measures = self._measures(rows, self._found[name], self._rows[0])
            scores[name] = self._score(measures)
            self._note(f"choice: {name}", 0, measures)
        ours = min(scores, key=lambda name: scores[name])
        self.chosen = {TODAY: self._found[TODAY], RULE: self._found[RULE], OURS: self._found[ours]}
