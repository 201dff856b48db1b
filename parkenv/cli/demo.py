"""`parkenv demo`: from the first survey session to the comparison of agents."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from parkenv.cli.compare import SHOWN as OF_SEARCHES
from parkenv.cli.report import make_report
from parkenv.cli.study_command import StudyCommand
from parkenv.cli.tables import make_console, print_rows
from parkenv.files.option import option
from parkenv.studies.demo.study import FILM, QUICK
from parkenv.studies.demo.study import Demo as DemoStudy
from parkenv.studies.report_options import ReportOptions
from parkenv.studies.results import PAGE
from parkenv.studies.sensing.survey_study import SHOWN, SurveyStudy

if TYPE_CHECKING:
    from rich.console import Console

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
    """1. Survey: a car with a side camera and a laser passes every slot; parked cars are detected, located and mapped.

    2. Map: the probability that each slot is taken at the hour of the search, from these sessions only.

    3. Searches on other days, with camera, laser and detector: the thesis's planner, the planner in belief space and
    two heuristic baselines, all with the same map, in the same worlds; and an oracle that knows every slot's future.
    Many more searches follow without images, with the error rates of the sensors: enough to separate the agents.

    4. A report with replays, and a film of one search.
    """

    examples = """
        parkenv demo
        parkenv demo --quick --out results/quick
        """

    quick: bool = option(
        False,
        "A shorter demo: fewer drives and episodes, captures farther apart.",
        sets={"study": DemoStudy().changed(**QUICK)},
    )
    study: DemoStudy = DemoStudy()
    report: bool = option(True, "Write report.html.", panel="Results")
    out: Path = option(Path("results/demo"), "Folder for everything.", short="-o")

    def run(self) -> None:
        """See `Command`; also write the report, and say what to look at."""
        self.run_study()
        console = make_console(soft_wrap=True)
        console.print("\nOpen")
        if self.report:
            console.print(f"  {self.out / PAGE}\n    the results on one page, with replays, in a browser")
        console.print(f"  {self.out / FILM}\n    a film of one search\n\nTry next")
        for command, explained in NEXT:
            console.print(f"  {command}\n    {explained}")

    def write_report(self, result: Result) -> Path:
        """See `StudyCommand`; the first drive is recorded already."""
        shown = result.results.kept.get(SHOWN)
        options = ReportOptions(drives=None if shown is None else [shown[1]])
        return make_report(self.out, self.study, options, stage="Report")

    def show(self, console: Console, result: Result) -> None:
        """Print the errors of the survey, and the table of the searches."""
        if (surveyed := result.summary["survey"]) is not None:
            (found,) = SurveyStudy.findings({"rows": [surveyed]})
            console.print(
                f"{found} Mean absolute error of the map: {surveyed['occupancy_mae']:.2f} "
                f"(raw counts for that hour: {surveyed['occupancy_mae_expected']:.2f})."
            )
        print_rows(console, "Searches", result.rows, OF_SEARCHES)
