"""`parkenv bench`: benchmark each part against peers."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from parkenv import __version__
from parkenv.cli.tables import make_console, make_table
from parkenv.errors import InputError

if TYPE_CHECKING:
    from parkenv.evaluation.bench.rows import BenchRow


def _sensors(seed: int, seconds: float) -> list[BenchRow]:
    from parkenv.evaluation.bench.sensors import sensor_rows

    return sensor_rows(seed, seconds)


def _perception(seed: int, seconds: float) -> list[BenchRow]:
    from parkenv.evaluation.bench.perception import perception_rows

    return perception_rows(seed, seconds)


def _planning(seed: int, seconds: float) -> list[BenchRow]:
    from parkenv.evaluation.bench.planning import planning_rows

    return planning_rows(seed, seconds)


def _drive(seed: int, seconds: float) -> list[BenchRow]:
    from parkenv.evaluation.bench.drive import drive_rows

    return drive_rows(seed, seconds)


def _env(seed: int, seconds: float) -> list[BenchRow]:
    from parkenv.evaluation.bench.env import env_rows

    return env_rows(seed, seconds)


PARTS: dict[str, Callable[[int, float], list[BenchRow]]] = {
    "sensors": _sensors,
    "perception": _perception,
    "planning": _planning,
    "env": _env,
    "drive": _drive,
}


def bench(
    parts: Annotated[
        list[str] | None, typer.Argument(help=f"Some of {', '.join(PARTS)}; all where none is named.")
    ] = None,
    seconds: Annotated[
        float, typer.Option("--seconds", min=0.01, help="How long each figure is measured.")
    ] = 0.6,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the lots and the noise.")] = 0,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for summary.json.")] = None,
) -> None:
    """Measure throughput, and that of other software for the same task, in the same run.

    A ratio above 1 means that ours is faster. Timings are noisy: compare ratios, and use an idle machine.
    After an installation, each part first compiles its functions, which takes about 20 s; the result is cached.

    Examples:
    * `parkenv bench sensors`

    * `parkenv bench --seconds 2 --out results/bench`
    """
    from parkenv.evaluation.experiments.results import make_folder, write_summary

    chosen = parts or list(PARTS)
    for part in chosen:
        if part not in PARTS:
            raise InputError(f"there is no part {part!r} to measure, want some of {', '.join(PARTS)}")
    if out is not None:
        make_folder(out)
    console = make_console()
    console.print("After an installation each part first compiles what it measures, about 20 s.")
    rows: list[BenchRow] = []
    for part in chosen:
        with console.status(f"Measuring {part}"):
            rows += PARTS[part](seed, seconds)
    table = make_table(None, ["part", "case", "value", "unit", "peer", "peer's", "ratio"])
    before = None
    for row in rows:
        ours = [row["part"], row["case"], _figure(row["value"]), row["unit"]]
        theirs = [row["peer"] or "", _figure(row["peer_value"]), _figure(row["ratio"])]
        table.add_row(*(ours if ours != before else [""] * len(ours)), *theirs)
        before = ours
    console.print(table)
    if out is not None:
        summary = {"command": ["parkenv", *sys.argv[1:]], "version": __version__, "seed": seed, "rows": rows}
        write_summary(out, summary)
        console.print(f"Written: {out / 'summary.json'}")


def _figure(value: float | None) -> str:
    """Format a number with three significant digits and thousands separators."""
    if value is None:
        return ""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
