"""The command `parkenv policy`."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from parkenv.cli.study_command import StudyCommand
from parkenv.cli.tables import print_rows
from parkenv.files.option import option
from parkenv.show.report.tables import OF_POLICIES
from parkenv.studies.fleet.tables import ONE_DAY
from parkenv.studies.policy.study import PolicyStudy
from parkenv.studies.results import without_nan
from parkenv.studies.runner import Result

ANSWER = (
    "policy", "arrivals_per_hour", "in_band", "in_band_daily", "cruised_km", "cruised_km_of_today", "time_s", "revenue",
    "revenue_of_today", "balked_fraction",
)  # fmt: skip
LOSERS = ("scenario", "purpose", "change_s", "better_off", "worse_off", "paid_change")


class Policy(StudyCommand):
    """A file gives the aims, the levers (what may change), and the budget (how many days may be simulated).

    The command simulates the town as it is today, with SFpark's rule, with prices that follow the occupancy, and with
    the proposals of an evolution strategy, all on the same days. It evaluates the best policy, today's and SFpark's
    rule on new days and other demands: the aims reached, the costs by group of drivers, and their uncertainty.
    today.json, SFpark.json and ours.json are scenarios for `parkenv fleet`.
    """

    examples = """
        parkenv policy council.toml --out results/policy --report
        parkenv policy --scenario town --arrivals-per-hour 1.3x --budget 200
        parkenv policy --resume --out results/policy
        """

    study: PolicyStudy = PolicyStudy()
    spec: Path | None = option(
        None, "File with aims, levers and budget (.toml, .json).", takes="FILE", argument=True
    )
    out: Path = option(
        Path("results/policy"),
        "Folder for summary.json, the policies as scenarios, trials.jsonl, and the files of "
        "`parkenv fleet` for the held-out days.",
        short="-o",
    )

    def asked_study(self) -> PolicyStudy:
        """See `StudyCommand`."""
        return self.study if self.spec is None else PolicyStudy.read(self.spec)

    def show(self, console: Console, result: Result) -> None:
        """Print what was found."""
        from parkenv.studies.policy.answer import middle_only

        summary = without_nan(result.summary)
        if not summary.get("answer"):
            return
        print_rows(console, "The answer, on held-out days", summary["answer"], ANSWER, OF_POLICIES)
        print_rows(console, "Gains and losses against today", middle_only(summary), LOSERS, OF_POLICIES)
        for line in PolicyStudy.findings(summary):
            console.print(line, soft_wrap=True)
        if self.study.episodes == 1:
            console.print(ONE_DAY, soft_wrap=True)
