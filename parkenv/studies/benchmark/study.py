"""Run agents through all episodes of the benchmark suite."""

from __future__ import annotations

from functools import cached_property, partial
from typing import TYPE_CHECKING, Literal

from parkenv.files.option import option
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.comparison import CaseStudy
from parkenv.studies.fields import Agents
from parkenv.studies.results import Results, Row
from parkenv.studies.study import Cell
from parkenv.studies.workers import Task
from parkenv.version import __version__

if TYPE_CHECKING:
    from parkenv.studies.benchmark.suite import Suite
    from parkenv.studies.runner import Result

RESULT = "result.json"
AGENTS = ("belief", "mdp-tuned", "mdp", "first-free", "greedy-drive", "greedy-goal")


class Benchmark(CaseStudy):
    """A run of the benchmark suite, which defines scenarios, costs, speeds and seeds."""

    kind: Literal["benchmark"] = "benchmark"
    suite: Literal["v3"] = option("v3", "The suite.", name="SUITE", argument=True)
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

    @cached_property
    def made_suite(self) -> Suite:
        """The suite."""
        from parkenv.studies.benchmark.suite import Suite

        return Suite.packaged()

    def check(self) -> None:
        self.cells()

    def settings(self) -> Row:
        from parkenv.studies.fingerprints import agent_fingerprints

        return {
            "version": __version__,
            "suite": self.made_suite.name,
            "suite_sha256": self.made_suite.fingerprint,
            "agent files": agent_fingerprints(agent.name for agent in self.agents),
        }

    def cells(self) -> list[Cell]:
        return self._cases

    @cached_property
    def _cases(self) -> list[Cell]:
        return self.made_suite.cases(self.agents)

    def summarise(self, results: Results) -> Row:
        from parkenv.studies.benchmark.result_file import score_rows

        return {"rows": score_rows(self.made_suite, self.cells(), results.rows(self.table))}

    def outputs(self, result: Result) -> list[Task[object]]:
        """See `Study`: the result file."""
        from parkenv.studies.benchmark.result_file import result_of, write_result

        finished = result.results.rows(self.table)
        command = result.summary["command"]
        content = result_of(self.made_suite, self.cells(), finished, command, self.by, self.code)
        return [partial(write_result, result.folder, content, RESULT)]
