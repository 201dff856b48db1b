"""Run agents through all episodes of a benchmark suite."""

from __future__ import annotations

from functools import cached_property, partial
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from parkenv import __version__
from parkenv.files.option import option
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.comparison import CaseStudy
from parkenv.studies.fields import Agents
from parkenv.studies.results import Results, Row, write_summary
from parkenv.studies.study import Cell
from parkenv.studies.workers import Task

if TYPE_CHECKING:
    from parkenv.studies.benchmark.suite import Suite
    from parkenv.studies.runner import Result

RESULT = "result.json"
AGENTS = ("belief", "mdp-tuned", "mdp", "first-free", "greedy-drive", "greedy-goal")


class Benchmark(CaseStudy):
    """A run of a benchmark suite, which defines scenarios, costs, speeds and seeds."""

    kind: Literal["benchmark"] = "benchmark"
    suite: str = Field("v2", description="The suite.")
    by: str = option(
        "", "Who submits the result: a name, an address of the code.", default="nobody", max_length=200
    )
    agents: Agents = tuple(AgentSpec(name=name) for name in AGENTS)

    @cached_property
    def made_suite(self) -> Suite:
        """The suite."""
        from parkenv.studies.benchmark.suite import Suite

        return Suite.named(self.suite)

    def check(self) -> None:
        """See `Study`."""
        self.cells()

    def settings(self) -> Row:
        """See `Study`."""
        from parkenv.studies.fingerprints import agent_fingerprints

        return {
            "version": __version__,
            "suite": self.made_suite.name,
            "suite_sha256": self.made_suite.fingerprint,
            "agent files": agent_fingerprints(agent.name for agent in self.agents),
        }

    def cells(self) -> list[Cell]:
        """See `Study`."""
        return self._cases

    @cached_property
    def _cases(self) -> list[Cell]:
        return self.made_suite.cases(self.agents)

    def summarise(self, results: Results) -> Row:
        """See `Study`."""
        from parkenv.studies.benchmark.suite import score_rows

        return {"rows": score_rows(self.cells(), results.rows(self.table))}

    def outputs(self, result: Result) -> list[Task[object]]:
        """See `Study`: the result file."""
        from parkenv.studies.benchmark.suite import result_of

        finished = result.results.rows(self.table)
        content = result_of(self.made_suite, self.cells(), finished, result.summary["command"], self.by)
        return [partial(write_summary, result.folder, content, RESULT)]
