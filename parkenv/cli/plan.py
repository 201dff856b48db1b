"""`parkenv plan`: the plan of the thesis's planner on a lot."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from parkenv.cli.options import Command
from parkenv.cli.tables import make_console, make_table, save_summary
from parkenv.files.option import Inside, option
from parkenv.scenarios.spec import scenario_spec
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
        """See `Command`."""
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
        cells = (
            (
                f"{row['failure_cost_s']:g}", f"{row['v_walk_kmh']:g}", f"{row['v_drive_kmh']:g}",
                f"{row['expected_s']:.1f}", f"{row['total_s']:.1f}", f"{row['driven_m']:.0f}", row["slot"],
                f"{row['walked_m']:.0f}", str(row["replans"]),
            )
            for row in rows
        )  # fmt: skip
        headings = (
            "failure s", "walk km/h", "drive km/h", "expected s", "took s", "driven m", "slot", "walked m", "replans",
        )  # fmt: skip
        title = f"{self.scenario.title}: plans of {self.agent.label}, seed {self.seed}"
        console.print(make_table(title, headings, cells))
        console.print(f"Picture and summary are in {self.out}")
