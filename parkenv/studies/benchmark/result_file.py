"""Result files of the benchmark suite: what a run writes, and the check that anybody can repeat."""

from __future__ import annotations

import contextlib
import json
import re
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.files.atomic_write import write_text
from parkenv.files.limited_reading import read_json
from parkenv.files.spec_file import Several, Spec
from parkenv.studies.benchmark.suite import (
    CONTROLS,
    Suite,
    Task,
    estimate,
    score_of,
    sha256_of,
    worlds_of,
)
from parkenv.studies.compare.cases import Case
from parkenv.studies.results import Key, Row, decision_s, without_nan
from parkenv.studies.statistics import columns_of, decision_columns
from parkenv.version import __version__

RESULT_FORMAT = "parkenv-benchmark-result"
RESULT_VERSION = 2
_ROUNDED = 1e-3  # s; times are written to 1 ms
_HERE = Path(__file__).parent

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


class ResultFile(Spec):
    """Result of the benchmark suite: scores by agent, and searches by agent and task."""

    format: Literal["parkenv-benchmark-result"]
    version: Literal[2]
    suite: Literal["v3"]
    suite_sha256: str = Field(pattern="^[0-9a-f]{64}$")
    parkenv: str
    commit: str = Field(max_length=60)
    command: Several[str]
    by: str = Field(max_length=200)
    code: str = Field(max_length=200)
    date: str = Field(pattern="^[0-9]{4}-[0-9]{2}-[0-9]{2}$")
    rows: Several[_ResultRow] = Field(min_length=1)
    scores: dict[str, Share]
    episodes: dict[str, dict[str, _Searches]]
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


def score_rows(
    suite: Suite, cells: Iterable[tuple[Case, Sequence[int]]], finished: Mapping[Key, Row]
) -> list[Row]:
    """Return a row for each task and agent whose episodes are all finished: its metrics, where known, and its score.

    The means are estimates for the population of the task.
    """
    tasks, rows = {task.name: task for task in suite.tasks}, []
    for case, seeds in cells:
        task = tasks[case.scenario.name]
        its = [finished[key] for seed in seeds if (key := case.key(seed)) in finished]
        if len(its) < len(seeds):
            continue
        total = np.array([search["total_s"] for search in its])
        worlds = np.array([[search[name] for name in CONTROLS] for search in its])
        row = _metrics(task, its, total, worlds)
        metrics = {metric: row.get(metric) for metric in METRICS}
        rows.append(
            {"task": task.name, "agent": case.label, **metrics, "score": score_of(task, total, worlds)}
        )
    return rows


def _metrics(task: Task, searches: Sequence[Row], total: FloatArray, worlds: FloatArray) -> Row:
    parked, failed = (
        estimate(task, [float(search[name]) for search in searches], worlds, controls=False).mean
        for name in ("parked", "failed_parks")
    )
    return {
        "episodes": len(searches),
        "parked_fraction": min(parked, 1.0),
        "failed_parks": failed,
        **_estimates(task, total, worlds),
        **decision_columns([time for search in searches for time in decision_s(search)]),
    }


def result_of(
    suite: Suite,
    cells: Sequence[tuple[Case, Sequence[int]]],
    finished: Mapping[Key, Row],
    command: Sequence[str],
    by: str = "",
    code: str = "",
) -> Row:
    """Build the content of a result file from finished cases.

    Args:
        suite: the suite.
        cells: all cases with their seeds.
        finished: rows of all their episodes, by `Case.key`.
        command: the command that ran them.
        by: who submits the result; dated today.
        code: address of the agents' code.
    """
    rows = score_rows(suite, cells, finished)
    episodes: dict[str, dict[str, dict[str, list[float]]]] = {}
    for case, seeds in cells:
        times = [round(finished[case.key(s)]["total_s"], 3) for s in seeds]
        episodes.setdefault(case.label, {})[case.scenario.name] = {"total_s": times}
    content: Row = without_nan(
        {
            "format": RESULT_FORMAT,
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
            "scores": {
                agent: float(np.mean([row["score"] for row in rows if row["agent"] == agent]))
                for agent in episodes
            },
            "episodes": episodes,
        }
    )
    return {**content, "sha256": fingerprint(content)}


def write_result(folder: Path, content: Row, name: str) -> None:
    """Write a result file, with the numbers of a list in one line."""
    text = json.dumps(content, indent=1, allow_nan=False)
    text = re.sub(r"\[[-+.eE\d,\s]+\]", lambda found: " ".join(found[0].split()), text)
    write_text(folder / name, text + "\n")


def source_commit() -> str:
    """Return the commit of this package's source, with `-dirty` if files differ from it; empty outside a repository."""
    git = ("git", "-C", str(_HERE))
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        for command in (
            (*git, "ls-files", "--error-unmatch", Path(__file__).name),
            (*git, "describe", "--always", "--dirty"),
        ):
            done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=20.0)
        return done.stdout.strip()
    return ""


def check_result(path: Path) -> Row:
    """Read a result file, and check that it is complete, consistent, and from the suite's own worlds.

    The check recomputes the clairvoyant bounds of all searches, which differ in other worlds or with other costs and
    speeds, and from the times of the searches all means and scores. It cannot verify the times of an agent; for that,
    run the agent again.
    """
    result: Row = read_json(path)
    ResultFile.parse(result, str(path))
    suite = Suite.packaged()
    _require(path, "suite_sha256", result["suite_sha256"], suite.fingerprint, f"that of suite {suite.name}")
    rows = {(row["agent"], row["task"]): (i, row) for i, row in enumerate(result["rows"])}
    for agent, tasks in result["episodes"].items():
        for task in suite.tasks:
            if (agent, task.name) not in rows:
                raise InputError(f"{path}: rows has none of {agent} in {task.name}, want one")
            _check_task(path, agent, task, tasks.get(task.name) or {}, rows.pop((agent, task.name)), suite)
        own = [row["score"] for row in result["rows"] if row["agent"] == agent]
        _require(
            path, f"scores.{agent}", result["scores"].get(agent), float(np.mean(own)), "the mean of its tasks"
        )
    if rows or result["scores"].keys() != result["episodes"].keys():
        raise InputError(
            f"{path}: rows or scores are of others than {', '.join(result['episodes'])} in the tasks"
        )
    _require(path, "sha256", result["sha256"], fingerprint(result), "the hash of all else in the file")
    return result


def _check_task(
    path: Path, agent: str, task: Task, searches: Row, numbered: tuple[int, Row], suite: Suite
) -> None:
    where, worlds = f"episodes.{agent}.{task.name}", worlds_of(task, suite)
    number, row = numbered
    total = np.array(searches.get("total_s", ()))
    for name, counted in ((f"{where}.total_s", len(total)), (f"rows[{number}].episodes", row["episodes"])):
        _require(
            path, name, counted, len(worlds), f"a search for each seed of suite {suite.name}", "searches"
        )
    for i in np.flatnonzero(total < worlds[:, 0] - _ROUNDED):
        raise InputError(
            f"{path}: {where}.total_s[{i}] is {total[i]:g}, want at least the clairvoyant bound, {worlds[i, 0]:.3f}"
        )
    wanted = {**_estimates(task, total, worlds), "score": score_of(task, total, worlds)}
    for name, value in wanted.items():
        of = f"of the searches of {agent} in {task.name}"
        _require(path, f"rows[{number}].{name}", row[name], value, of)


def _estimates(task: Task, total: FloatArray, worlds: FloatArray) -> Row:
    return {
        **columns_of("total_s", estimate(task, total, worlds).interval()),
        **columns_of("regret_s", estimate(task, total - worlds[:, 0], worlds).interval()),
    }


def _require(path: Path, field: str, value: Any, wanted: Any, why: str, unit: str = "") -> None:
    """Check a value of a result file against what its searches or its suite say; times were rounded to 1 ms."""
    if isinstance(wanted, str):
        same = value == wanted
    else:
        same = np.allclose(np.array(value, float), np.array(wanted, float), rtol=0.0, atol=_ROUNDED)
        wanted = np.round(wanted, 4).tolist()
    if not same:
        raise InputError(f"{path}: {field} is {value}, want {wanted}{unit and ' ' + unit}, {why}")


def fingerprint(content: Row) -> str:
    """Return the SHA-256 of a result, without its own entry."""
    return sha256_of({key: value for key, value in content.items() if key != "sha256"})
