"""`parkenv report`: the results of a command on one page, with replays of its searches and drives."""

from __future__ import annotations

from pathlib import Path

from parkenv.cli.options import Command
from parkenv.cli.tables import make_console, stages
from parkenv.cli.trust import Trust, require_trust
from parkenv.errors import InputError
from parkenv.files.option import option
from parkenv.studies.report_options import ReportOptions
from parkenv.studies.study import ExecutionSpec


class Report(Command, ExecutionSpec, ReportOptions):
    """The page needs no network and no other file. Searches and drives are repeated with their seeds.

    If the total time of a search differs from that in the results, the page says so.
    """

    examples = """
        parkenv report results/compare
        parkenv report results/compare --replay 3,17 --agents mdp --out two.html
        parkenv report results/survey --sessions 2
        """

    folder: Path = option(
        ...,
        "Folder of compare, survey, demo, train, fleet or another command.",
        name="RUN",
        takes="DIR",
        argument=True,
    )
    out: Path | None = option(None, "The page.", short="-o", takes="FILE.html", default="DIR/report.html")
    trust: Trust = False

    def run(self) -> None:
        make_report(self.folder, self, self, out=self.out, trust=self.trust)


def make_report(
    folder: Path,
    machines: ExecutionSpec,
    options: ReportOptions | None = None,
    *,
    out: Path | None = None,
    stage: str = "Running again",
    trust: bool = True,
) -> Path:
    """Write the page on a run with a progress bar, and return its path.

    Args:
        folder: the run.
        machines: where searches run again.
        options: what to replay.
        out: the page; None for `report.html` in the folder.
        stage: what the progress bar says.
        trust: run the classes that the run names, without asking.
    """
    from parkenv.studies.report import RunFolder, write_report

    run = RunFolder.read(folder)
    notes: list[str] = []
    spec = None
    try:
        spec = run.spec()
    except (InputError, OSError) as error:
        notes.append(f"There is no replay: {error}")
    if spec is not None:
        # The page is made on the machines of this command, not of the run.
        require_trust(spec.changed(address=None), folder, trust)
    console = make_console()
    with machines.workers() as workers, stages(console) as progress:
        path, notes = write_report(
            run, spec, options, out=out, notes=notes, workers=workers, progress=progress, doing=stage
        )
    for note in notes:
        console.print(f"Note: {note}")
    console.print(f"Written: {path}, {path.stat().st_size / 1e6:.1f} MB")
    return path
