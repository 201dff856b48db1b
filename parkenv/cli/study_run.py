"""Run a study into a folder, with progress bars, and print its result."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from parkenv.cli import arguments as args
from parkenv.cli.report import make_report
from parkenv.cli.tables import command_line, make_console, stages

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.studies.runner import Result
    from parkenv.studies.study import Study


def run_study(
    study: Study, out: Path | None, folder: args.ReportedRun, show: Callable[[Console, Result], None]
) -> Result:
    """Run a study into a folder, print its result, and write its report on request.

    Args:
        study: the study.
        out: the folder; None to keep nothing.
        folder: whether an earlier run is continued or replaced, and whether there is a report.
        show: prints the result; that of an interrupted run, too.

    Raises:
        InputError: the study cannot be run, or the folder cannot be used.
        KeyboardInterrupt: the run was interrupted; what is finished is printed and in the folder.
    """
    from parkenv.studies.runner import Interrupted, run

    console = make_console()
    try:
        with stages(console, study.unit) as progress:
            result = run(
                study, out, resume=folder.resume, overwrite=folder.overwrite, progress=progress,
                command=command_line(),
            )  # fmt: skip
    except KeyboardInterrupt as stopped:
        if isinstance(stopped, Interrupted):
            show(console, stopped.result)
        kept = "" if out is None else f" What was finished is in {out}; parkenv run {out} --resume goes on."
        console.print(f"Interrupted.{kept}", soft_wrap=True)
        raise
    show(console, result)
    if out is not None:
        console.print(f"Results are in {out}")
    if out is not None and folder.report:
        make_report(out, study)
    return result
