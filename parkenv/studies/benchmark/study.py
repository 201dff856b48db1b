"""Run agents through all episodes of the benchmark suite."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from parkenv.files.known_names import SuiteName
from parkenv.files.limited_reading import read_json
from parkenv.files.option import Inside, Option, option
from parkenv.show.tables import Column, shared, spread, table_of
from parkenv.studies.compare.comparison import CaseStudy
from parkenv.studies.fields import Agents, AgentSpec, ScenarioItem, one_word
from parkenv.studies.results import Results, Row, agent_fingerprints, fingerprints, flat_tables
from parkenv.studies.study import Cell
from parkenv.studies.workers import Task
from parkenv.version import __version__

if TYPE_CHECKING:
    from parkenv.studies.benchmark.suite import Suite

RESULT = "result.json"
AGENTS = ("belief", "mdp-tuned", "mdp", "first-free", "greedy-drive", "greedy-goal")


def score_table(results: Sequence[Row]) -> Row:
    rows = [
        {**row, "score": result["scores"][row["agent"]]}
        for result in results
        for row in spread(result["rows"], ("agent",), "task", "total_s")
    ]
    rows.sort(key=lambda row: -row["score"])
    names = dict.fromkeys(key for row in rows for key in row if key not in ("agent", "score"))
    columns = (*shared("agent"), *(Column(name, name) for name in names), Benchmark.columns[-1])
    return table_of("scores", "Mean total time, s, and the score", rows, columns)


class Benchmark(CaseStudy):
    """A suite defines scenarios, costs, speeds and seeds.

    An agent's score in a task is the mean total time of the clairvoyant bound divided by the agent's own; its score in
    the suite is the mean over the tasks, at most 1. In a world of your own (`--on`) it is a comparison: means over all
    searches, and no score.
    """

    table_titles: ClassVar = {"rows": "Results", "tasks": "By task"}
    shown: ClassVar = {
        "rows": CaseStudy.shown["rows"],
        "tasks": ("scenario", "agent", "episodes", "total_s", "difference_s", "regret_s", "parked_fraction"),
    }
    columns: ClassVar = (
        Column("task", "task", setting=True),
        *shared("agent"),
        Column("score", "score", share=True, help="Mean time of the clairvoyant bound over the agent's"),
    )
    writes: ClassVar = "result.json and the episodes"
    examples: ClassVar = """
        parkenv benchmark run v3 --agents belief,mdp --out results/v3
        parkenv benchmark check results/v3/result.json
        parkenv benchmark run streets-v1 --on district.toml --agents belief,first-free
        """

    kind: Literal["benchmark"] = "benchmark"
    suite: SuiteName = option("v3", "The suite.", name="SUITE", argument=True)
    by: str = option("", "Who submits the result.", default="nobody", max_length=200)
    code: str = option(
        "",
        "Address of the agents' code, with its commit, or path in parkenv's repository; needed on a leaderboard unless "
        "they come with parkenv.",
        takes="URL",
        default="parkenv's own",
        max_length=200,
    )
    agents: Agents = tuple(AgentSpec(name=name) for name in AGENTS)
    on: Annotated[
        ScenarioItem | None,
        Field(
            description="Run the suite's protocol in this world instead, such as recorded kerbs: its hours and goals, "
            "with intervals by day. A scenario file (.toml) with lot and log, or a lot (.geojson)."
        ),
        Option(takes="NAME|FILE", parse=one_word, default="the suite's worlds"),
        Inside(only=()),
    ] = None

    @cached_property
    def made_suite(self) -> Suite:
        from parkenv.studies.benchmark.suite import Suite

        return Suite.packaged(self.suite)

    def check(self) -> None:
        self.cells()

    def settings(self) -> Row:

        return {
            "version": __version__,
            "suite": self.made_suite.name,
            "suite_sha256": self.made_suite.fingerprint,
            "on": None if self.on is None else flat_tables(self.on.model_dump(mode="json")),
            "files": fingerprints(self.files()),
            "agent files": agent_fingerprints(agent.name for agent in self.agents),
        }

    def cells(self) -> list[Cell]:
        return self._cases

    @cached_property
    def _cases(self) -> list[Cell]:
        suite = self.made_suite
        return suite.cases(self.agents) if self.on is None else suite.cases_on(self.on, self.agents)

    def summarise(self, results: Results) -> Row:
        from parkenv.studies.benchmark.suite import score_rows, world_rows

        if self.on is not None:
            return world_rows(self.on.title, self.cells(), results.rows(self.table))
        return {"rows": score_rows(self.made_suite, self.cells(), results.rows(self.table))}

    @classmethod
    def printed(cls, summary: Row, folder: Path) -> list[Row]:
        if "tasks" in summary:
            return super().printed(summary, folder)
        return [score_table([read_json(folder / RESULT)])] if summary["complete"] else []

    def outputs(self, results: Results, summary: Row) -> list[Task[object]]:
        from parkenv.studies.benchmark.suite import result_of, write_result

        if self.on is not None:
            return []
        finished = results.rows(self.table)
        command = summary["command"]
        content = result_of(self.made_suite, self.cells(), finished, command, self.by, self.code)
        return [partial(write_result, results.path, content, RESULT)]
