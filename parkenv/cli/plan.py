"""`parkenv plan`: the plan of the thesis's planner on a lot."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from parkenv import __version__
from parkenv.cli import arguments as args
from parkenv.cli.tables import make_console, make_table
from parkenv.errors import InputError
from parkenv.scenarios.build import build


def plan(
    scenario: args.ScenarioOption = None,
    lot: args.LotOption = None,
    occupancy: args.OccupancyOption = None,
    mapping: args.MappingOption = None,
    goal: args.GoalOption = None,
    arrival: args.ArrivalOption = None,
    days: args.DaysOption = None,
    view_range: args.ViewRangeOption = None,
    agent: Annotated[
        str,
        typer.Option(
            "--agent",
            help="A planning agent, mdp or mdp-static, with options in brackets: mdp(failure_s=90).",
        ),
    ] = "mdp",
    failure_cost: args.FailureCostOption = None,
    v_walk_kmh: args.WalkOption = None,
    v_drive_kmh: args.DriveOption = None,
    seed: args.SeedOption = 0,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for plan.png and summary.json.")] = Path(
        "results/plan"
    ),
) -> None:
    """Plan a search, and run it once in each setting, as in Fig. 4.9 to 4.12 of the thesis.

    The picture shows the true occupancy (inner disc) and the forecast (outer ring) of each slot, the planned action at
    each vertex (arrow), the path driven with replanning, and the walk.

    Examples:
    * `parkenv plan --scenario jam --failure-cost 10,90`

    * `parkenv plan --scenario campus --failure-cost 90 --v-walk-kmh 4,10`
    """
    import numpy as np

    from parkenv.evaluation.experiments.agent_spec import AgentSpec
    from parkenv.evaluation.experiments.compare import Case, settings_of
    from parkenv.evaluation.experiments.results import make_folder, write_summary
    from parkenv.evaluation.experiments.spec import Grid
    from parkenv.evaluation.figures.picture_files import save_picture
    from parkenv.evaluation.figures.search_pictures import draw_searches
    from planners.agent import make_agent
    from planners.thesis.replanning import StaticAgent

    grid = args.changed_axes(
        Grid(),
        {
            "--failure-cost": ("failure_s", failure_cost),
            "--v-walk-kmh": ("v_walk_kmh", v_walk_kmh),
            "--v-drive-kmh": ("v_drive_kmh", v_drive_kmh),
        },
    )
    base = build(
        args.one_scenario(
            args.scenario_specs(
                scenario, lot=lot, occupancy=occupancy, mapping=mapping, goal=goal, arrival=arrival, days=days,
                view_range=view_range,
            )
        )
    )  # fmt: skip
    named = AgentSpec.of(agent)
    if not isinstance(make_agent(named.name, base, **named.options), StaticAgent):
        raise InputError(f"--agent {agent!r} makes no plan; known: mdp, mdp-static")
    make_folder(out)

    console = make_console()
    headings = (
        "failure s",
        "walk",
        "drive km/h",
        "expected s",
        "took s",
        "driven m",
        "slot",
        "walked m",
        "re-plans",
    )
    table = make_table(f"{base.name}: plans of {agent}, seed {seed}", headings)
    rows, traces = [], []
    with console.status("Planning"):
        for setting in settings_of(base, grid.failure_s, grid.v_walk_kmh, grid.v_drive_kmh):
            case = Case(setting, named.name, options=named.options)
            trace = case.trace(seed)
            planner = make_agent(named.name, setting, **named.options)
            assert isinstance(planner, StaticAgent)
            expected = planner.expected_time(trace.forecast)[trace.path[0]]
            slots = [
                setting.lot.slot_ids[v] if v < setting.lot.n_slots else f"junction {v}" for v in trace.path
            ]
            parked = slots[-1] if trace.metrics["parked"] else ""
            row = {
                **case.columns,
                "expected_s": float(expected),
                "slot": parked,
                **trace.metrics,
                "path": slots,
            }
            row["occupancy"] = float(np.mean(trace.occupied))
            rows.append(row)
            traces.append(trace)
            table.add_row(
                f"{setting.failure_s:g}",
                f"{row['v_walk_kmh']:g}",
                f"{row['v_drive_kmh']:g}",
                f"{expected:.1f}",
                f"{row['total_s']:.1f}",
                f"{row['driven_m']:.0f}",
                parked,
                f"{row['walked_m']:.0f}",
                str(row["replans"]),
            )
        save_picture(draw_searches(traces), out / "plan.png")
    summary = {"command": ["parkenv", *sys.argv[1:]], "version": __version__, "seed": seed, "rows": rows}
    write_summary(out, summary)
    console.print(table)
    console.print(f"Picture and summary are in {out}")
