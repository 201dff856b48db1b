"""Benchmark suites: fixed scenarios, seeds and metrics that make results of different groups comparable.

A suite is a JSON file in the folder `suites`. The places of a suite, real car parks, are a suite of their own
(`v2-places`), so that a result of either part can be complete. A published suite never changes; improvements go into a
new suite. A result file names its suite, contains the total time of every search, and can be checked by anybody.

The searches of `v3` are a stratified sample of a population of worlds for each task: more of them where the times of
agents differ most, such as on full days, each with its weight. The means of the clairvoyant bound and of the occupancy
at arrival are known for the whole population, and serve as control variates (`choose_searches` made it).
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.files.limited_reading import read_json
from parkenv.lots.lot_files import PLACES
from parkenv.scenarios.build import make_scenario
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.cases import Case, at_occupancy, require_distinct
from parkenv.studies.episodes import EpisodeRunner
from parkenv.studies.statistics import Estimate, stratified_estimate
from parkenv.studies.study import Cell
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.day_error import DayError
from parkenv.world.scenario import KMH, Scenario
from parkenv.world.sensor_model import SensorModel
from planners.agent import make_agent

SUITES = ("v1", "v2", "v2-places", "v3")
CONTROLS = ("bound_s", "occupancy")
"""Columns of an episode that its world alone determines: the control variates."""
SUITE_FOLDER = Path(__file__).parent / "suites"


@dataclass(frozen=True)
class Stratum:
    """A part of the population of a task's worlds, such as its full days."""

    share: float  # in the population
    seeds: tuple[int, ...]  # the searches
    means: tuple[float, ...]  # of `CONTROLS`, over the part's whole population


@dataclass(frozen=True)
class Task:
    """One scenario of a suite."""

    name: str  # name of the task
    scenario: str  # a packaged scenario, or the name of a file in `parkenv.lots.lot_files.PLACES`
    occupancy_level: float | None = None  # mean occupancy of the world; None for the scenario's own
    # `perfect`, or the rig whose fitted sensor model is used; `sight` in the suite's file
    sensor_model: str = "perfect"
    v_walk_kmh: float | None = None  # walking speed; None for the scenario's own
    # how far days differ from the forecast, logits: (level,) or (level, slope)
    day_error: tuple[float, ...] = (0.0,)
    group: str | None = None  # kind of place, for tables; None in suites of packaged scenarios
    strata: tuple[Stratum, ...] = ()  # parts of the population; none if the searches are a plain sample

    def made(self, arrival: ArrivalWindow) -> Scenario:
        """Make the scenario, named after the task."""
        days = DayError(*self.day_error)
        source = self.scenario if self.group is None else PLACES / f"{self.scenario}.geojson"
        made = make_scenario(source, name=self.name, arrival=arrival, day_error=days)
        if self.sensor_model != "perfect":
            made = made.replace(sensor_model=SensorModel.named(self.sensor_model))
        if self.v_walk_kmh is not None:
            made = made.replace(v_walk=self.v_walk_kmh * KMH)
        return made if self.occupancy_level is None else at_occupancy(made, self.occupancy_level)


@dataclass(frozen=True)
class Suite:
    """A benchmark suite."""

    name: str  # name, such as v1
    description: str  # one sentence
    arrival: ArrivalWindow  # when searches begin
    seeds: range  # seeds; every task without strata has one search per seed
    tasks: tuple[Task, ...]
    fingerprint: str  # SHA-256 of the suite's file, as JSON without white space

    @classmethod
    def named(cls, name: str) -> Self:
        """Load a packaged suite.

        Raises:
            InputError: an unknown name; the message lists the known ones.

        Examples:
            >>> suite = Suite.named("v1")
            >>> suite.tasks[0].name, len(suite.seeds)
            ('campus', 1000)
        """
        if name not in SUITES:
            raise InputError(f"there is no benchmark suite {name!r}; known: {', '.join(SUITES)}")
        content = _packaged(name)
        first = content.get("first_seed", 0)
        return cls(
            name,
            content["description"],
            ArrivalWindow.parse(content["arrival"], content["days"]),
            range(first, first + content.get("episodes", 0)),
            tuple(_task(**task) for task in content["tasks"]),
            sha256_of(content),
        )

    def seeds_of(self, task: Task) -> Sequence[int]:
        """Return the seeds of the searches of a task."""
        return tuple(seed for part in task.strata for seed in part.seeds) if task.strata else self.seeds

    def cases(self, agents: Sequence[AgentSpec]) -> list[Cell]:
        """Return the cases: every agent in every task.

        Raises:
            InputError: an agent does not exist or does not support a task.
        """
        worlds = [task.made(self.arrival) for task in self.tasks]
        for world in worlds:
            for agent in agents:
                make_agent(agent.name, world, **agent.options)
        cells = [
            Cell(Case(world, agent.name, options=agent.options), self.seeds_of(task))
            for task, world in zip(self.tasks, worlds, strict=True)
            for agent in agents
        ]
        require_distinct(case for case, _ in cells)
        return cells


def _task(
    sight: str = "perfect",
    day_error: Sequence[float] = (0.0,),
    lot_share: float | None = None,
    strata: Sequence[Mapping[str, Any]] = (),
    **fields: Any,
) -> Task:
    """Return a task of a suite's file; v1 is older than days that differ from their forecast."""
    del lot_share  # see `suite_lots`
    parts = tuple(Stratum(each["share"], tuple(each["seeds"]), tuple(each["means"])) for each in strata)
    return Task(sensor_model=sight, day_error=tuple(day_error), strata=parts, **fields)


def estimate(task: Task, values: ArrayLike, worlds: FloatArray, *, controls: bool = True) -> Estimate:
    """Estimate the mean of a number over a task's worlds.

    Args:
        task: the task.
        values: (n,) the number in each search, in the order of `Suite.seeds_of`.
        worlds: (n, 2) `CONTROLS` of each search.
        controls: whether to use them as control variates; a task without strata does not, as their means are unknown.
    """
    if not task.strata:
        return stratified_estimate(values, np.zeros(len(worlds)), [1.0])
    numbers = np.repeat(np.arange(len(task.strata)), [len(part.seeds) for part in task.strata])
    shares, means = [part.share for part in task.strata], [part.means for part in task.strata]
    if not controls:
        return stratified_estimate(values, numbers, shares)
    return stratified_estimate(values, numbers, shares, worlds, means)


def mean_time(suite: Suite, times: Mapping[str, ArrayLike], *, controls: bool = True) -> Estimate:
    """Estimate the mean over the tasks of a suite of times, or of paired differences of two agents, s.

    Args:
        suite: the suite.
        times: (n,) s, those of each search, by task.
        controls: see `estimate`.
    """
    share = 1.0 / len(suite.tasks)
    if suite.seeds:  # the tasks share their seeds: their searches are not independent
        means = np.mean([np.asarray(times[task.name]) for task in suite.tasks], axis=0)
        return stratified_estimate(means, np.zeros(len(means)), [1.0])
    return Estimate.combined(
        (share, estimate(task, times[task.name], worlds_of(task, suite), controls=controls))
        for task in suite.tasks
    )


def score_of(task: Task, total: FloatArray, worlds: FloatArray) -> float:
    """Return an agent's score in a task: the mean of the clairvoyant bound over that of its total times.

    Args:
        task: the task.
        total: (n,) total time of each search, s.
        worlds: (n, 2) `CONTROLS` of each search.
    """
    if task.strata:  # the bound's mean over the whole population is known
        bound = sum(part.share * part.means[0] for part in task.strata)
        return min(1.0, bound / estimate(task, total, worlds).mean)
    return float(np.round(worlds[:, 0], 6).mean() / np.round(total, 6).mean())


def score_interval(suite: Suite, times: Mapping[str, FloatArray]) -> tuple[float, float, float]:
    """Return an agent's score in a suite and its 95 % interval (delta method).

    Args:
        suite: the suite.
        times: (n,) s, those of each search, by task.
    """
    scores, slopes = [], {}
    for task in suite.tasks:
        total, worlds = times[task.name], worlds_of(task, suite)
        scores.append(score_of(task, total, worlds))
        bound = 0.0 if task.strata else worlds[:, 0]
        slopes[task.name] = (bound - scores[-1] * total) / estimate(task, total, worlds).mean
    return mean_time(suite, slopes)._replace(mean=float(np.mean(scores))).interval()


@functools.cache
def worlds_of(task: Task, suite: Suite) -> FloatArray:
    """Return the `CONTROLS` of a task's searches, (n, 2)."""
    return controls_of(task.made(suite.arrival), suite.seeds_of(task))


def controls_of(scenario: Scenario, seeds: Sequence[int]) -> FloatArray:
    """Return the `CONTROLS` of the worlds of seeds, (n, 2)."""
    runner = EpisodeRunner(scenario, "mdp", make_agent("mdp", scenario))
    return np.array([(runner.bound_s(seed), runner.occupancy) for seed in seeds])


@functools.cache
def suite_lots() -> Mapping[float, str]:
    """Return the places of all suites, which no agent is trained on: names by the `lot_share` of their lots."""
    suites = (_packaged(name) for name in SUITES)
    return {
        task["lot_share"]: task["name"] for suite in suites for task in suite["tasks"] if "lot_share" in task
    }


def sha256_of(content: Any) -> str:
    """Return the SHA-256 of a content, as JSON without white space."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _packaged(name: str) -> Any:
    return read_json(SUITE_FOLDER / f"{name}.json")
