"""`parkenv bench`: benchmark each part against peers."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from parkenv.cli.tables import make_console, make_table, save_summary
from parkenv.errors import InputError, nearest

if TYPE_CHECKING:
    from parkenv.studies.bench.rows import BenchRow

PARTS = {
    "sensors": "sensor_rows",
    "perception": "perception_rows",
    "planning": "planning_rows",
    "env": "env_rows",
    "drive": "drive_rows",
    "fleet": "fleet_rows",
}
"""Modules of `parkenv.studies.bench`, and the function of each that measures."""


def bench(
    parts: list[str] | None = None,
    /,
    seconds: float = 0.6,
    seed: int = 0,
    out: Path | None = None,
) -> None:
    """Measure throughput, and that of other software for the same task, in the same run.

    A ratio above 1 means that ours is faster. Timings are noisy: compare ratios, and use an idle machine.

    Examples:
        parkenv bench sensors
        parkenv bench --seconds 2 --out results/bench

    Options:
        parts (PART): Some of sensors, perception, planning, env, drive, fleet.  [default: all]
        seconds (0.01 <= X <= 3600): How long each figure is measured.
        seed (N >= 0): Of the lots and the noise.
        out, -o (DIR): Folder for summary.json, and a table of each part for a page.  [default: none]
    """
    from parkenv.files.atomic_write import make_folder

    chosen = parts or list(PARTS)
    for part in chosen:
        if part not in PARTS:
            raise InputError(f"there is no part {part!r} to measure; {nearest(part, PARTS)}")
    if out is not None:
        make_folder(out)
    console = make_console()
    console.print("After an installation each part first compiles what it measures, about 20 s.")
    rows: list[BenchRow] = []
    for part in chosen:
        with console.status(f"Measuring {part}"):
            measure = getattr(import_module(f"parkenv.studies.bench.{part}"), PARTS[part])
            measured = measure(seed, seconds)
        rows += measured
        if out is not None:
            (out / f"{part}.md").write_text(_markdown(measured), encoding="utf-8")
    cells = []
    before = None
    for row in rows:
        ours = [row["part"], row["case"], _figure(row["value"]), row["unit"]]
        theirs = [row["peer"] or "", _figure(row["peer_value"]), _figure(row["ratio"])]
        cells.append([*(ours if ours != before else [""] * len(ours)), *theirs])
        before = ours
    console.print(make_table(None, ["part", "case", "value", "unit", "peer", "peer's", "ratio"], cells))
    if out is not None:
        save_summary(out, seed, rows)
        console.print(f"Written: {out / 'summary.json'}, and a table of each part, PART.md")


def _markdown(rows: list[BenchRow]) -> str:
    """Return the rows of one part as a table for a page: a line a case, with all of its peers."""
    lines = ["| | ours | peers | ratio |", "|---|---|---|---|"]
    cases = dict.fromkeys(
        (row["case"], row["value"], row["unit"]) for row in rows if row["value"] is not None
    )
    for case, value, unit in cases:
        peers = [row for row in rows if row["case"] == case and row["unit"] == unit and row["peer"]]
        theirs = "; ".join(f"{row['peer']}: {_figure(row['peer_value'])}" for row in peers)
        ratios = "; ".join(_figure(row["ratio"]) for row in peers)
        lines.append(f"| {case} | {_figure(value)} {unit} | {theirs} | {ratios} |")
    return "\n".join(lines) + "\n"


def _figure(value: float | None) -> str:
    """Format a number with three significant digits and thousands separators."""
    if value is None:
        return ""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
