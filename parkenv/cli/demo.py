"""`parkenv demo`: from the first survey session to the comparison of agents."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from parkenv.cli.report import make_report
from parkenv.cli.study_command import StudyCommand
from parkenv.cli.tables import make_console
from parkenv.files.option import option
from parkenv.studies.demo.study import FILM, QUICK
from parkenv.studies.demo.study import Demo as DemoStudy
from parkenv.studies.report_options import ReportOptions
from parkenv.studies.results import PAGE
from parkenv.studies.sensing.survey_study import SHOWN

if TYPE_CHECKING:
    from parkenv.studies.runner import Result

NEXT = (
    (
        "parkenv compare --scenario jam --agents mdp,belief,oracle --episodes 40 --report",
        "another lot, where the forecast is wrong; many more searches, without images",
    ),
    ("parkenv plan --scenario jam --failure-cost 10,90", "what the thesis's planner intends, in a picture"),
)
"""Commands to try after the demo, and what they do."""


class Demo(StudyCommand):
    """The demo, which also writes its report, and says what to look at."""

    quick: bool = option(
        False,
        "A shorter demo: fewer drives and episodes, captures farther apart.",
        sets={"study": DemoStudy().changed(**QUICK)},
    )
    report: bool = option(True, "Write report.html.", panel="Results")

    def run(self) -> None:
        out = self.run_study().folder
        console = make_console(soft_wrap=True)
        console.print("\nOpen")
        if self.report:
            console.print(f"  {out / PAGE}\n    the results on one page, with replays, in a browser")
        console.print(f"  {out / FILM}\n    a film of one search\n\nTry next")
        for command, explained in NEXT:
            console.print(f"  {command}\n    {explained}")

    def write_report(self, result: Result) -> Path:
        """See `StudyCommand`; the first drive is recorded already."""
        shown = result.results.kept.get(SHOWN)
        options = ReportOptions(drives=None if shown is None else [shown[1]])
        return make_report(result.folder, self.study, options, stage="Report")
