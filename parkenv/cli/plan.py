"""`parkenv plan`: what the thesis's planner intends."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from parkenv.cli.options import Command
from parkenv.cli.tables import make_console, print_rows, save_summary
from parkenv.files.atomic_write import make_folder
from parkenv.files.option import Inside, option
from parkenv.scenarios.spec import scenario_spec
from parkenv.show.columns import SETTING_AXES
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.comparison import Grid
from parkenv.studies.fields import TRAFFIC, OneAgent, OneScenario, Seed


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
        from parkenv.scenarios.build import build
        from parkenv.show.figures.picture_files import save_picture
        from parkenv.show.figures.searches import draw_searches
        from parkenv.studies.compare.cases import plan_searches, settings_of

        console = make_console()
        grid = self.grid
        with console.status("Planning"):
            settings = settings_of(build(self.scenario), grid.failure_s, grid.v_walk_kmh, grid.v_drive_kmh)
            rows, searches = plan_searches(settings, self.agent, self.seed)
            make_folder(self.out)
            save_picture(draw_searches(searches), self.out / "plan.png")
        save_summary(self.out, self.seed, rows)
        title = f"{self.scenario.title}: plans of {self.agent.label}, seed {self.seed}"
        print_rows(
            console,
            title,
            rows,
            (*SETTING_AXES, "slot", "expected_s", "total_s", "driven_m", "walked_m", "replans"),
        )
        console.print(f"Picture and summary are in {self.out}")
