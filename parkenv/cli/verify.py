"""`parkenv verify`: what theory says of parking searches, against the package."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from parkenv.cli import arguments as args
from parkenv.cli.tables import make_console, make_table, progress_bar, save_summary
from parkenv.files.known_names import VERIFY_CASES

if TYPE_CHECKING:
    from parkenv.studies.verify.rows import Row


def verify(
    cases: str | None = None,
    seed: int = 0,
    out: Path | None = None,
    *,
    machines: args.Machines,
) -> None:
    """Compare closed forms of the literature with what planners and worlds of this package do.

    A case without chance has to be found exactly. A simulated one agrees if theory is in the 99.99 % interval of the
    mean: right rows then all agree with a probability of 0.995 and more. The exit code is 1 if any row disagrees.

    Examples:
        parkenv verify --out results/verify
        parkenv verify --cases line,looks --seed 7

    Options:
        cases (NAME[,...]): Some of {cases}.  [default: all]
        seed (N >= 0): First seed of the simulated cases.
        out, -o (DIR): Folder for summary.json and verify.png.  [default: none]
    """
    from parkenv.files.atomic_write import make_folder
    from parkenv.show.figures.verification import save_verification
    from parkenv.show.plurals import plural
    from parkenv.studies.verify.rows import CONFIDENCE, disagreeing
    from parkenv.studies.verify.verification import tasks_of
    from parkenv.studies.verify.verification import verify as rows_of

    tasks = tasks_of(VERIFY_CASES if cases is None else args.words("--cases", cases), seed)
    if out is not None:
        make_folder(out)
    console = make_console()
    rows: list[Row] = []
    with machines.workers() as workers, progress_bar(console, "tasks") as progress:
        bar = progress.add_task("Verifying", total=sum(map(len, tasks.values())))
        for _, made in rows_of(tasks, workers, lambda: progress.advance(bar)):
            rows += made
    cells = (
        (
            row.case,
            _figure(row.expected),
            _figure(row.found),
            _interval(row),
            "" if row.agrees else "DISAGREES",
        )
        for row in rows
    )
    console.print(make_table(None, ("case", "expected", "found", f"{CONFIDENCE:.2%} interval", ""), cells))
    wrong = disagreeing(rows)
    console.print(f"{len(rows) - len(wrong)} of {plural(len(rows), 'row')} agree with theory.")
    if out is not None:
        save_summary(out, seed, [row.columns() for row in rows], confidence=CONFIDENCE)
        save_verification([row.columns() for row in rows], CONFIDENCE, out / "verify.png")
        console.print(f"Picture and summary are in {out}")
    if wrong:
        raise typer.Exit(1)


def _interval(row: Row) -> str:
    return "exact" if row.exact else " to ".join(map(_figure, row.interval))


def _figure(value: float) -> str:
    return f"{value:.0f}" if float(value).is_integer() else f"{value:.4g}"
