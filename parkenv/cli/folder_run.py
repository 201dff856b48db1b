"""Run the searches of a specification into a folder, with a progress bar."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from parkenv.cli import arguments as args
from parkenv.cli.tables import command_line, progress_bar

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import TaskID

    from parkenv.studies.spec import CommuteSpec, ExperimentSpec, FleetSpec

Result = TypeVar("Result")


def run_into(
    out: Path,
    run: Callable[..., Result],
    spec: ExperimentSpec | CommuteSpec | FleetSpec,
    folder: args.RunFolder,
    console: Console,
    *,
    doing: str,
    unit: str,
) -> Result:
    """Run a specification into a folder.

    Args:
        out: the folder.
        run: `run_experiment`, `run_commute` or `run_fleets`.
        spec: its specification.
        folder: whether an earlier run is continued or replaced.
        console: where the progress bar is shown.
        doing: what the bar says.
        unit: what it counts.

    Raises:
        InputError: the specification cannot be run, or the folder cannot be used.
    """
    with progress_bar(console, unit) as progress:
        bars: list[TaskID] = []
        return run(
            spec,
            out,
            command=command_line(),
            resume=folder.resume,
            overwrite=folder.overwrite,
            workers=args.workers_of(spec),
            on_start=lambda n: bars.append(progress.add_task(doing, total=n)),
            on_progress=lambda n: progress.advance(bars[0], n),
        )
