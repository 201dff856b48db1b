"""`parkenv compare`: compare agents in the same worlds; `parkenv plan`: what the thesis's planner intends."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

from pydantic import Field

from parkenv.cli.options import Command, Given
from parkenv.cli.study_command import AgentStudyCommand
from parkenv.cli.tables import make_console, make_table, print_rows, save_summary
from parkenv.files.option import Inside, option
from parkenv.scenarios.spec import scenario_spec
from parkenv.show.columns import SETTING_AXES
from parkenv.show.plurals import plural
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.compare.comparison import Comparison, Grid
from parkenv.studies.fields import TRAFFIC, OneAgent, OneScenario, Seed
from parkenv.studies.results import Row
from parkenv.world.cost_terms import COST_FIELDS

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from parkenv.studies.runner import Result

LEVELS = (0.5, 0.7, 0.8, 0.9, 0.95, 0.99)
"""Default occupancy levels of a comparison."""
MOST_SETTINGS = 12
"""Maximum number of settings to print in full; see the figures and files for larger grids."""
SHOWN = (
    "scenario", *SETTING_AXES, "agent", "episodes", "total_s", "median_s", "gave_up_fraction", "difference_s",
    "regret_s", "gap_to_exact", "gap_to_bound", *COST_FIELDS, "parked_fraction", "replans", "decision_ms",
    "decision_ms_p99",
)  # fmt: skip
"""Columns that are printed."""


class Compare(AgentStudyCommand):
    """Episode i has the same seed for every agent, hence the same cars at the same times.

    The table gives the mean total time (drive + failed attempts + walk) with its 95 % interval, the paired difference
    to the first agent, and the regret to the clairvoyant bound. Options are shortcuts for an experiment file for
    `parkenv run`.
    """

    examples = """
        parkenv compare --scenario campus,jam --failure-cost 10,90 --out results
        parkenv compare --agents "mdp(failure_s=90),belief,oracle" --report
        parkenv compare --agents mdp,mdp-tuned,oracle --failure-cost sweep
        parkenv compare --scenario lots --largest 5 --report
        parkenv compare --lot lot.geojson --occupancy log.csv.gz -n 300
        parkenv compare --resume --episodes 1000
        """

    study: Comparison = Comparison().changed(grid={"occupancy_levels": LEVELS})
    largest: int | None = option(
        None, "Use only the scenarios with the N largest lots.", panel="World", default="all", ge=1
    )
    out: Path = option(
        Path("results/compare"),
        "Folder for experiment.json, episodes.csv, summary.json and the figures.",
        short="-o",
    )

    @classmethod
    def of(cls, given: Given) -> Self:
        """See `StudyCommand`; a sweep of failure costs has no occupancy levels, and also blind searches."""
        command = super().of(given)
        study, sweep = command.study, given.get("--failure-cost") == "sweep"
        if sweep and "--occupancy-levels" not in given and not command.resume:
            study = study.changed(grid=study.grid.changed(occupancy_levels=()))
        if sweep or ("--failure-cost" in given and study.grid.blind):
            study = study.changed(grid=study.grid.changed(blind=sweep))
        if command.largest is not None:
            from parkenv.scenarios.build import largest_lots

            study = study.changed(scenarios=tuple(largest_lots(study.scenarios, command.largest)))
        return command.changed(study=study)

    def show(self, console: Console, result: Result) -> None:
        """Print the tables of a comparison."""
        from parkenv.world.scenario import KMH

        rows = with_short_labels(result.rows)
        count = len({tuple(row[name] for name in ("scenario", *SETTING_AXES)) for row in rows})
        if count <= MOST_SETTINGS:
            print_rows(console, "Results", rows, SHOWN)
        else:
            tables = cost_tables(rows)
            for printed in tables if len(tables) <= MOST_SETTINGS else []:
                console.print(printed)
            console.print(f"{count} settings: intervals and paired differences are in summary.json")
        if (measured := result.summary.get("calibrated")) is not None:
            console.print(
                f"Calibrated over {plural(measured['trips'], 'trip')}: failure cost {measured['failure_s']:.4g} s, "
                f"drive {measured['v_drive'] / KMH:.4g} km/h. Parking takes {measured['manoeuvre_s']:.1f} s more for "
                "the manoeuvre into the slot, under either cost; the tables leave that out."
            )


def cost_tables(rows: list[Row]) -> list[Table]:
    """Make the tables of mean total times by failure cost: one of each scenario and speeds."""
    grids: dict[tuple[Any, ...], dict[str, dict[float, str]]] = {}
    for row in rows:
        grid = grids.setdefault((row["scenario"], row["v_walk_kmh"], row["v_drive_kmh"]), {})
        grid.setdefault(row["agent"], {})[row["failure_cost_s"]] = f"{row['total_s']:.1f}"
    tables = []
    for (name, walk, drive), grid in grids.items():
        costs = sorted({cost for cells in grid.values() for cost in cells})
        title = f"{name}: mean total time, s, by failure cost, s; walk {walk:g} km/h, drive {drive:g} km/h"
        cells = ((agent, *(its.get(cost, "") for cost in costs)) for agent, its in grid.items())
        tables.append(make_table(title, ("agent", *(f"{cost:g}" for cost in costs)), cells))
    return tables


def with_short_labels(rows: Sequence[Row]) -> list[Row]:
    """Return rows whose agents have no folders of files, unless two agents would have the same name."""
    short = {row["agent"]: re.sub(r":[^()]*[/\\]", ":", row["agent"]) for row in rows}
    times = Counter(short.values())
    return [row | {"agent": label} if times[label := short[row["agent"]]] == 1 else row for row in rows]


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
        shown = (*SETTING_AXES, "slot", "expected_s", "total_s", "driven_m", "walked_m", "replans")
        print_rows(console, title, rows, shown)
        console.print(f"Picture and summary are in {self.out}")
