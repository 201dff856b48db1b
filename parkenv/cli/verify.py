"""`parkenv verify`: what theory says of parking searches, against the package."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from parkenv.cli import arguments as args
from parkenv.cli.command import options_of
from parkenv.cli.study_run import run_study
from parkenv.cli.tables import make_table

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.studies.runner import Result
    from parkenv.studies.verify.rows import Row


@options_of("parkenv.studies.verify.study:Verification")
def verify(given: dict[str, Any], /, out: Path | None = None) -> None:
    """Compare closed forms of the literature with what planners and worlds of this package do.

    A case without chance has to be found exactly. A simulated one agrees if theory is in the 99.99 % interval of the
    mean: right rows then all agree with a probability of 0.995 and more. The exit code is 1 if any row disagrees.

    Examples:
        parkenv verify --out results/verify
        parkenv verify --cases line,inspections --seed 7

    Options:
        out, -o (DIR): Folder for summary.json and verify.png.  [default: none]
    """
    from parkenv.cli.spec_options import changed_by
    from parkenv.studies.verify.rows import disagreeing
    from parkenv.studies.verify.study import Verification

    study = changed_by(Verification(), given)
    result = run_study(study, out, args.ReportedRun(), show)
    if disagreeing(study.statements(result.results)):
        raise typer.Exit(1)


def show(console: Console, result: Result) -> None:
    """Print what theory expects and what is found."""
    from parkenv.show.plurals import plural
    from parkenv.studies.verify.rows import CONFIDENCE, disagreeing

    study: Any = result.study
    rows = study.statements(result.results)
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
    agree = len(rows) - len(disagreeing(rows))
    console.print(f"{agree} of {plural(len(rows), 'row')} agree with theory.")


def _interval(row: Row) -> str:
    return "exact" if row.exact else " to ".join(map(_figure, row.interval))


def _figure(value: float) -> str:
    return f"{value:.0f}" if float(value).is_integer() else f"{value:.4g}"
