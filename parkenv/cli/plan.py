"""`parkenv plan`: the plan of the thesis's planner on a lot."""

from __future__ import annotations

from pathlib import Path

from parkenv.cli import arguments as args
from parkenv.cli.tables import make_console, make_table, save_summary
from parkenv.errors import InputError


def plan(
    scenario: str | None = None,
    agents: str = "mdp",
    seed: int = 0,
    out: Path = Path("results/plan"),
    *,
    costs: args.Costs,
    world: args.ObservedSearches,
) -> None:
    """Plan a search, and run it once in each setting, as in Fig. 4.9 to 4.12 of the thesis.

    The picture shows the true occupancy (inner disc) and the forecast (outer ring) of each slot, the planned action at
    each vertex (arrow), the path driven with replanning, and the walk.

    Examples:
        parkenv plan --scenario jam --failure-cost 10,90
        parkenv plan --scenario campus --failure-cost 90 --v-walk-kmh 4,10

    Options:
        agents (NAME): mdp or mdp-static, with any options in brackets: mdp(failure_s=90).
        seed (N >= 0): Seed of the world.
        out, -o (DIR): Folder for plan.png and summary.json.
    """
    import numpy as np

    from parkenv.files.atomic_write import make_folder
    from parkenv.scenarios.build import build
    from parkenv.show.figures.picture_files import save_picture
    from parkenv.show.figures.searches import draw_searches
    from parkenv.studies.agent_spec import AgentSpec
    from parkenv.studies.compare.cases import Case, settings_of
    from parkenv.studies.compare.comparison import Grid
    from planners.agent import make_agent
    from planners.thesis.replanning import StaticAgent

    grid = costs.grid(Grid())
    base = build(world.spec(scenario))
    named = AgentSpec.of(args.one_agent(agents))
    if not isinstance(make_agent(named.name, base, **named.options), StaticAgent):
        raise InputError(f"--agents {agents!r} makes no plan; known: mdp, mdp-static")
    make_folder(out)
    console = make_console()
    cells, rows, traces = [], [], []
    with console.status("Planning"):
        for setting in settings_of(base, grid.failure_s, grid.v_walk_kmh, grid.v_drive_kmh):
            case = Case(setting, named.name, options=named.options)
            trace = case.runner().run(seed)
            planner = make_agent(named.name, setting, **named.options)
            assert isinstance(planner, StaticAgent)
            expected = float(planner.expected_time(trace.forecast)[trace.path[0]])
            ids, n = setting.lot.slot_ids, setting.lot.n_slots
            path = [ids[v] if v < n else f"junction {v}" for v in trace.path]
            parked = path[-1] if trace.metrics["parked"] else ""
            row = {
                **case.columns, "expected_s": expected, "slot": parked, **trace.metrics, "path": path,
                "occupancy": float(np.mean(trace.occupied)),
            }  # fmt: skip
            rows.append(row)
            traces.append(trace)
            cells.append(
                (
                    f"{setting.failure_s:g}", f"{row['v_walk_kmh']:g}", f"{row['v_drive_kmh']:g}", f"{expected:.1f}",
                    f"{row['total_s']:.1f}", f"{row['driven_m']:.0f}", parked, f"{row['walked_m']:.0f}",
                    str(row["replans"]),
                )
            )  # fmt: skip
        save_picture(draw_searches(traces), out / "plan.png")
    save_summary(out, seed, rows)
    headings = (
        "failure s", "walk km/h", "drive km/h", "expected s", "took s", "driven m", "slot", "walked m", "replans",
    )  # fmt: skip
    console.print(make_table(f"{base.name}: plans of {agents}, seed {seed}", headings, cells))
    console.print(f"Picture and summary are in {out}")
