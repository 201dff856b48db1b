"""`parkenv compare`: compare agents in the same worlds."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from parkenv.cli import arguments as args
from parkenv.cli.tables import WIDE, make_console, make_table
from parkenv.cli.trust import TrustModelOption, TrustOption, readable_models, require_trust
from parkenv.errors import InputError

if TYPE_CHECKING:
    from parkenv.evaluation.experiments.compare import Case
    from parkenv.evaluation.experiments.spec import ExperimentSpec

Row = dict[str, Any]

SWEEP = "sweep"
"""Keyword of `--failure-cost` for a range of costs."""
LEVELS = (0.5, 0.7, 0.8, 0.9, 0.95, 0.99)
"""Default occupancy levels of a comparison."""
MOST_TABLES = 12
"""Maximum number of settings to print; see the figures and files for larger grids."""


def compare(
    scenario: args.ScenariosOption = None,
    lot: args.LotOption = None,
    occupancy: args.OccupancyOption = None,
    mapping: args.MappingOption = None,
    goal: args.GoalOption = None,
    arrival: args.ArrivalOption = None,
    days: args.DaysOption = None,
    view_range: args.ViewRangeOption = None,
    sensor_model: args.SensorModelOption = None,
    rig: args.RigOption = None,
    agents: args.AgentsOption = None,
    episodes: Annotated[
        int | None,
        typer.Option(
            "--episodes", "-n", min=1, help="Episodes of each agent in each setting.  [default: 200]"
        ),
    ] = None,
    failure_cost: Annotated[
        str | None,
        typer.Option(
            "--failure-cost",
            metavar="S[,S...]|sweep",
            help="Seconds that the world charges for a failed attempt, and that planners expect to be charged unless "
            "their own options say otherwise: `--agents 'mdp,mdp(failure_s=90)'`. `sweep`: from 0 to 120 s, with and "
            "without observations of slots before an attempt, drawn as a curve.  [default: the scenario's, 10]",
            rich_help_panel=args.COSTS,
        ),
    ] = None,
    v_walk_kmh: args.WalkOption = None,
    v_drive_kmh: args.DriveOption = None,
    calibrated: Annotated[
        Path | None,
        typer.Option(
            "--calibrated",
            metavar="FILE",
            help="Also compare at the failure cost and driving speed that `parkenv calibrate` measured: FILE is its "
            "calibrated.json. The worlds are the same.",
            rich_help_panel=args.COSTS,
        ),
    ] = None,
    occupancy_levels: Annotated[
        str | None,
        typer.Option(
            "--occupancy-levels",
            metavar="P[,P...]|none",
            help="Also set the lot's mean occupancy to these values, with a third of the episodes each, for the figure "
            "of time against occupancy. A recorded log cannot be changed: its searches are binned instead.  "
            f"[default: {','.join(f'{level:g}' for level in LEVELS)}]",
        ),
    ] = None,
    map_says: Annotated[
        str | None,
        typer.Option(
            "--map-says",
            metavar="P[,P...]",
            help="Also with wrong maps, which give this probability of being taken for every slot. Draws total time "
            "against it.",
            rich_help_panel=args.WORLD,
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", min=0, help="First seed; episode i uses seed + i.  [default: 0]"),
    ] = None,
    jobs: args.JobsOption = 0,
    backend: args.BackendOption = "loky",
    address: args.AddressOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder for experiment.json, episodes.csv, summary.json and the figures.  [default: results/compare]",
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Finish the run in --out. It needs no other option; those given change it, such as more --episodes.",
        ),
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the results in --out.")] = False,
    figures: Annotated[bool | None, typer.Option(help="Draw figures.  [default: figures]")] = None,
    rerun: args.RerunOption = None,
    report: args.ReportOption = False,
    trust: TrustOption = False,
    trust_model: TrustModelOption = False,
) -> None:
    """Compare agents over failure costs and speeds, all in the same worlds.

    Episode i has the same seed for every agent, hence the same cars at the same times. The table gives the mean total
    time (drive + failed attempts + walk) with its 95 % interval, the paired difference to the first agent, and the
    regret to the clairvoyant bound. Options are shortcuts for an experiment file, which `parkenv run` takes.

    Examples:
    * `parkenv compare --scenario campus,jam --failure-cost 10,90 --out results`

    * `parkenv compare --scenario my_lot.toml --agents "mdp(failure_s=90),belief(budget_ms=2),oracle"`

    * `parkenv compare --failure-cost sweep --agents mdp,mdp-tuned,belief,oracle`

    * `parkenv compare --agents mdp,belief,oracle --calibrated results/calibrate/calibrated.json`

    * `parkenv compare --lot lot.geojson --occupancy log.csv.gz --agents mdp,greedy-goal,oracle -n 300`
    """
    from parkenv.evaluation.experiments.agent_spec import split_agents
    from parkenv.evaluation.experiments.spec import FAILURE_COST_SWEEP, SPEC_FILE, ExperimentSpec

    out = out or Path("results/compare")
    if resume:
        base = args.saved(out, SPEC_FILE, ExperimentSpec)
        if agents is None:
            require_trust(base, out, trust)
    else:
        base = ExperimentSpec().changed(grid={"occupancy_levels": list(LEVELS)})
    grid = base.grid
    if failure_cost == SWEEP:
        grid = grid.changed(failure_s=FAILURE_COST_SWEEP, blind=True, occupancy_levels=())
        failure_cost, occupancy_levels = None, None
    if occupancy_levels == "none":
        grid, occupancy_levels = grid.changed(occupancy_levels=()), None
    if calibrated is not None:
        grid = grid.changed("--calibrated", calibrated=calibrated)
    grid = args.changed_axes(
        grid,
        {
            "--failure-cost": ("failure_s", failure_cost),
            "--v-walk-kmh": ("v_walk_kmh", v_walk_kmh),
            "--v-drive-kmh": ("v_drive_kmh", v_drive_kmh),
            "--occupancy-levels": ("occupancy_levels", occupancy_levels),
            "--map-says": ("map_says", map_says),
        },
    )
    specs = args.scenario_specs(
        scenario, lot=lot, occupancy=occupancy, mapping=mapping, goal=goal, arrival=arrival, days=days,
        sensor_model=sensor_model, view_range=view_range, base=base.scenarios,
    )  # fmt: skip
    given = {
        "agents": None if agents is None else readable_models(split_agents(agents), trust_model),
        "episodes": episodes, "seed": seed, "rig": rig, "figures": figures,
    }  # fmt: skip
    spec = base.changed(
        scenarios=tuple(specs),
        grid=grid,
        jobs=jobs, backend=backend, address=address,
        **{name: value for name, value in given.items() if value is not None},
    )  # fmt: skip
    run_comparison(spec, out, resume=resume, overwrite=overwrite, rerun=rerun, report=report)


def run_comparison(
    spec: ExperimentSpec,
    out: Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    rerun: Path | None = None,
    report: bool = False,
) -> None:
    """Run an experiment with a progress bar, print its tables and draw its figures.

    Raises:
        InputError: the experiment cannot be run, or the folder cannot be used.
    """
    from parkenv.evaluation.experiments.experiment import run_experiment
    from parkenv.evaluation.figures.registry import draw_figures
    from parkenv.world.scenario import KMH

    if rerun is not None:
        from parkenv.evaluation.trips.sensor_log import require_viewer

        if spec.rig is None:
            raise InputError("--rerun records what sensors measure: add --rig laser")
        require_viewer()
    console = make_console()
    with episode_progress(console) as progress:
        bars: list[TaskID] = []
        result = run_experiment(
            spec,
            out,
            command=["parkenv", *sys.argv[1:]],
            resume=resume,
            overwrite=overwrite,
            workers=args.workers_of(spec.jobs, spec.backend, spec.address),
            on_start=lambda n: bars.append(progress.add_task("Searching", total=n)),
            on_progress=lambda n: progress.advance(bars[0], n),
        )
    tables = setting_count(result.rows) <= MOST_TABLES
    for printed in result_tables(result.rows, console.width) if tables else []:
        console.print(printed)
    if not tables:
        console.print(f"{setting_count(result.rows)} settings: their tables are in summary.json")
    if (measured := result.experiment.calibration) is not None:
        console.print(
            f"Calibrated over {measured.trips} trips: failure cost {measured.failure_s:.4g} s, drive "
            f"{measured.v_drive / KMH:.4g} km/h. Parking takes {measured.manoeuvre_s:.1f} s more for the manoeuvre "
            "into the slot, under either cost; the tables leave that out."
        )
    if not result.complete:
        console.print(f"Interrupted. What was finished is in {out}; --resume --out {out} goes on.")
        raise typer.Exit(130)
    if spec.figures:
        with console.status("Drawing figures"):
            draw_figures(result.figure_data(), out)
    console.print(f"Episodes, summary and figures are in {out}")
    if rerun is not None:
        with console.status(f"Searching the first search once more for {rerun}"):
            _record(*result.experiment.cases[0], rerun)
        console.print(f"Recorded: {rerun}; look at it with: rerun {rerun}")
    if report:
        from parkenv.cli.report import make_report

        make_report(out, jobs=spec.jobs, trust=True)


def setting_count(rows: list[Row]) -> int:
    """Return the number of different scenarios and settings in rows."""
    return len({(r["scenario"], r["failure_cost_s"], r["v_walk_kmh"], r["v_drive_kmh"]) for r in rows})


def _record(case: Case, seeds: range, path: Path) -> None:
    """Record the first episode of a case with its sensors."""
    from parkenv.envs.perception import SearchPerceptionEnv
    from parkenv.evaluation.trips.sensor_log import record_search, sensor_log
    from planners.agent import make_agent

    env = SearchPerceptionEnv(case.scenario, rig=str(case.rig))
    with sensor_log(path, case.scenario.lot, env.rig) as log:
        record_search(env, make_agent(case.agent, env.scenario, **case.options), seeds[0], log)


def episode_progress(console: Console) -> Progress:
    """Make a progress bar that counts episodes."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("searches"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
    )


Column = tuple[str, Callable[[Row], str]]

_DETAILS: tuple[Column, ...] = (
    ("drive", lambda r: _seconds(r["drive_s"])),
    ("failed", lambda r: _seconds(r["failed_s"])),
    ("walk", lambda r: _seconds(r["walk_s"])),
    ("parking", lambda r: _seconds(r["parking_cost_s"])),
    ("gave up", lambda r: _seconds(r["gave_up_s"])),
    ("parked", lambda r: f"{r['parked_fraction']:.0%}"),
    ("replans", lambda r: f"{r['replans']:.1f}"),
    ("ms/decision", lambda r: f"{r['decision_ms']:.2f}" if "decision_ms" in r else ""),
    ("p99", lambda r: f"{r['decision_ms_p99']:.2f}" if "decision_ms" in r else ""),
)


def result_tables(rows: list[Row], width: int) -> list[Table]:
    """Make the tables of each setting: one, or two if the terminal is narrow."""
    settings: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        key = (row["scenario"], row["failure_cost_s"], row["v_walk_kmh"], row["v_drive_kmh"])
        settings.setdefault(key, []).append(row)
    tables = []
    for (name, failure, walk, drive), its_rows in settings.items():
        first = its_rows[0]["agent"]
        results: tuple[Column, ...] = (
            ("total s [95 %]", lambda r: _interval(r["total_s"], r["total_s_ci95"])),
            (f"minus {first} [95 %]", lambda r, a=first: _difference(r, a)),  # type: ignore[misc]
            ("regret s", lambda r: _seconds(r["regret_s"])),
        )
        if any("gap_to_exact" in row for row in its_rows):
            results = (*results, ("over exact", lambda r: f"{r['gap_to_exact']:+.2%}"))
        title = (
            f"{name}: failure cost {failure:g} s, walk {walk:g} km/h, drive {drive:g} km/h, "
            f"{max(r['episodes'] for r in its_rows)} searches"
        )
        costs = any(row["parking_cost_s"] for row in its_rows)
        details = tuple(column for column in _DETAILS if costs or column[0] != "parking")
        for columns in [results + details] if width >= WIDE else [results, details]:
            headings = ("agent", *(heading for heading, _ in columns))
            table = make_table(title if columns is not details else None, headings)
            for row in its_rows:
                table.add_row(row["agent"], *(text(row) for _, text in columns))
            tables.append(table)
    return tables


def _difference(row: Row, first_agent: str) -> str:
    if row["agent"] == first_agent:
        return ""
    return _interval(row["difference_s"], row["difference_s_ci95"], signed=True)


def _interval(mean: float, ends: list[float], *, signed: bool = False) -> str:
    if ends[0] != ends[0]:
        return _seconds(mean, signed)
    return f"{_seconds(mean, signed)} [{_seconds(ends[0], signed)}, {_seconds(ends[1], signed)}]"


def _seconds(value: float, signed: bool = False) -> str:
    # Adding zero turns the -0.0 of a rounded difference into 0.0.
    return f"{round(value, 1) + 0.0:{'+' if signed else ''}{'.0f' if abs(value) >= 1000 else '.1f'}}"
