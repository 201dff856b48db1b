"""`parkenv verify`: what theory says of parking searches, against the package."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from parkenv.cli.study_command import StudyCommand
from parkenv.cli.tables import make_table
from parkenv.files.option import option
from parkenv.studies.verify.study import Verification

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.studies.runner import Result
    from parkenv.studies.verify.rows import Row


class Verify(StudyCommand):
    """A case without chance has to be found exactly. A simulated one agrees if theory is in an interval of the mean.

    It is the 99.99 % interval: right rows then all agree with a probability of 0.995 and more. The exit code is 1 if
    any row disagrees.
    """

    examples = """
        parkenv verify --out results/verify
        parkenv verify --cases line,inspections --seed 7
        """

    study: Verification = Verification()
    out: Path | None = option(None, "Folder for summary.json and verify.png.", short="-o", default="none")

    def run(self) -> None:
        """See `Command`."""
        from parkenv.studies.verify.rows import disagreeing

        if disagreeing(self.study.statements(self.run_study().results)):
            raise typer.Exit(1)

    def show(self, console: Console, result: Result) -> None:
        """Print what theory expects and what is found."""
        from parkenv.show.plurals import plural
        from parkenv.studies.verify.rows import CONFIDENCE, disagreeing

        rows = self.study.statements(result.results)
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
        console.print(
            make_table(None, ("case", "expected", "found", f"{CONFIDENCE:.2%} interval", ""), cells)
        )
        agree = len(rows) - len(disagreeing(rows))
        console.print(f"{agree} of {plural(len(rows), 'row')} agree with theory.")


def _interval(row: Row) -> str:
    return "exact" if row.exact else " to ".join(map(_figure, row.interval))


def _figure(value: float) -> str:
    return f"{value:.0f}" if float(value).is_integer() else f"{value:.4g}"
