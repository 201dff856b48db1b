"""`parkenv compare`: compare agents in the same worlds; `parkenv plan`: what the thesis's planner intends."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field

from parkenv.cli.options import Command, Given
from parkenv.cli.study_command import StudyCommand
from parkenv.cli.tables import make_console, print_rows, save_summary
from parkenv.files.option import Inside, option
from parkenv.scenarios.spec import scenario_spec
from parkenv.show.columns import SETTING_AXES
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.comparison import Grid
from parkenv.studies.fields import TRAFFIC, OneAgent, OneScenario, Seed


class Compare(StudyCommand):
    """A comparison, which may use the largest lots only."""

    largest: int | None = option(
        None, "Use only the scenarios with the N largest lots.", panel="World", default="all", ge=1
    )

    @classmethod
    def of(cls, given: Given) -> Self:
        command = super().of(given)
        if command.largest is None:
            return command
        from parkenv.scenarios.build import largest_lots

        scenarios = largest_lots(command.study.scenarios, command.largest)  # type: ignore[attr-defined]
        return command.changed(study=command.study.changed(scenarios=tuple(scenarios)))


class Plan(Command):
    """The picture shows the true occupancy (inner disc) and the forecast (outer ring) of each slot.

    It also shows the planned action at each vertex (arrow), the path driven with replanning, and the walk.
    """

    examples = """
        parkenv plan --scenario jam --failure-cost 10,90
        parkenv plan --scenario campus --failure-cost 90 --v-walk-kmh 4,10
        """

    scenario: Annotated[OneScenario, Inside(without=TRAFFIC)] = scenario_spec("campus")
    agent: OneAgent = Field(
        AgentSpec(name="mdp"),
        description="mdp or mdp-static, with any options in brackets: mdp(failure_s=90).",
    )
    seed: Seed = Field(0, description="Seed of the world.")
    grid: Annotated[Grid, Inside(only=("--failure-cost", "--v-walk-kmh", "--v-drive-kmh"))] = Grid()
    out: Path = option(Path("results/plan"), "Folder for plan.png and summary.json.", short="-o")

    def run(self) -> None:
        from parkenv.files.atomic_write import make_folder
        from parkenv.scenarios.build import build
        from parkenv.show.figures.picture_files import save_picture
        from parkenv.show.figures.searches import draw_searches
        from parkenv.studies.compare.plans import plan_searches

        console = make_console()
        with console.status("Planning"):
            rows, traces = plan_searches(build(self.scenario), self.agent, self.grid, self.seed)
            make_folder(self.out)
            save_picture(draw_searches(traces), self.out / "plan.png")
        save_summary(self.out, self.seed, rows)
        title = f"{self.scenario.title}: plans of {self.agent.label}, seed {self.seed}"
        print_rows(
            console,
            title,
            rows,
            (*SETTING_AXES, "slot", "expected_s", "total_s", "driven_m", "walked_m", "replans"),
        )
        console.print(f"Picture and summary are in {self.out}")
