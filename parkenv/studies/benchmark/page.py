"""A page of the results that were submitted for the benchmark suite: the leaderboard."""

import itertools
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from scipy.special import ndtri

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import require
from parkenv.show.report.page import Page, page_data
from parkenv.show.tables import Column, shared, table_of
from parkenv.studies.benchmark.study import RESULT, Benchmark, score_table
from parkenv.studies.benchmark.suite import Suite, mean_time, score_interval
from parkenv.studies.results import Row
from parkenv.studies.statistics import columns_of
from parkenv.version import __version__
from planners.names import AGENTS

# What the address of an agent's code begins with: elsewhere, or a path in the repository of parkenv.
ADDRESSES = ("http", "examples/", "docs/leaderboard/")
PAIRS = 5  # pairs of neighbours whose precision is shown
_WIDE = float(ndtri(0.975))
_WHO = (
    Column("by", "submitted by"),
    Column("code", "code", help="Address of the agent's code, or path in parkenv's repository"),
    Column("commit", "commit", help="Of parkenv"),
    Column("date", "date"),
)


def result_files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    require(
        (files := (sorted(path.rglob(RESULT)) or sorted(path.rglob("*.json")))),
        f"{path}: no {RESULT} below it",
    )
    return files


class Entry(NamedTuple):
    agent: str
    result: Row
    times: Mapping[str, FloatArray]  # total time of each search, s, by task

    def minus(self, other: Self) -> dict[str, FloatArray]:
        return {task: times - other.times[task] for task, times in self.times.items()}


def entries_of(results: Sequence[Row]) -> list[Entry]:
    entries = []
    for result in results:
        for agent, tasks in result["episodes"].items():
            require(
                agent.partition("(")[0] in AGENTS or result["code"].startswith(ADDRESSES),
                f"code is {result['code']!r}, want the address of the code of {agent}",
            )
            times = {task: np.array(searches["total_s"]) for task, searches in tasks.items()}
            entries.append(Entry(agent, result, times))
    return sorted(entries, key=lambda entry: -entry.result["scores"][entry.agent])


def ranking(suite: Suite, entries: Sequence[Entry]) -> list[Row]:
    """Return a row for each agent: its score, its mean time over the tasks, and how far it is behind the best.

    The oracle, which knows the future, is no competitor. Differences use no control variates: they hardly follow them,
    and regression on the few wild searches of a stratum makes their intervals too short.
    """
    best = next((entry for entry in entries if entry.agent != "oracle"), entries[0])
    rows = []
    for entry in entries:
        of_tasks = [row for row in entry.result["rows"] if row["agent"] == entry.agent]
        row = {"agent": entry.agent, **columns_of("score", score_interval(suite, entry.times))}
        row |= columns_of("mean_s", mean_time(suite, entry.times).interval())
        row |= columns_of("behind_s", mean_time(suite, entry.minus(best), controls=False).interval())
        row["decision_ms"] = float(np.mean([row["decision_ms"] for row in of_tasks]))
        row["searches"] = sum(row["episodes"] for row in of_tasks)
        rows.append(row | _origin(entry.result))
    return rows


def _origin(result: Row) -> Row:
    return {column.key: result[column.key] or ("parkenv" if column.key == "code" else "") for column in _WHO}


def precision(suite: Suite, entry: Entry, other: Entry) -> Row:
    """Return how precisely a run of the suite tells two agents apart.

    `error` is the standard error of the mean difference over the tasks, s; `searches_for_1_s` are those of each agent
    for an interval of ±1 s at 95 %.
    """
    difference = mean_time(suite, entry.minus(other), controls=False)
    return {
        "agents": f"{entry.agent}, {other.agent}",
        **columns_of("behind_s", difference.interval()),
        "error": difference.error,
        "searches_for_1_s": sum(map(len, entry.times.values())) * (_WIDE * difference.error) ** 2,
    }


def neighbours(suite: Suite, entries: Sequence[Entry]) -> list[Row]:
    # The `precision` of the first in the ranking, the oracle apart.
    rivals = [entry for entry in entries if entry.agent != "oracle"][: PAIRS + 1]
    return [precision(suite, worse, better) for better, worse in itertools.pairwise(rivals)]


def benchmark_data(results: Sequence[Row], command: Sequence[str]) -> dict[str, Any]:
    names = sorted({result["suite"] for result in results})
    require(len(names) <= 1, f"results are of the suites {', '.join(names)}, want those of one on a page")
    suite, entries = Suite.packaged(results[0]["suite"]), entries_of(results)
    commands = [
        {"agent": ", ".join(result["episodes"]), "command": shlex.join(result["command"])} | _origin(result)
        for result in results
    ]
    in_tasks = [row for result in results for row in result["rows"]]
    tables = [
        table_of("scores", "Ranking", ranking(suite, entries), _COLUMNS),
        {**score_table(results), "name": "times"},
        table_of("pairs", "How many searches tell neighbours apart", neighbours(suite, entries), _COLUMNS),
        table_of("commands", "How the results were made", commands, _COLUMNS),
        table_of("tasks", "Every task", in_tasks, Benchmark.columns),
    ]
    summary = {"command": command, "version": __version__, "seed": None}
    return page_data("benchmark", Page(f"Benchmark suite {suite.name}", [suite.description], tables), summary)


_BEHIND = "Mean time minus that of the best, or of the second agent, in the same worlds; 95 % interval"
_COLUMNS = (
    *shared("agent"),
    Column("agents", "agents"),
    Benchmark.columns[-1],
    Column("mean_s", "mean time", "s", help="Over the tasks, each with the same weight; 95 % interval"),
    Column("behind_s", "behind", "s", 2, signed=True, help=_BEHIND),
    *shared("decision_ms"),
    Column("searches", "searches", digits=0),
    Column("error", "standard error", "s", 2),
    Column("searches_for_1_s", "searches for ±1 s", digits=0, help="At 95 %"),
    Column("command", "command"),
    *_WHO,
)
