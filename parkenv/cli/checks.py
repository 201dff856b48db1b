"""`parkenv bench` and `parkenv schema`: the package against other software, and schemas of files."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import Field
from typer import echo

from parkenv.cli.options import Command
from parkenv.cli.tables import make_console, make_table, save_summary
from parkenv.errors import InputError, nearest
from parkenv.files.option import numbers_in, option
from parkenv.files.spec_file import Several
from parkenv.studies.compare.comparison import Milliseconds
from parkenv.studies.fields import MAX_EPISODES, Seed
from parkenv.studies.study import STUDIES, schemas

if TYPE_CHECKING:
    from parkenv.studies.bench.rows import BenchRow


PARTS = {
    "sensors": "sensor_rows",
    "perception": "perception_rows",
    "planning": "planning_rows",
    "env": "env_rows",
    "drive": "drive_rows",
    "fleet": "fleet_rows",
    "town": "town_rows",
}
"""Modules of `parkenv.studies.bench`, and the function of each that measures."""
IN_TIME = "pomdp"
"""The part that is a comparison of planners, and takes hours."""


class Bench(Command):
    """A ratio above 1 means that parkenv is faster. Timings are noisy: compare ratios, and use an idle machine.

    The part pomdp compares planners of parkenv and pomdp-py at several times per decision in the same worlds. It is a
    comparison in the folder OUT/pomdp; running it again continues it.
    """

    examples = """
        parkenv bench sensors
        parkenv bench --seconds 2 --out results/bench
        parkenv bench pomdp --episodes 20 --budget-ms 10,100,1000
        """

    parts: Several[Literal["sensors", "perception", "planning", "env", "drive", "fleet", "town", "pomdp"]] = (
        option(
            (),
            f"Some of {', '.join(PARTS)}, {IN_TIME}.",
            takes="PART",
            argument=True,
            default=f"all but {IN_TIME}",
        )
    )
    seconds: float = option(0.6, "How long each figure is measured.", ge=0.01, le=3600)
    seed: Seed = Field(0, description="Seed of the lots and the noise.")
    lots: Several[str] = option(
        (),
        "Lots for which the part town compares a day with SUMO, besides a synthetic one.",
        name="--lot",
        takes="FILE[,...]",
    )
    episodes: int = option(
        20, "Searches of each planner in each scenario, of the part pomdp.", short="-n", ge=1, le=MAX_EPISODES
    )
    budget_ms: tuple[Milliseconds, ...] = option(
        (10.0, 100.0, 1000.0),
        "Times for a decision in the part pomdp, ms.",
        takes="MS[,...]",
        parse=numbers_in,
        min_length=1,
    )
    out: Path | None = option(
        None,
        "Folder for summary.json, and a table of each part for a page.",
        short="-o",
        default="none; results/bench for pomdp",
    )

    def run(self) -> None:
        """See `Command`."""
        from parkenv.files.atomic_write import make_folder

        chosen = [part for part in self.parts or PARTS if part != IN_TIME]
        if IN_TIME in self.parts:
            self.compare_planners()
            if not chosen:
                return
        if self.out is not None:
            make_folder(self.out)
        console = make_console()
        console.print("After an installation each part first compiles what it measures, about 20 s.")
        rows: list[BenchRow] = []
        for part in chosen:
            with console.status(f"Measuring {part}"):
                measure = getattr(import_module(f"parkenv.studies.bench.{part}"), PARTS[part])
                further = {"lots": self.lots} if part == "town" else {}
                measured = measure(self.seed, self.seconds, **further)
            rows += measured
            if self.out is not None:
                (self.out / f"{part}.md").write_text(_markdown(measured), encoding="utf-8")
        cells = []
        before = None
        for row in rows:
            ours = [row["part"], row["case"], _measured(row["value"]), row["unit"]]
            theirs = [row["peer"] or "", _measured(row["peer_value"]), _measured(row["ratio"])]
            cells.append([*(ours if ours != before else [""] * len(ours)), *theirs])
            before = ours
        console.print(make_table(None, ["part", "case", "value", "unit", "peer", "peer's", "ratio"], cells))
        if self.out is not None:
            save_summary(self.out, self.seed, rows)
            console.print(f"Written: {self.out / 'summary.json'}, and a table of each part, PART.md")

    def compare_planners(self) -> None:
        """Run the part pomdp, or go on with it."""
        from parkenv.cli.compare import Compare
        from parkenv.studies.bench.pomdp import missing_peers, planners_in_time
        from parkenv.studies.results import SPEC_FILE

        if missing := missing_peers():
            make_console().print(f"Without the planners of pomdp-py: {missing}", soft_wrap=True)
        study, out = (
            planners_in_time(self.seed, self.episodes, self.budget_ms),
            self.out or Path("results/bench"),
        )
        folder = out / IN_TIME
        begun = (folder / SPEC_FILE).exists()
        Compare.parse({"study": study, "out": folder, "resume": begun}, "").run()


def _markdown(rows: list[BenchRow]) -> str:
    """Return the rows of one part as a table for a page: a line a case, with all of its peers."""
    lines = ["| | ours | peers | ratio |", "|---|---|---|---|"]
    cases = dict.fromkeys(
        (row["case"], row["value"], row["unit"]) for row in rows if row["value"] is not None
    )
    for case, value, unit in cases:
        peers = [row for row in rows if row["case"] == case and row["unit"] == unit and row["peer"]]
        theirs = "; ".join(f"{row['peer']}: {_measured(row['peer_value'])}" for row in peers)
        ratios = "; ".join(_measured(row["ratio"]) for row in peers)
        lines.append(f"| {case} | {_measured(value)} {unit} | {theirs} | {ratios} |")
    return "\n".join(lines) + "\n"


def _measured(value: float | None) -> str:
    """Format a number with three significant digits and thousands separators."""
    if value is None:
        return ""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


KINDS = ("scenario", *STUDIES)


class Schema(Command):
    """Editors use them to check and complete files."""

    examples = """
        parkenv schema scenario
        parkenv schema --out docs/schemas
        """

    kind: str | None = option(None, f"{', '.join(KINDS)}.", argument=True, default="scenario; all with --out")
    out: Path | None = option(None, "Folder for all schemas, KIND.schema.json.", short="-o", default="none")

    def run(self) -> None:
        """See `Command`."""
        from parkenv.files.atomic_write import make_folder

        if self.kind is not None and self.kind not in KINDS:
            raise InputError(f"KIND is {self.kind!r}; {nearest(self.kind, KINDS)}")
        made = schemas()
        if self.out is None:
            echo(json.dumps(made[self.kind or "scenario"], indent=1))
            return
        make_folder(self.out)
        for name, content in made.items():
            file = self.out / f"{name}.schema.json"
            file.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
