"""`parkenv bench`: benchmark each part against peers."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from parkenv.cli.options import Command
from parkenv.cli.tables import make_console, make_table, save_summary
from parkenv.files.option import option
from parkenv.files.spec_file import Several
from parkenv.studies.fields import Seed

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


class Bench(Command):
    """A ratio above 1 means that ours is faster. Timings are noisy: compare ratios, and use an idle machine."""

    examples = """
        parkenv bench sensors
        parkenv bench --seconds 2 --out results/bench
        """

    parts: Several[Literal["sensors", "perception", "planning", "env", "drive", "fleet"]] = option(
        (), f"Some of {', '.join(PARTS)}.", takes="PART", argument=True, default="all"
    )
    seconds: float = option(0.6, "How long each figure is measured.", ge=0.01, le=3600)
    seed: Seed = Field(0, description="Of the lots and the noise.")
    out: Path | None = option(
        None, "Folder for summary.json, and a table of each part for a page.", short="-o", default="none"
    )

    def run(self) -> None:
        """See `Command`."""
        from parkenv.files.atomic_write import make_folder

        chosen = self.parts or PARTS
        if self.out is not None:
            make_folder(self.out)
        console = make_console()
        console.print("After an installation each part first compiles what it measures, about 20 s.")
        rows: list[BenchRow] = []
        for part in chosen:
            with console.status(f"Measuring {part}"):
                measure = getattr(import_module(f"parkenv.studies.bench.{part}"), PARTS[part])
                measured = measure(self.seed, self.seconds)
            rows += measured
            if self.out is not None:
                (self.out / f"{part}.md").write_text(_markdown(measured), encoding="utf-8")
        cells = []
        before = None
        for row in rows:
            ours = [row["part"], row["case"], _figure(row["value"]), row["unit"]]
            theirs = [row["peer"] or "", _figure(row["peer_value"]), _figure(row["ratio"])]
            cells.append([*(ours if ours != before else [""] * len(ours)), *theirs])
            before = ours
        console.print(make_table(None, ["part", "case", "value", "unit", "peer", "peer's", "ratio"], cells))
        if self.out is not None:
            save_summary(self.out, self.seed, rows)
            console.print(f"Written: {self.out / 'summary.json'}, and a table of each part, PART.md")


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
