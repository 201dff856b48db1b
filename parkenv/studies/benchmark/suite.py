"""Benchmark suites: fixed scenarios, seeds and metrics that make results of different groups comparable.

A suite is a JSON file in the folder `suites`. A published suite never changes; improvements go into a new suite. A
result file names its suite, contains the total time of every search, and can be checked by anybody.

The searches of a suite are a stratified sample of a population of worlds for each task: 5,000 in `v3`, 2,000 in
`streets-v1`. Six strata divide it by the occupancy at arrival, at shares 0.3, 0.55, 0.75, 0.87 and 0.95 of the
population. `mdp`, `mdp-tuned` and `first-free` searched in its last 400 worlds (`streets-v1`: 150); from the standard
deviations of their paired differences in each stratum follows how many of the searches it gets (Neyman 1934; 3,000 and
1,200 in all), at least 8; `examples/streets_v1/choose_searches.py` chose those of `streets-v1`. The means of the
clairvoyant bound and of the occupancy at arrival are known for the whole population, and serve as control variates.
"""

import contextlib
import functools
import hashlib
import json
import re
import subprocess
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, TypeAdapter

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError, require
from parkenv.files.atomic_write import write_text
from parkenv.files.field_types import NotNegative, Probability
from parkenv.files.known_names import SuiteName
from parkenv.files.limited_reading import read_json
from parkenv.files.spec_file import Several, Spec
from parkenv.scenarios.build import build, make_scenario
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.studies.compare.cases import Case, at_occupancy, check_worlds, require_distinct, table
from parkenv.studies.episodes import EpisodeRunner
from parkenv.studies.fields import AgentSpec, require_agents
from parkenv.studies.results import SETTING_COLUMNS, Key, Row, decision_s, without_nan
from parkenv.studies.statistics import Estimate, columns_of, decision_columns, stratified_estimate, summarize
from parkenv.studies.study import Cell
from parkenv.version import __version__
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.day_error import DayError
from parkenv.world.occupancy.process import OccupancyModel
from parkenv.world.occupancy.recorded import RecordedOccupancy
from parkenv.world.scenario import KMH, Scenario
from parkenv.world.sensor_model import SensorModel
from planners.agent import make_agent

# Columns of an episode that its world alone determines: the control variates.
CONTROLS = ("bound_s", "occupancy")
SEARCHES_ON, FIRST_SEED_ON = 250, 9_000_000  # of the protocol in another world: searches of each task
SUITES = Path(__file__).parent / "suites"


World = tuple[Scenario, Sequence[int]]  # a task's scenario, and the seeds of its searches


@dataclass(frozen=True)
class Stratum:
    share: float  # in the population
    seeds: tuple[int, ...]  # the searches
    means: tuple[float, ...]  # of `CONTROLS`, over the part's whole population


@dataclass(frozen=True)
class Task:
    name: str
    scenario: str  # a packaged scenario
    day_error: tuple[float, ...]  # how far days differ from the forecast, logits: (level,) or (level, slope)
    strata: tuple[Stratum, ...]  # parts of the population
    occupancy_level: float | None = None  # mean occupancy of the world; None for the scenario's own
    # `perfect`, or the rig whose fitted sensor model is used; `sight` in the suite's file
    sensor_model: str = "perfect"
    v_walk_kmh: float | None = None  # walking speed; None for the scenario's own
    goal: int | None = None  # index of the goal in the lot; None for the scenario's own
    arrival: str | None = None  # HH:MM-HH:MM; None for the suite's
    days: str = "weekdays"  # of `arrival`

    @property
    def seeds(self) -> tuple[int, ...]:
        return tuple(seed for part in self.strata for seed in part.seeds)

    def window(self, of_suite: ArrivalWindow) -> ArrivalWindow:
        return of_suite if self.arrival is None else ArrivalWindow.parse(self.arrival, self.days)

    def made(self, arrival: ArrivalWindow) -> Scenario:
        options: dict[str, Any] = {
            "name": self.name,
            "arrival": self.window(arrival),
            "day_error": DayError(*self.day_error),
        }
        if self.goal is not None:
            options["goal"] = self.goal
        if self.sensor_model != "perfect":
            options["sensor_model"] = SensorModel.named(self.sensor_model)
        if self.v_walk_kmh is not None:
            options["v_walk"] = self.v_walk_kmh * KMH
        scenario = make_scenario(self.scenario, **options)
        return scenario if self.occupancy_level is None else at_occupancy(scenario, self.occupancy_level)


@dataclass(frozen=True)
class Suite:
    name: str
    description: str  # one sentence
    arrival: ArrivalWindow  # when searches begin
    tasks: tuple[Task, ...]
    fingerprint: str  # SHA-256 of the suite's file, as JSON without white space

    @classmethod
    def packaged(cls, name: SuiteName = "v3") -> Self:
        """Load a suite.

        Examples:
            >>> suite = Suite.packaged()
            >>> suite.name, suite.tasks[0].name, sum(len(task.seeds) for task in suite.tasks)
            ('v3', 'campus', 3000)
        """
        content = read_json(SUITES / f"{name}.json")
        fields = [{"sensor_model": task.get("sight", "perfect")} | task for task in content["tasks"]]
        tasks = TypeAdapter(tuple[Task, ...]).validate_python(fields)
        arrival = ArrivalWindow.parse(content["arrival"], content["days"])
        return cls(content["name"], content["description"], arrival, tasks, sha256_of(content))

    def cases(self, agents: Sequence[AgentSpec]) -> list[Cell]:
        return _cells([(task.made(self.arrival), task.seeds) for task in self.tasks], agents)

    def cases_on(self, world: ScenarioSpec, agents: Sequence[AgentSpec]) -> list[Cell]:
        """Return the suite's protocol in another world: its hours and goals, with `SEARCHES_ON` searches each.

        Goal g of a task is goal g of the world's lot, counted around. Tasks that differ in the suite's own world alone
        count once. Hours before or after those of a log are cut. A task is left out with a warning if no such hour or
        day is recorded, or a day has no others to forecast it from.
        """
        worlds, seen, faults = list[World](), set[tuple[Any, ArrivalWindow]](), list[str]()
        n_goals = len(build(world).lot.goals)
        for number, task in enumerate(self.tasks):
            window = task.window(self.arrival)
            goal = world.goal if task.goal is None or isinstance(world.goal, tuple) else task.goal % n_goals
            if (goal, window) in seen:
                continue
            seen.add((goal, window))
            scenario = build(world.changed(name=task.name, goal=goal))
            seeds = range(FIRST_SEED_ON + number * SEARCHES_ON, FIRST_SEED_ON + (number + 1) * SEARCHES_ON)
            try:
                scenario = scenario.replace(arrival=_recorded_part(window, scenario.occupancy))
                check_worlds(scenario, seeds)
            except InputError as error:
                faults.append(f"task {task.name} is left out: {error}")
                continue
            worlds.append((scenario, seeds))
        require(worlds, f"{world.source}: no task can be run; {next(iter(faults), '')}")
        for fault in faults:
            warnings.warn(fault, stacklevel=2)
        return _cells(worlds, agents)


def _cells(worlds: Sequence[World], agents: Sequence[AgentSpec]) -> list[Cell]:
    require_agents(agents, [scenario for scenario, _ in worlds])
    cells = [
        Cell(Case(scenario, agent.name, options=agent.options), seeds)
        for scenario, seeds in worlds
        for agent in agents
    ]
    require_distinct(case for case, _ in cells)
    return cells


def _recorded_part(window: ArrivalWindow, occupancy: OccupancyModel) -> ArrivalWindow:
    if not isinstance(occupancy, RecordedOccupancy):
        return window
    seconds = occupancy.log.second
    start, end = max(window.start_s, float(seconds.min())), min(window.end_s, float(seconds.max()))
    require(start < end, f"{occupancy.log.source}: no observation within its hours")
    return replace(window, start_s=start, end_s=end)


def estimate(task: Task, values: ArrayLike, worlds: FloatArray, *, controls: bool = True) -> Estimate:
    """Estimate the mean of a number over a task's worlds, from its (n,) `values`, in the order of the task's seeds."""
    numbers = np.repeat(np.arange(len(task.strata)), [len(part.seeds) for part in task.strata])
    shares, means = [part.share for part in task.strata], [part.means for part in task.strata]
    return stratified_estimate(values, numbers, shares, *((worlds, means) if controls else ()))


def mean_time(suite: Suite, times: Mapping[str, ArrayLike], *, controls: bool = True) -> Estimate:
    return Estimate.combined(
        (1.0 / len(suite.tasks), estimate(task, times[task.name], worlds_of(task, suite), controls=controls))
        for task in suite.tasks
    )


def score_of(task: Task, total: FloatArray, worlds: FloatArray) -> float:
    bound = sum(part.share * part.means[0] for part in task.strata)
    return min(1.0, bound / estimate(task, total, worlds).mean)


def score_interval(suite: Suite, times: Mapping[str, FloatArray]) -> tuple[float, float, float]:
    """Return an agent's score in a suite and its 95 % interval (delta method)."""
    scores, slopes = [], {}
    for task in suite.tasks:
        total, worlds = times[task.name], worlds_of(task, suite)
        scores.append(score_of(task, total, worlds))
        slopes[task.name] = -scores[-1] * total / estimate(task, total, worlds).mean
    return mean_time(suite, slopes)._replace(mean=float(np.mean(scores))).interval()


@functools.cache
def worlds_of(task: Task, suite: Suite) -> FloatArray:
    scenario = task.made(suite.arrival)
    runner = EpisodeRunner(scenario, "mdp", make_agent("mdp", scenario))
    return np.array([(runner.bound_s(seed), runner.occupancy) for seed in task.seeds])


def sha256_of(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


RESULT_VERSION = 2
_ROUNDED = 1e-3  # s; times are written to 1 ms
Ends = Annotated[tuple[float | None, float | None], Field(strict=False)]


class _ResultRow(Spec, extra="allow"):
    task: str
    agent: str
    episodes: int = Field(ge=1)
    parked_fraction: Probability
    total_s: float
    total_s_ci95: Ends
    regret_s: float
    regret_s_ci95: Ends
    failed_parks: float
    decision_ms: float
    decision_ms_p99: float
    score: Probability


# Metrics of an agent in a task, named as in `parkenv compare`; a result also has the score.
METRICS = tuple(_ResultRow.model_fields)[2:-1]


class ResultFile(Spec):
    format: Literal["parkenv-benchmark-result"]
    version: Literal[2]
    suite: SuiteName
    suite_sha256: str = Field(pattern="^[0-9a-f]{64}$")
    parkenv: str
    commit: str = Field(max_length=60)
    command: Several[str]
    by: str = Field(max_length=200)
    code: str = Field(max_length=200)
    date: str = Field(pattern="^[0-9]{4}-[0-9]{2}-[0-9]{2}$")
    rows: Several[_ResultRow] = Field(min_length=1)
    scores: dict[str, Probability]
    episodes: dict[
        str, dict[str, dict[Literal["total_s"], Several[NotNegative]]]
    ]  # in the order of the seeds
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


def score_rows(
    suite: Suite, cells: Iterable[tuple[Case, Sequence[int]]], finished: Mapping[Key, Row]
) -> list[Row]:
    tasks, rows = {task.name: task for task in suite.tasks}, []
    for case, seeds in cells:
        task = tasks[case.scenario.name]
        searches = [finished[key] for seed in seeds if (key := case.key(seed)) in finished]
        if len(searches) < len(seeds):
            continue
        total = np.array([search["total_s"] for search in searches])
        worlds = np.array([[search[name] for name in CONTROLS] for search in searches])
        row = _estimates(task, total, worlds) | {"episodes": len(searches)}
        row |= decision_columns([time for search in searches for time in decision_s(search)])
        for name in ("parked", "failed_parks"):
            values = [float(search[name]) for search in searches]
            row[name] = estimate(task, values, worlds, controls=False).mean
        row["parked_fraction"] = min(row["parked"], 1.0)
        metrics = {name: row.get(name) for name in (*METRICS, "score")}
        rows.append({"task": task.name, "agent": case.label, **metrics})
    return rows


def world_rows(name: str, cells: Iterable[tuple[Case, Sequence[int]]], finished: Mapping[Key, Row]) -> Row:
    """Return the tables of the protocol in another world: `rows` over all tasks, and `tasks` one by one."""
    tasks, searches = table(cells, finished), dict[str, list[Row]]()
    for search in finished.values():
        searches.setdefault(search["agent"], []).append(search)
    first, rows = searches[tasks[0]["agent"]] if tasks else None, list[Row]()
    for columns in {row["agent"]: row for row in tasks}.values():
        own = searches[columns["agent"]]
        columns = {key: columns[key] for key in SETTING_COLUMNS} | {"scenario": name}
        times = [time for search in own for time in decision_s(search)]
        rows.append(summarize(columns, own, None if own is first else first, times))
    return {"rows": rows, "tasks": tasks}


def result_of(
    suite: Suite,
    cells: Sequence[tuple[Case, Sequence[int]]],
    finished: Mapping[Key, Row],
    command: Sequence[str],
    by: str = "",
    code: str = "",
) -> Row:
    """Build the content of a result file from finished cases.

    The `finished` are the rows of all episodes of all cases, by `Case.key`. Who submits it (`by`) and the address of
    the agents' `code` are dated today.
    """
    rows = score_rows(suite, cells, finished)
    scores: dict[str, list[float]] = {}
    for row in rows:
        scores.setdefault(row["agent"], []).append(row["score"])
    episodes: dict[str, dict[str, dict[str, list[float]]]] = {}
    for case, seeds in cells:
        times = [round(finished[case.key(s)]["total_s"], 3) for s in seeds]
        episodes.setdefault(case.label, {})[case.scenario.name] = {"total_s": times}
    content: Row = without_nan(
        {
            "format": "parkenv-benchmark-result",
            "version": RESULT_VERSION,
            "suite": suite.name,
            "suite_sha256": suite.fingerprint,
            "parkenv": __version__,
            "commit": source_commit(),
            "command": list(command),
            "by": by,
            "code": code,
            "date": datetime.now(UTC).date().isoformat(),
            "rows": rows,
            "scores": {agent: float(np.mean(of_tasks)) for agent, of_tasks in scores.items()},
            "episodes": episodes,
        }
    )
    return {**content, "sha256": fingerprint(content)}


def write_result(folder: Path, content: Row, name: str) -> None:
    text = json.dumps(content, indent=1, allow_nan=False)
    # The numbers of a list in one line.
    text = re.sub(r"\[[-+.eE\d,\s]+\]", lambda numbers: " ".join(numbers[0].split()), text)
    write_text(folder / name, text + "\n")


def source_commit() -> str:
    # Of this package's source, with `-dirty` if files differ from it; empty outside a repository.
    here = Path(__file__)
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        for command in (("ls-files", "--error-unmatch", here.name), ("describe", "--always", "--dirty")):
            git = "git", "-C", str(here.parent), *command
            commit = subprocess.run(git, capture_output=True, text=True, check=True, timeout=20.0).stdout
        return commit.strip()
    return ""


def check_result(path: Path) -> Row:
    """Read a result file, and check that it is complete, consistent, and from the suite's own worlds.

    The check recomputes the clairvoyant bounds of all searches, which differ in other worlds or with other costs and
    speeds, and from the times of the searches all means and scores. It cannot verify the times of an agent; for that,
    run the agent again.
    """
    result: Row = read_json(path)
    ResultFile.parse(result, str(path))
    suite = Suite.packaged(result["suite"])

    def require(field: str, value: Any, wanted: Any) -> None:
        # Times were rounded to 1 ms.
        same = (
            value == wanted
            if isinstance(wanted, str)
            else np.allclose(np.array(value, float), np.array(wanted, float), rtol=0.0, atol=_ROUNDED)
        )
        if not same:
            raise InputError(f"{path}: {field} is {value}, want {wanted}")

    require("suite_sha256", result["suite_sha256"], suite.fingerprint)
    rows = {(row["agent"], row["task"]): (i, row) for i, row in enumerate(result["rows"])}
    for agent, tasks in result["episodes"].items():
        for task in suite.tasks:
            if (agent, task.name) not in rows:
                raise InputError(f"{path}: rows has none of {agent} in {task.name}, want one")
            (number, row), times = rows.pop((agent, task.name)), f"episodes.{agent}.{task.name}.total_s"
            total, worlds = np.array((tasks.get(task.name) or {}).get("total_s", ())), worlds_of(task, suite)
            require(times, len(total), len(worlds))
            require(f"rows[{number}].episodes", row["episodes"], len(worlds))
            for i in np.flatnonzero(total < worlds[:, 0] - _ROUNDED):
                bound = f"want at least the clairvoyant bound, {worlds[i, 0]:.3f}"
                raise InputError(f"{path}: {times}[{i}] is {total[i]:g}, {bound}")
            for name, value in _estimates(task, total, worlds).items():
                require(f"rows[{number}].{name}", row[name], value)
        own = [row["score"] for row in result["rows"] if row["agent"] == agent]
        require(f"scores.{agent}", result["scores"].get(agent), float(np.mean(own)))
    if rows or result["scores"].keys() != result["episodes"].keys():
        raise InputError(
            f"{path}: rows or scores are of others than {', '.join(result['episodes'])} in the tasks"
        )
    require("sha256", result["sha256"], fingerprint(result))
    return result


def _estimates(task: Task, total: FloatArray, worlds: FloatArray) -> Row:
    return {
        **columns_of("total_s", estimate(task, total, worlds).interval()),
        **columns_of("regret_s", estimate(task, total - worlds[:, 0], worlds).interval()),
        "score": score_of(task, total, worlds),
    }


def fingerprint(content: Row) -> str:
    return sha256_of({key: value for key, value in content.items() if key != "sha256"})
