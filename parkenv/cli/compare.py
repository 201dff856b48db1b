"""`parkenv compare`: agents against each other in the same worlds."""

from __future__ import annotations

import dataclasses
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
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from parkenv import __version__
from parkenv.cli import arguments as args
from parkenv.cli.tables import WIDE, make_console, make_table
from parkenv.errors import InputError
from parkenv.scenarios.build import build

if TYPE_CHECKING:
    from parkenv.evaluation.experiments.compare import Case
    from parkenv.evaluation.trips.calibration import Calibration
    from parkenv.world.scenario import Scenario

Row = dict[str, Any]

ON_SIGHT = ("belief", "mdp-tuned", "exact")
"""Agents that refuse problems in which slots are seen only by trying."""
DEFAULT_AGENTS = "mdp,mdp-static,mdp-tuned,belief,greedy-goal,greedy-drive,first-free,random,oracle"
SWEEP = "sweep"
"""The failure cost that stands for many."""
MAP_SAYS = "-map-says-"
"""What stands between the names of scenarios with maps that are wrong on purpose and what these say."""
LEVELS = "0.5,0.7,0.8,0.9,0.95,0.99"


def compare(
    scenario: Annotated[
        str | None,
        typer.Option(
            "--scenario",
            metavar="NAME[,NAME...]",
            help="Packaged scenarios: campus, jam, street, mini.  [default: campus]",
            rich_help_panel=args.WORLD,
        ),
    ] = None,
    lot: args.LotOption = None,
    occupancy: args.OccupancyOption = None,
    mapping: args.MappingOption = None,
    goal: args.GoalOption = None,
    arrival: args.ArrivalOption = None,
    days: args.DaysOption = None,
    view_range: args.ViewRangeOption = None,
    sight: args.SensorModelOption = None,
    sensors: args.SensorsOption = None,
    agents: Annotated[
        str,
        typer.Option(
            "--agents",
            metavar="NAME[,NAME...]",
            help="Who searches; a name, ALGORITHM:FILE for a trained model, or MODULE:CLASS for an agent of your own. "
            "Differences are to the first.",
        ),
    ] = DEFAULT_AGENTS,
    episodes: Annotated[
        int, typer.Option("--episodes", "-n", min=1, help="Searches a setting and agent.")
    ] = 200,
    failure_cost: Annotated[
        str,
        typer.Option(
            "--failure-cost",
            metavar="S[,S...]|sweep",
            help="Seconds lost by a try at a taken slot. `sweep` draws total time against it from 0 to 120 s, with and "
            "without sight of the slots before a try; agents that plan on what they see are left out there.",
            rich_help_panel=args.COSTS,
        ),
    ] = "10",
    v_walk_kmh: args.WalkOption = "4",
    v_drive_kmh: args.DriveOption = "10",
    calibrated: Annotated[
        Path | None,
        typer.Option(
            "--calibrated",
            metavar="FILE",
            help="Also compare under the failure cost and driving speed that `parkenv calibrate` measured: FILE is its "
            "calibrated.json. Searches are the same as under the costs given here.",
            rich_help_panel=args.COSTS,
        ),
    ] = None,
    occupancy_levels: Annotated[
        str,
        typer.Option(
            "--occupancy-levels",
            metavar="P[,P...]|none",
            help="Also make the lot this full on average, with a third as many searches each, for the figure of "
            "time against occupancy. A recorded world is as full as it is: its searches are binned instead.",
        ),
    ] = LEVELS,
    map_says: Annotated[
        str | None,
        typer.Option(
            "--map-says",
            metavar="P[,P...]",
            help="Also with maps that are wrong on purpose: they say of every slot that it is taken with this "
            "probability. Draws total time against it.",
            rich_help_panel=args.WORLD,
        ),
    ] = None,
    solver: Annotated[
        str,
        typer.Option(
            "--solver",
            help="Of mdp and mdp-static: label_setting, or the thesis's policy_iteration; the plans are the same.",
        ),
    ] = "label_setting",
    budget_ms: Annotated[
        float | None,
        typer.Option("--budget-ms", help="About how long belief may take for a decision, ms.  [default: 5]"),
    ] = None,
    seed: args.SeedOption = 0,
    jobs: args.JobsOption = 0,
    backend: args.BackendOption = "loky",
    address: args.AddressOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder for episodes.csv, summary.json and the figures.  [default: results/compare]",
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the run in --out: add what is missing.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the results in --out.")] = False,
    figures: Annotated[bool, typer.Option(help="Draw figures.")] = True,
    rerun: args.RerunOption = None,
    report: Annotated[
        bool, typer.Option("--report", help="Also write report.html, as `parkenv report` does.")
    ] = False,
) -> None:
    """Compare agents over failure costs and speeds, all in the same worlds.

    Every agent meets the same cars at the same times: episode i of each has the same seed. The table
    gives mean total time (drive + failed tries + walk) with its 95 % interval, the paired difference to the
    first agent, and the regret to the clairvoyant bound.

    Examples:
    * `parkenv compare --scenario campus,jam --failure-cost 10,90 --out results`

    * `parkenv compare --failure-cost sweep --agents mdp,mdp-tuned,belief,oracle`

    * `parkenv compare --agents mdp,belief,oracle --calibrated results/calibrate/calibrated.json`

    * `parkenv compare --lot lot.geojson --occupancy log.csv.gz --agents mdp,greedy-goal,oracle -n 300`
    """
    from parkenv.evaluation.experiments.compare import check_worlds, table
    from parkenv.evaluation.experiments.results import ResultFolder
    from parkenv.evaluation.figures.registry import ComparisonResults, draw_figures, remove_figures
    from parkenv.world.scenario import KMH

    if rerun is not None:
        from parkenv.evaluation.trips.sensor_log import require_viewer

        if sensors is None:
            raise InputError("--rerun records what sensors measure: add --sensors laser")
        require_viewer()
    asked = comparison_of(
        scenario=scenario, lot=lot, occupancy=occupancy, mapping=mapping, goal=goal, arrival=arrival, days=days,
        view_range=view_range, sight=sight, sensors=sensors, agents=agents, episodes=episodes,
        failure_cost=failure_cost, v_walk_kmh=v_walk_kmh, v_drive_kmh=v_drive_kmh, calibrated=calibrated,
        occupancy_levels=occupancy_levels, map_says=map_says, solver=solver, budget_ms=budget_ms, seed=seed,
    )  # fmt: skip
    cases, sweep, scenarios, maps, measured = (
        asked.cases,
        asked.sweep,
        asked.scenarios,
        asked.maps,
        asked.measured,
    )
    sweeps = failure_cost == SWEEP
    settings = {
        "version": __version__,
        "scenarios": [s.name for s in scenarios],
        "lot": lot,
        "occupancy": args.fingerprint(occupancy),
        "mapping": args.fingerprint(mapping),
        "goal": goal,
        "arrival": arrival,
        "days": days,
        "view_range": view_range,
        "sight": repr(scenarios[0].sensor_model),
        "sensors": sensors,
        "map_says": map_says,
        "options": asked.options,
        "calibrated": args.fingerprint(calibrated),
        "agent files": args.agent_fingerprints(case.agent for case, _ in cases),
    }
    out = out or Path("results/compare")
    for s in scenarios:
        check_worlds(s, range(seed, seed + episodes))
    console = make_console()
    with args.workers_of(jobs, backend, address) as workers:
        folder = ResultFolder(out, settings, resume=resume, overwrite=overwrite)
        remove_figures(out)
        interrupted = run_with_bar(console, cases + sweep, folder, workers)

    rows, sweep_rows = table(cases, folder), table(sweep, folder)
    summary = {
        "command": ["parkenv", *sys.argv[1:]],
        "version": __version__,
        "seed": seed,
        "complete": not interrupted,
        "rows": rows,
        "occupancy_rows": sweep_rows,
        "calibrated": None if measured is None else dataclasses.asdict(measured),
    }
    order = [case.key(s) for case, its_seeds in cases + sweep for s in its_seeds]
    folder.finish(order, summary, complete=not interrupted)
    # A sweep is to be looked at: it would print two tables for every cost.
    for printed in [] if sweeps else result_tables(rows, console.width):
        console.print(printed)
    if measured is not None:
        console.print(
            f"Calibrated over {measured.trips} trips: failure cost {measured.failure_s:.4g} s, drive "
            f"{measured.v_drive / KMH:.4g} km/h. Whoever parks needs {measured.manoeuvre_s:.1f} s more to get into the "
            "slot, under either cost; the tables leave that out."
        )
    if interrupted:
        console.print(f"Interrupted. What was finished is in {out}; the same command with --resume goes on.")
        raise typer.Exit(130)
    if figures:
        with console.status("Drawing figures"):
            flat = {name: (name.partition(MAP_SAYS)[0], said) for name, (_, said) in maps.items()}
            draw_figures(ComparisonResults(cases, folder.episodes, rows, sweep_rows, flat, seed), out)
    console.print(f"Episodes, summary and figures are in {out}")
    if rerun is not None:
        with console.status(f"Searching the first search once more for {rerun}"):
            _record(*cases[0], rerun)
        console.print(f"Recorded: {rerun}; look at it with: rerun {rerun}")
    if report:
        from parkenv.cli.report import make_report

        make_report(out, jobs=jobs)


def _record(case: Case, seeds: range, path: Path) -> None:
    """The first search of a case, through its sensors."""
    from parkenv.envs.perception import SearchPerceptionEnv
    from parkenv.evaluation.trips.sensor_log import record_search, sensor_log
    from planners.agent import make_agent

    env = SearchPerceptionEnv(case.scenario, rig=str(case.rig))
    with sensor_log(path, case.scenario.lot, env.rig) as log:
        record_search(env, make_agent(case.agent, env.scenario, **case.options), seeds[0], log)


@dataclasses.dataclass(frozen=True)
class Comparison:
    """What a comparison is to run.

    Attributes:
        cases: each with its seeds.
        sweep: the same of lots made fuller and emptier.
        scenarios: all that there are.
        maps: scenarios whose maps are wrong on purpose, and what these say, by name.
        measured: the calibration; None where none is given.
        options: of the agents, by name.
    """

    cases: list[tuple[Case, range]]
    sweep: list[tuple[Case, range]]
    scenarios: list[Scenario]
    maps: dict[str, tuple[Scenario, float]]
    measured: Calibration | None
    options: dict[str, dict[str, Any]]


def comparison_of(
    *,
    scenario: str | None,
    lot: str | None,
    occupancy: Path | None,
    mapping: Path | None,
    goal: str | None,
    arrival: str | None,
    days: str | None,
    view_range: float | None,
    sight: str | None,
    sensors: str | None,
    agents: str,
    episodes: int,
    failure_cost: str,
    v_walk_kmh: str,
    v_drive_kmh: str,
    calibrated: Path | None,
    occupancy_levels: str,
    map_says: str | None,
    solver: str,
    budget_ms: float | None,
    seed: int,
) -> Comparison:
    """What the options of `parkenv compare` ask for.

    Raises:
        InputError: options that cannot be used, by name.
    """
    from parkenv.evaluation.experiments.compare import UNSEEN, Case, at_occupancy, settings_of, unseen
    from parkenv.world.occupancy import OccupancyProcess
    from parkenv.world.scenario import KMH
    from planners.agent import make_agent

    names = args.words("--agents", agents)
    sweeps = failure_cost == SWEEP
    failure = list(args.SWEEP) if sweeps else args.costs("--failure-cost", failure_cost)
    walk = args.speeds("--v-walk-kmh", v_walk_kmh)
    drive = args.speeds("--v-drive-kmh", v_drive_kmh)
    levels = [] if sweeps or occupancy_levels == "none" else _levels(occupancy_levels)
    rig = args.rig_of(sensors)
    sight = sight or ("perfect" if rig is None else "stereo" if rig == "stereo" else "laser")
    scenarios = [
        build(spec)
        for spec in args.scenario_specs(
            scenario, lot=lot, occupancy=occupancy, mapping=mapping, goal=goal, arrival=arrival, days=days,
            sensor_model=sight, view_range=view_range,
        )
    ]  # fmt: skip
    options: dict[str, dict[str, Any]] = {
        "mdp": {"solver": solver}, "mdp-static": {"solver": solver},
        "belief": {} if budget_ms is None else {"budget_ms": budget_ms},
    }  # fmt: skip
    for s in scenarios:
        for name in names:
            make_agent(name, s, **options.get(name, {}))
    if sweeps and not set(names) - set(ON_SIGHT):
        raise InputError(
            f"--failure-cost sweep draws searches without sight, too, and {', '.join(names)} goes by sight; add an "
            "agent that does not, such as mdp"
        )
    maps = _maps(map_says, scenarios)
    scenarios += [flat for flat, _ in maps.values()]
    if sweeps:
        scenarios = [s for its in scenarios for s in (its, unseen(its))]

    measured = None if calibrated is None else _calibration(calibrated, scenarios)

    seeds = range(seed, seed + episodes)
    cases = [
        (Case(setting, name, rig=rig, options=options.get(name, {})), seeds)
        for s in scenarios
        for setting in settings_of(s, failure, walk, drive)
        + (
            settings_of(measured.applied(s), [measured.failure_s], walk, [measured.v_drive / KMH])
            if measured
            else []
        )
        for name in names
        if not (s.name.endswith(UNSEEN) and name in ON_SIGHT)
    ]
    fewer = seeds[: max(1, episodes // 3)]
    sweep = [
        (Case(setting, name, level, rig, options.get(name, {})), fewer)
        for s in scenarios
        if isinstance(s.occupancy, OccupancyProcess) and s.name not in maps
        for level in levels
        for setting in settings_of(at_occupancy(s, level), failure, walk[:1], drive[:1])
        for name in names
    ]
    return Comparison(cases, sweep, scenarios, maps, measured, options)


def _maps(text: str | None, scenarios: list[Any]) -> dict[str, tuple[Any, float]]:
    """Scenarios with flat maps and what these say, by name."""
    from parkenv.world.flat_map import FlatMap

    made = {}
    for said in [] if text is None else sorted(args.numbers("--map-says", text)):
        if not 0.0 <= said <= 1.0:
            raise InputError(f"--map-says has {said:g}, want probabilities from 0 to 1")
        for s in scenarios:
            name = f"{s.name}{MAP_SAYS}{said:g}"
            made[name] = (s.replace(name=name, prior=FlatMap(said, s.prior or s.occupancy)), said)
    return made


def _calibration(path: Path, scenarios: list[Any]) -> Any:
    from parkenv.evaluation.trips.calibration import Calibration

    measured = Calibration.from_file(path)
    names = [s.name for s in scenarios]
    if names != [measured.scenario]:
        raise InputError(
            f"--calibrated {path} was measured on {measured.scenario!r}, here are {', '.join(names)}; compare that "
            "scenario alone, and without --failure-cost sweep"
        )
    return measured


def _levels(text: str) -> list[float]:
    levels = args.numbers("--occupancy-levels", text)
    for level in levels:
        if not 0.0 < level < 1.0:
            raise InputError(f"--occupancy-levels has {level:g}, want fractions between 0 and 1, or none")
    return sorted(levels)


def run_with_bar(console: Console, cases: list[Any], folder: Any, workers: Any) -> bool:
    """Run with a progress bar; whether Ctrl-C ended it."""
    from parkenv.evaluation.experiments.compare import run_cases

    progress = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("searches"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
    )
    with progress:
        bar = progress.add_task("Searching", total=sum(len(seeds) for _, seeds in cases))
        try:
            run_cases(cases, folder, workers=workers, on_progress=lambda n: progress.advance(bar, n))
        except KeyboardInterrupt:
            return True
    return False


Column = tuple[str, Callable[[Row], str]]

_DETAILS: tuple[Column, ...] = (
    ("drive", lambda r: _seconds(r["drive_s"])),
    ("failed", lambda r: _seconds(r["failed_s"])),
    ("walk", lambda r: _seconds(r["walk_s"])),
    ("gave up", lambda r: _seconds(r["gave_up_s"])),
    ("parked", lambda r: f"{r['parked_fraction']:.0%}"),
    ("re-plans", lambda r: f"{r['replans']:.1f}"),
    ("ms/decision", lambda r: f"{r['decision_ms']:.2f}" if "decision_ms" in r else ""),
    ("p99", lambda r: f"{r['decision_ms_p99']:.2f}" if "decision_ms" in r else ""),
)


def result_tables(rows: list[Row], width: int) -> list[Table]:
    """The results of each setting, in one table or in two where the terminal is narrow."""
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
        for columns in [results + _DETAILS] if width >= WIDE else [results, _DETAILS]:
            headings = ("agent", *(heading for heading, _ in columns))
            table = make_table(title if columns is not _DETAILS else None, headings)
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
