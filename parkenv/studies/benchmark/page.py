"""A page of the results that were submitted for a benchmark suite."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from typing import Any

from parkenv import __version__
from parkenv.errors import InputError
from parkenv.show.report.page import Page, page_data
from parkenv.show.report.tables import Cell, Column, described, table_of
from parkenv.studies.benchmark.suite import Suite, score_interval
from parkenv.studies.results import Row

_WHO = (
    Column("by", "submitted by"),
    Column("date", "date"),
    Column("parkenv", "parkenv", help="Version that made the result"),
)
_COMMAND = Column("command", "command")


def benchmark_data(results: Sequence[Row], command: Sequence[str]) -> dict[str, Any]:
    """Build the data of a page, the best score first; see `report.schema.json`.

    Args:
        results: contents of result files that passed `check_result`.
        command: the command that makes the page.

    Raises:
        InputError: the results are of different suites.
    """
    names = list(dict.fromkeys(result["suite"] for result in results))
    if len(names) != 1:
        raise InputError(f"a page is about one suite, the results are of {', '.join(names) or 'none'}")
    suite = Suite.named(names[0])
    tasks = [task.name for task in suite.tasks]
    columns = [
        Column("agent", "agent"),
        Column(
            "score",
            "score",
            share=True,
            help="Mean time of the clairvoyant bound over the agent's; 95 % interval",
        ),
        *(Column(task, task, "s", help="Mean total time, 95 % interval") for task in tasks),
        *_WHO,
    ]
    lines: list[list[Cell]] = []
    for result in results:
        times = {
            (row["agent"], row["task"]): [row["total_s"], *row["total_s_ci95"]] for row in result["rows"]
        }
        for agent, searches in result["episodes"].items():
            score: list[float | None] = list(score_interval(searches))
            lines.append([agent, score, *(times[agent, task] for task in tasks), *_origin(result).values()])
    lines.sort(key=lambda line: -line[1][0])  # type: ignore[index, operator]
    details = [{**row, **_origin(result)} for result in results for row in result["rows"]]
    commands: list[list[Cell]] = [
        [", ".join(r["episodes"]), shlex.join(r["command"]), *_origin(r).values()] for r in results
    ]
    findings = [
        suite.description,
        f"{len(tasks)} tasks of {len(suite.seeds)} searches each, the same worlds for every agent. The score is the "
        "mean time of the clairvoyant lower bound over the agent's, averaged over the tasks.",
    ]
    tables = [
        _table("scores", "Scores", columns, lines),
        _table(
            "commands", "How the results were made", [Column("agent", "agent"), _COMMAND, *_WHO], commands
        ),
        table_of("tasks", "Every task", details),
    ]
    made = {"command": command, "version": __version__, "seed": suite.seeds[0]}
    return page_data("benchmark", Page(f"Benchmark suite {suite.name}", findings, tables), made)


def _origin(result: Row) -> Row:
    return {column.key: result[column.key] for column in _WHO}


def _table(name: str, title: str, columns: Sequence[Column], rows: list[list[Cell]]) -> dict[str, Any]:
    shown = [described(column) for column in columns]
    return {"name": name, "title": title, "facts": False, "columns": shown, "rows": rows, "same": []}
