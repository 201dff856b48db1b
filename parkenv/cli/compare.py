"""`parkenv compare`: compare agents in the same worlds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli import arguments as args
from parkenv.cli.folder_run import run_into
from parkenv.cli.report import make_report
from parkenv.cli.single_writer import writing_into
from parkenv.cli.tables import (
    WIDE,
    make_console,
    make_table,
    print_recorded,
)
from parkenv.cli.trust import readable_models, require_trust
from parkenv.errors import InputError
from parkenv.files.known_names import RigName
from parkenv.show.plurals import plural

if TYPE_CHECKING:
    from rich.table import Table

    from parkenv.studies.compare.cases import Case
    from parkenv.studies.spec import ExperimentSpec

Row = dict[str, Any]

LEVELS = (0.5, 0.7, 0.8, 0.9, 0.95, 0.99)
"""Default occupancy levels of a comparison."""
MOST_TABLES = 12
"""Maximum number of settings to print; see the figures and files for larger grids."""


def compare(
    agents: str | None = None,
    scenario: str | None = None,
    episodes: int | None = None,
    seed: int | None = None,
    out: Path = Path("results/compare"),
    *,
    costs: args.Costs,
    calibrated: Path | None = None,
    world: args.ObservedSearches,
    largest: int | None = None,
    occupancy_levels: str | None = None,
    map_says: str | None = None,
    rig: RigName | None = None,
    detector: str | None = None,
    figures: bool | None = None,
    rerun: Path | None = None,
    trust: bool = False,
    trust_model: bool = False,
    folder: args.ReportedRun,
    machines: args.Machines,
) -> None:
    """Compare agents over failure costs and speeds, all in the same worlds.

    Episode i has the same seed for every agent, hence the same cars at the same times. The table gives the mean total
    time (drive + failed attempts + walk) with its 95 % interval, the paired difference to the first agent, and the
    regret to the clairvoyant bound. Options are shortcuts for an experiment file, which `parkenv run` takes.

    Examples:
        parkenv compare --scenario campus,jam --failure-cost 10,90 --out results
        parkenv compare --agents "mdp(failure_s=90),belief,oracle" --report
        parkenv compare --agents mdp,mdp-tuned,oracle --failure-cost sweep
        parkenv compare --scenario lots --largest 5 --report
        parkenv compare --lot lot.geojson --occupancy log.csv.gz -n 300
        parkenv compare --resume --episodes 1000

    Options:
        scenario (NAME|FILE|DIR[,...]): {scenarios}; scenario files (.toml), lots (.geojson), or folders.  [default:
            campus]
        episodes, -n (N >= 1): Episodes of each agent in each setting.  [default: 200]
        seed (N >= 0): First seed; episode i uses seed + i.  [default: 0]
        out, -o (DIR): Folder for experiment.json, episodes.csv, summary.json and the figures.

    Costs and speeds:
        calibrated (FILE): Also compare at the failure cost and driving speed in a calibrated.json of `parkenv
            calibrate`, in the same worlds.

    World:
        largest (N >= 1): Of the scenarios, only those with the N largest lots.  [default: all]
        occupancy_levels (P[,...]|none): Also set the lot's mean occupancy to these values, with a third of the episodes
            each, for the figure of time against occupancy. Searches in a recorded log are binned instead.  [default:
            0.5,0.7,0.8,0.9,0.95,0.99; none with --failure-cost sweep]
        map_says (P[,...]): Also with wrong maps that give every slot this probability of being taken; draws total time
            against it.

    Results:
        figures: Draw figures.  [default: figures]
    """
    from parkenv.scenarios.build import largest_lots
    from parkenv.studies.agent_spec import split_agents
    from parkenv.studies.spec import FAILURE_COST_SWEEP, ExperimentSpec

    sweep = costs.failure_cost == "sweep"
    if folder.resume:
        base = args.saved(out, ExperimentSpec)
        named = args.not_none(agents=agents, detector=detector)
        require_trust(base, out, trust, given=named | machines.given)
    else:
        base = ExperimentSpec().changed(grid={"occupancy_levels": () if sweep else LEVELS})
    grid = costs.grid(base.grid)
    if sweep:
        grid = grid.changed(blind=True)
    elif costs.failure_cost is not None and base.grid.failure_s == FAILURE_COST_SWEEP:
        grid = grid.changed(blind=False)
    if occupancy_levels == "none":
        grid, occupancy_levels = grid.changed(occupancy_levels=()), None
    if calibrated is not None:
        grid = grid.changed("--calibrated", calibrated=calibrated)
    grid = args.changed_axis(grid, "occupancy_levels", "--occupancy-levels", occupancy_levels)
    grid = args.changed_axis(grid, "map_says", "--map-says", map_says)
    given = args.not_none(episodes=episodes, seed=seed, rig=rig, detector=detector, figures=figures)
    if agents is not None:
        given["agents"] = readable_models(split_agents(agents), trust_model)
    scenarios = tuple(world.specs(scenario, base.scenarios))
    if largest is not None:
        scenarios = tuple(largest_lots(scenarios, largest))
    spec = base.changed(scenarios=scenarios, grid=grid, **given, **machines.given)
    with writing_into(out, f"--resume --out {out}"):
        run_comparison(spec, out, folder, rerun)


def run_comparison(
    spec: ExperimentSpec, out: Path, folder: args.ReportedRun, rerun: Path | None = None
) -> None:
    """Run an experiment with a progress bar, print its tables and draw its figures.

    Raises:
        InputError: the experiment cannot be run, or the folder cannot be used.
        KeyboardInterrupt: the run was interrupted; the results of finished episodes are printed and in the folder.
    """
    from parkenv.studies.compare.experiment import run_experiment
    from parkenv.studies.compare.figures import draw_figures
    from parkenv.world.scenario import KMH

    if rerun is not None:
        from parkenv.studies.trips.sensor_log import require_viewer

        if spec.rig is None:
            raise InputError("--rerun records what sensors measure: add --rig laser")
        require_viewer()
    console = make_console()
    result = run_into(out, run_experiment, spec, folder, console, doing="Searching", unit="episodes")
    count = setting_count(result.rows)
    for printed in result_tables(result.rows, console.width) if count <= MOST_TABLES else []:
        console.print(printed)
    if count > MOST_TABLES:
        console.print(f"{count} settings: their tables are in summary.json")
    if (measured := result.experiment.calibration) is not None:
        console.print(
            f"Calibrated over {plural(measured.trips, 'trip')}: failure cost {measured.failure_s:.4g} s, drive "
            f"{measured.v_drive / KMH:.4g} km/h. Parking takes {measured.manoeuvre_s:.1f} s more for the manoeuvre "
            "into the slot, under either cost; the tables leave that out."
        )
    if not result.complete:
        raise KeyboardInterrupt
    if spec.figures:
        with console.status("Drawing figures"):
            draw_figures(result.figure_data(), out)
    console.print(f"Episodes{', summary and figures' if spec.figures else ' and summary'} are in {out}")
    if rerun is not None:
        with console.status(f"Running the first episode once more for {rerun}"):
            _record(*result.experiment.cases[0], rerun)
        print_recorded(console, rerun)
    if folder.report:
        make_report(out, spec)


def setting_count(rows: list[Row]) -> int:
    """Return the number of different scenarios and settings in rows."""
    return len({(r["scenario"], r["failure_cost_s"], r["v_walk_kmh"], r["v_drive_kmh"]) for r in rows})


def _record(case: Case, seeds: range, path: Path) -> None:
    """Record the first episode of a case with its sensors."""
    from parkenv.envs.perception import SearchPerceptionEnv
    from parkenv.studies.trips.sensor_log import record_search, sensor_log
    from planners.agent import make_agent

    env = SearchPerceptionEnv(case.scenario, rig=str(case.rig), detector=case.detector)
    with sensor_log(path, case.scenario.lot, env.rig) as log:
        record_search(env, make_agent(case.agent, env.scenario, **case.options), seeds[0], log)


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
            f"{plural(max(r['episodes'] for r in its_rows), 'episode')}"
        )
        costs = any(row["parking_cost_s"] for row in its_rows)
        details = tuple(column for column in _DETAILS if costs or column[0] != "parking")
        for columns in [results + details] if width >= WIDE else [results, details]:
            headings = ("agent", *(heading for heading, _ in columns))
            cells = ((row["agent"], *(text(row) for _, text in columns)) for row in its_rows)
            tables.append(make_table(title if columns is not details else None, headings, cells))
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
