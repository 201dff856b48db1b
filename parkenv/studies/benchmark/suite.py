"""The benchmark suite: fixed scenarios, seeds and metrics that make results of different groups comparable.

A suite is a JSON file in the folder `suites`. A published suite never changes; improvements go into a new suite. A
result file names its suite, contains the total time of every search, and can be checked by anybody.

The searches of `v3` are a stratified sample of a population of 5,000 worlds for each task. Six strata divide it by the
occupancy at arrival, at shares 0.3, 0.55, 0.75, 0.87 and 0.95 of the population. `mdp`, `mdp-tuned` and `first-free`
searched in its last 400 worlds; from the standard deviations of their paired differences in each stratum follows how
many of the 3,000 searches it gets (Neyman 1934), at least 8. The means of the clairvoyant bound and of the occupancy at
arrival are known for the whole population, and serve as control variates.
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
from parkenv.files.limited_reading import read_json
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

CONTROLS = ("bound_s", "occupancy")
"""Columns of an episode that its world alone determines: the control variates."""
_FILE = Path(__file__).parent / "suites" / "v3.json"


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
    scenario: str  # a packaged scenario
    day_error: tuple[float, ...]  # how far days differ from the forecast, logits: (level,) or (level, slope)
    strata: tuple[Stratum, ...]  # parts of the population
    occupancy_level: float | None = None  # mean occupancy of the world; None for the scenario's own
    # `perfect`, or the rig whose fitted sensor model is used; `sight` in the suite's file
    sensor_model: str = "perfect"
    v_walk_kmh: float | None = None  # walking speed; None for the scenario's own

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seeds of the searches."""
        return tuple(seed for part in self.strata for seed in part.seeds)

    def made(self, arrival: ArrivalWindow) -> Scenario:
        """Make the scenario, named after the task."""
        days = DayError(*self.day_error)
        made = make_scenario(self.scenario, name=self.name, arrival=arrival, day_error=days)
        if self.sensor_model != "perfect":
            made = made.replace(sensor_model=SensorModel.named(self.sensor_model))
        if self.v_walk_kmh is not None:
            made = made.replace(v_walk=self.v_walk_kmh * KMH)
        return made if self.occupancy_level is None else at_occupancy(made, self.occupancy_level)


@dataclass(frozen=True)
class Suite:
    """A benchmark suite."""

    name: str  # name, such as v3
    description: str  # one sentence
    arrival: ArrivalWindow  # when searches begin
    tasks: tuple[Task, ...]
    fingerprint: str  # SHA-256 of the suite's file, as JSON without white space

    @classmethod
    def packaged(cls) -> Self:
        """Load the suite.

        Examples:
            >>> suite = Suite.packaged()
            >>> suite.name, suite.tasks[0].name, sum(len(task.seeds) for task in suite.tasks)
            ('v3', 'campus', 3000)
        """
        content = read_json(_FILE)
        return cls(
            content["name"],
            content["description"],
            ArrivalWindow.parse(content["arrival"], content["days"]),
            tuple(_task(**task) for task in content["tasks"]),
            sha256_of(content),
        )

    def cases(self, agents: Sequence[AgentSpec]) -> list[Cell]:
        """Return the cases: every agent in every task."""
        worlds = [task.made(self.arrival) for task in self.tasks]
        for world in worlds:
            for agent in agents:
                make_agent(agent.name, world, **agent.options)
        cells = [
            Cell(Case(world, agent.name, options=agent.options), task.seeds)
            for task, world in zip(self.tasks, worlds, strict=True)
            for agent in agents
        ]
        require_distinct(case for case, _ in cells)
        return cells


def _task(
    strata: Sequence[Mapping[str, Any]], day_error: Sequence[float], sight: str = "perfect", **fields: Any
) -> Task:
    """Return a task of a suite's file."""
    parts = tuple(Stratum(each["share"], tuple(each["seeds"]), tuple(each["means"])) for each in strata)
    return Task(sensor_model=sight, day_error=tuple(day_error), strata=parts, **fields)


def estimate(task: Task, values: ArrayLike, worlds: FloatArray, *, controls: bool = True) -> Estimate:
    """Estimate the mean of a number over a task's worlds.

    Args:
        task: the task.
        values: (n,) the number in each search, in the order of the task's seeds.
        worlds: (n, 2) `CONTROLS` of each search.
        controls: whether to use them as control variates.
    """
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
    return Estimate.combined(
        (1.0 / len(suite.tasks), estimate(task, times[task.name], worlds_of(task, suite), controls=controls))
        for task in suite.tasks
    )


def score_of(task: Task, total: FloatArray, worlds: FloatArray) -> float:
    """Return an agent's score in a task: the mean of the clairvoyant bound over that of its total times.

    The former is known for the whole population.

    Args:
        task: the task.
        total: (n,) total time of each search, s.
        worlds: (n, 2) `CONTROLS` of each search.
    """
    bound = sum(part.share * part.means[0] for part in task.strata)
    return min(1.0, bound / estimate(task, total, worlds).mean)


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
        slopes[task.name] = -scores[-1] * total / estimate(task, total, worlds).mean
    return mean_time(suite, slopes)._replace(mean=float(np.mean(scores))).interval()


@functools.cache
def worlds_of(task: Task, suite: Suite) -> FloatArray:
    """Return the `CONTROLS` of a task's searches, (n, 2)."""
    return controls_of(task.made(suite.arrival), task.seeds)


def controls_of(scenario: Scenario, seeds: Sequence[int]) -> FloatArray:
    """Return the `CONTROLS` of the worlds of seeds, (n, 2)."""
    runner = EpisodeRunner(scenario, "mdp", make_agent("mdp", scenario))
    return np.array([(runner.bound_s(seed), runner.occupancy) for seed in seeds])


def sha256_of(content: Any) -> str:
    """Return the SHA-256 of a content, as JSON without white space."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
