"""Benchmark suites: fixed scenarios, seeds and metrics that make results of different groups comparable.

A suite is a JSON file in the folder `suites`. The places of a suite, real car parks, are a suite of their own
(`v2-places`), so that a result of either part can be complete. A published suite never changes; improvements go into a
new suite. A result file names its suite, contains the total time of every search, and can be checked by anybody.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field

from parkenv import __version__
from parkenv.errors import InputError
from parkenv.files.limited_reading import read_json
from parkenv.files.spec_file import Several, Spec, read_tables
from parkenv.lots.lot_files import PLACES
from parkenv.scenarios.build import make_scenario
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.cases import Case, at_occupancy, require_distinct, table
from parkenv.studies.episodes import EpisodeRunner
from parkenv.studies.results import Key, Row
from parkenv.studies.study import Cell
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.day_error import DayError
from parkenv.world.scenario import KMH, Scenario
from parkenv.world.sensor_model import SensorModel
from planners.agent import make_agent

RESULT_FORMAT = "parkenv-benchmark-result"
RESULT_VERSION = 1
SUITES = ("v1", "v2", "v2-places")
RESAMPLES = 2000
_ROUNDING = 1e-6
_FOLDER = Path(__file__).parent / "suites"


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
    seeds: range  # seeds; every task has one search per seed
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
        canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
        first = content["first_seed"]
        return cls(
            name,
            content["description"],
            ArrivalWindow.parse(content["arrival"], content["days"]),
            range(first, first + content["episodes"]),
            tuple(_task(**task) for task in content["tasks"]),
            hashlib.sha256(canonical.encode()).hexdigest(),
        )

    def cases(self, agents: Sequence[AgentSpec]) -> list[Cell]:
        """Return the cases: every agent in every task.

        Raises:
            InputError: an agent does not exist or does not support a task.
        """
        worlds = [task.made(self.arrival) for task in self.tasks]
        for world in worlds:
            for agent in agents:
                make_agent(agent.name, world, **agent.options)
        cases = [Case(world, agent.name, options=agent.options) for world in worlds for agent in agents]
        require_distinct(cases)
        return [Cell(case, self.seeds) for case in cases]


Share = Annotated[float, Field(ge=0.0, le=1.0)]
Seconds = Annotated[float, Field(ge=0.0)]
Ends = Annotated[tuple[float | None, float | None], Field(strict=False)]


class _ResultRow(Spec, extra="allow"):
    """An agent in a task, in seconds and milliseconds."""

    task: str
    agent: str
    episodes: int = Field(ge=1)
    parked_fraction: Share
    total_s: float
    total_s_ci95: Ends
    regret_s: float
    regret_s_ci95: Ends
    failed_parks: float
    decision_ms: float
    decision_ms_p99: float
    score: Share


METRICS = tuple(_ResultRow.model_fields)[2:-1]
"""Metrics of an agent in a task, named as in `parkenv compare`; a result also has the score."""


class _Searches(Spec):
    """Times of each search, in the order of the seeds."""

    total_s: Several[Seconds]
    bound_s: Several[Seconds]


class ResultFile(Spec):
    """Result of a benchmark suite: scores by agent, and searches by agent and task."""

    format: Literal["parkenv-benchmark-result"]
    version: Literal[1]
    suite: str
    suite_sha256: str = Field(pattern="^[0-9a-f]{64}$")
    parkenv: str
    command: Several[str]
    by: str = Field(max_length=200)
    date: str = Field(pattern="^[0-9]{4}-[0-9]{2}-[0-9]{2}$")
    rows: Several[_ResultRow] = Field(min_length=1)
    scores: dict[str, Share]
    episodes: dict[str, dict[str, _Searches]]


def _task(
    sight: str = "perfect", day_error: Sequence[float] = (0.0,), lot_share: float | None = None, **fields: Any
) -> Task:
    """Return a task of a suite's file; v1 is older than days that differ from their forecast."""
    del lot_share  # see `suite_lots`
    return Task(sensor_model=sight, day_error=tuple(day_error), **fields)


def score_rows(cells: Iterable[tuple[Case, Sequence[int]]], finished: Mapping[Key, Row]) -> list[Row]:
    """Return a row for each task and agent with finished episodes: its metrics, where known, and its score."""
    searches = {
        (case.scenario.name, case.label): _searches(rows)
        for case, seeds in cells
        if (rows := [finished[key] for s in seeds if (key := case.key(s)) in finished])
    }
    return [
        {
            "task": row["scenario"],
            "agent": row["agent"],
            **{metric: row.get(metric) for metric in METRICS},
            "score": _score(searches[row["scenario"], row["agent"]]),
        }
        for row in table(cells, finished)
    ]


def _searches(rows: Sequence[Row]) -> dict[str, list[float]]:
    return {column: [round(row[column], 6) for row in rows] for column in ("total_s", "bound_s")}


def result_of(
    suite: Suite,
    cells: Sequence[tuple[Case, Sequence[int]]],
    finished: Mapping[Key, Row],
    command: Sequence[str],
    by: str = "",
) -> Row:
    """Build the content of a result file from finished cases.

    Args:
        suite: the suite.
        cells: all cases with their seeds.
        finished: rows of all their episodes, by `Case.key`.
        command: the command that ran them.
        by: who submits the result; dated today.

    Raises:
        InputError: the wall times of an agent's decisions are lost.
    """
    rows = score_rows(cells, finished)
    for row in rows:
        if missing := [metric for metric in METRICS if row[metric] is None]:
            raise InputError(
                f"no {missing[0]} of {row['agent']} in {row['task']}, as timings.csv is not whole; run the suite again "
                "with --overwrite"
            )
    episodes: dict[str, dict[str, dict[str, list[float]]]] = {}
    for case, seeds in cells:
        of_agent = episodes.setdefault(case.label, {})
        of_agent[case.scenario.name] = _searches([finished[case.key(s)] for s in seeds])
    return {
        "format": RESULT_FORMAT,
        "version": RESULT_VERSION,
        "suite": suite.name,
        "suite_sha256": suite.fingerprint,
        "parkenv": __version__,
        "command": list(command),
        "by": by,
        "date": datetime.now(UTC).date().isoformat(),
        "rows": rows,
        "scores": {agent: _mean_score(tasks) for agent, tasks in episodes.items()},
        "episodes": episodes,
    }


def check_result(path: Path) -> Row:
    """Read a result file, and check that it is complete, consistent, and from the suite's own worlds.

    The check recomputes the clairvoyant bounds of all searches, which differ in other worlds or with other costs and
    speeds. It cannot verify the times of an agent; for that, run the agent again.

    Raises:
        InputError: the check failed; the message says where, with agent and task.
    """
    result: Row = read_tables(path)
    ResultFile.parse(result, str(path))
    suite = Suite.named(result["suite"])
    if result["suite_sha256"] != suite.fingerprint:
        raise InputError(f"{path}: made with settings that are not those of suite {suite.name}")
    bounds = {task.name: _bounds(task, suite) for task in suite.tasks}
    by_row = {(row["agent"], row["task"]): row for row in result["rows"]}
    wanted = {(agent, task.name) for agent in result["episodes"] for task in suite.tasks}
    if by_row.keys() != wanted or result["scores"].keys() != result["episodes"].keys():
        raise InputError(f"{path}: rows or scores are not those of its agents in the suite's tasks")
    for agent, tasks in result["episodes"].items():
        for task in suite.tasks:
            _check_task(path, agent, task.name, tasks.get(task.name), by_row[agent, task.name], suite, bounds)
        if abs(result["scores"][agent] - _mean_score(tasks)) > _ROUNDING:
            raise InputError(f"{path}: the score of {agent} does not match its searches")
    return result


def _check_task(
    path: Path,
    agent: str,
    task: str,
    searches: Mapping[str, Sequence[float]] | None,
    row: Row,
    suite: Suite,
    bounds: Mapping[str, Sequence[float]],
) -> None:
    where = f"{path}: {agent} in {task}"
    counts = {len(times) for times in searches.values()} if searches else {0}
    if searches is None or counts != {len(suite.seeds)} or row["episodes"] != len(suite.seeds):
        raise InputError(f"{where}: wants {len(suite.seeds)} searches, has {min(counts)}")
    if not np.allclose(searches["bound_s"], bounds[task], rtol=0.0, atol=2 * _ROUNDING):
        raise InputError(f"{where}: was not run in the suite's worlds, at its costs and speeds")
    total, bound = np.array(searches["total_s"]), np.array(searches["bound_s"])
    if (total < bound - 2 * _ROUNDING).any():
        raise InputError(f"{where}: a search beats the clairvoyant bound")
    stated = row["total_s"], row["regret_s"], row["score"]
    if not np.allclose(stated, (total.mean(), (total - bound).mean(), _score(searches)), atol=1e-4):
        raise InputError(f"{where}: its row does not match its searches")


@functools.cache
def _bounds(task: Task, suite: Suite) -> list[float]:
    scenario = task.made(suite.arrival)
    runner = EpisodeRunner(scenario, "mdp", make_agent("mdp", scenario))
    return [runner.bound_s(seed) for seed in suite.seeds]


@functools.cache
def suite_lots() -> Mapping[float, str]:
    """Return the places of all suites, which no agent is trained on: names by the `lot_share` of their lots."""
    suites = (_packaged(name) for name in SUITES)
    return {
        task["lot_share"]: task["name"] for suite in suites for task in suite["tasks"] if "lot_share" in task
    }


def by_group(result: Row) -> list[tuple[str, str, float, float]]:
    """Return a suite's result by kind of place: agent, kind, mean total time, s, and mean score, over its places."""
    groups: dict[str, list[str]] = {}
    for task in Suite.named(result["suite"]).tasks:
        if task.group is not None:
            groups.setdefault(task.group, []).append(task.name)
    rows = {(row["agent"], row["task"]): row for row in result["rows"]}
    return [
        (agent, group, *(float(np.mean([rows[agent, name][key] for name in names])) for key in ("total_s", "score")))
        for agent in result["scores"]
        for group, names in groups.items()
    ]  # fmt: skip


def _score(searches: Mapping[str, Sequence[float]]) -> float:
    return float(np.mean(searches["bound_s"]) / np.mean(searches["total_s"]))


def score_interval(tasks: Mapping[str, Mapping[str, Sequence[float]]]) -> tuple[float, float, float]:
    """Return an agent's score and its 95 % bootstrap interval; equal searches have equal intervals."""
    rng = np.random.default_rng(0)
    resampled = np.zeros(RESAMPLES)
    for searches in tasks.values():
        bound, total = np.array(searches["bound_s"]), np.array(searches["total_s"])
        drawn = rng.integers(len(total), size=(RESAMPLES, len(total)))
        resampled += bound[drawn].mean(axis=1) / total[drawn].mean(axis=1) / len(tasks)
    low, high = np.quantile(resampled, (0.025, 0.975))
    return _mean_score(tasks), float(low), float(high)


def _mean_score(tasks: Mapping[str, Mapping[str, Sequence[float]]]) -> float:
    return float(np.mean([_score(searches) for searches in tasks.values()]))


def _packaged(name: str) -> Any:
    return read_json(_FOLDER / f"{name}.json")
