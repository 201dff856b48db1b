"""`parkenv compare`: compare agents in the same worlds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli import arguments as args
from parkenv.cli.command import options_of
from parkenv.cli.study_run import run_study
from parkenv.cli.tables import (
    WIDE,
    make_console,
    make_table,
    print_recorded,
)
from parkenv.errors import InputError
from parkenv.show.plurals import plural
from parkenv.studies.results import Row
from parkenv.world.cost_terms import COST_TERMS

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from parkenv.studies.compare.cases import Case
    from parkenv.studies.compare.comparison import Comparison
    from parkenv.studies.runner import Result

LEVELS = (0.5, 0.7, 0.8, 0.9, 0.95, 0.99)
"""Default occupancy levels of a comparison."""
MOST_TABLES = 12
"""Maximum number of settings to print; see the figures and files for larger grids."""


@options_of("parkenv.studies.compare.comparison:Comparison", "--cars", "--pedestrians")
def compare(
    given: dict[str, Any],
    /,
    out: Path = Path("results/compare"),
    *,
    largest: int | None = None,
    rerun: Path | None = None,
    trust: bool = False,
    trust_model: bool = False,
    folder: args.ReportedRun,
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
        out, -o (DIR): Folder for experiment.json, episodes.csv, summary.json and the figures.

    World:
        largest (N >= 1): Of the scenarios, only those with the N largest lots.  [default: all]
    """
    from parkenv.cli.spec_options import given_spec
    from parkenv.scenarios.build import largest_lots
    from parkenv.studies.compare.comparison import FAILURE_COST_SWEEP, Comparison

    sweep = given.get("--failure-cost") == "sweep"
    first = Comparison().changed(grid={"occupancy_levels": () if sweep else LEVELS})
    base, spec = given_spec(first, given, out, folder.resume, trust, trust_model)
    if sweep or base.grid.failure_s == FAILURE_COST_SWEEP != spec.grid.failure_s:
        spec = spec.changed(grid=spec.grid.changed(blind=sweep))
    if largest is not None:
        spec = spec.changed(scenarios=tuple(largest_lots(spec.scenarios, largest)))
    run_comparison(spec, out, folder, rerun)


def run_comparison(study: Comparison, out: Path, folder: args.ReportedRun, rerun: Path | None = None) -> None:
    """Run a comparison, print its tables, and record its first episode on request.

    Raises:
        InputError: the comparison cannot be run, or the folder cannot be used.
        KeyboardInterrupt: the run was interrupted; the results of finished episodes are printed and in the folder.
    """
    if rerun is not None:
        from parkenv.studies.trips.sensor_log import require_viewer

        if study.rig is None:
            raise InputError("--rerun records what sensors measure: add --rig laser")
        require_viewer()
    run_study(study, out, folder, show)
    if rerun is not None:
        console = make_console()
        with console.status(f"Running the first episode once more for {rerun}"):
            _record(*study.cases[0], rerun)
        print_recorded(console, rerun)


def show(console: Console, result: Result) -> None:
    """Print the tables of a comparison."""
    from parkenv.world.scenario import KMH

    count = setting_count(result.rows)
    for printed in result_tables(result.rows, console.width) if count <= MOST_TABLES else []:
        console.print(printed)
    if count > MOST_TABLES:
        console.print(f"{count} settings: their tables are in summary.json")
    if (measured := result.summary.get("calibrated")) is not None:
        console.print(
            f"Calibrated over {plural(measured['trips'], 'trip')}: failure cost {measured['failure_s']:.4g} s, drive "
            f"{measured['v_drive'] / KMH:.4g} km/h. Parking takes {measured['manoeuvre_s']:.1f} s more for the "
            "manoeuvre into the slot, under either cost; the tables leave that out."
        )


def setting_count(rows: list[Row]) -> int:
    """Return the number of different scenarios and settings in rows."""
    return len({(r["scenario"], r["failure_cost_s"], r["v_walk_kmh"], r["v_drive_kmh"]) for r in rows})


def _record(case: Case, seeds: Sequence[int], path: Path) -> None:
    """Record the first episode of a case with its sensors."""
    from parkenv.envs.perception import SearchPerceptionEnv
    from parkenv.studies.trips.sensor_log import record_search, sensor_log
    from planners.agent import make_agent

    env = SearchPerceptionEnv(case.scenario, rig=str(case.rig), detector=case.detector)
    with sensor_log(path, case.scenario.lot, env.rig) as log:
        record_search(env, make_agent(case.agent, env.scenario, **case.options), seeds[0], log)


Column = tuple[str, Callable[[Row], str]]

_DETAILS: tuple[Column, ...] = (
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
        details = (*_cost_columns(its_rows), *_DETAILS)
        for columns in [results + details] if width >= WIDE else [results, details]:
            headings = ("agent", *(heading for heading, _ in columns))
            cells = ((row["agent"], *(text(row) for _, text in columns)) for row in its_rows)
            tables.append(make_table(title if columns is not details else None, headings, cells))
    return tables


def _cost_columns(rows: Sequence[Row]) -> Iterator[Column]:
    """Yield a column for each term of the costs, but for optional ones that are 0."""
    for term in COST_TERMS:
        if not term.optional or any(row[term.field] for row in rows):
            yield term.name.replace("_", " "), lambda row, field=term.field: _seconds(row[field])  # type: ignore[misc]


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
