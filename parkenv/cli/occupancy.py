"""`parkenv occupancy`: fit models to recorded occupancy, and score their forecasts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from parkenv.cli.options import Command
from parkenv.cli.tables import print_rows, save_summary, stages
from parkenv.files.atomic_write import check_writable, make_folder
from parkenv.files.option import Option, option
from parkenv.files.spec_file import Axis
from parkenv.scenarios.spec import (
    CAPACITY_HELP,
    COLUMNS_HELP,
    COLUMNS_TAKE,
    TIMEZONE_HELP,
    Capacity,
    Date,
    scenario_spec,
)
from parkenv.show.tables import Column, plural
from parkenv.studies.fields import AgentSpec, OneAgent, OneScenario, Seed
from parkenv.studies.fleet.setting import COLUMNS

if TYPE_CHECKING:
    from parkenv.studies.occupancy import FitReport

SCORE_COLUMNS = (
    Column("model", "model"),
    Column("log_loss", "log-loss", digits=4),
    Column("brier", "Brier", digits=4),
    Column("crps", "CRPS", digits=4),
    Column("coverage_90", "days within their 90 % interval", share=True),
    Column("coverage_90_hours", "hours within theirs", share=True),
    Column("difference", "log-loss more than ours", digits=4, signed=True),
)
LogFile = Annotated[Path, Option("LOG", takes="FILE", argument=True)]
TimeZone = Annotated[
    str | None, Option(takes="NAME", default="times are local"), Field(description=TIMEZONE_HELP)
]
Places = Annotated[
    Capacity | None,
    Option(takes="PLACES|FILE|largest", default="the file's", parse=str),
    Field(description=CAPACITY_HELP),
]
Columns = Annotated[
    str | None,
    Option(takes=COLUMNS_TAKE, default="found by their names", parse=str),
    Field(description=COLUMNS_HELP),
]
_LOG_HELP = (
    "A log of bays (bay with arrival and departure, since and state, or time and state) or counts (car_park, capacity, "
    "free or taken, with hour or time), .csv or .csv.gz."
)


class Fit(Command):
    """A log of slots: arrival and departure rates. Every slot is a two-state Markov chain.

    Its rates depend on the hour, separately for weekdays and weekends, and on a factor per slot. The log shows a slot
    only at single times; the likelihood covers all possible changes in between. Days differ from these rates by the day
    error, which is estimated, too. Use the result, process.json, as --occupancy of `parkenv compare`: unchanged on a
    lot with the same number of slots, on any other lot with the fullest slots nearest to the goal.

    Counts of whole car parks: how much days differ from their forecasts, faulty readings, and the week of the car park
    of median level.
    """

    examples = """
        parkenv occupancy fit CNR-EXT.csv.gz --out results/pisa
        parkenv compare --occupancy results/pisa/process.json
        parkenv occupancy fit car_parks.csv.gz --out results/car-parks
        """

    log: LogFile = Field(description=_LOG_HELP)
    max_gap_h: float = option(
        2.0, "Observations of a log that are farther apart than this, h, are independent.", takes="H", ge=0
    )
    timezone: TimeZone = None
    capacity: Places = None
    columns: Columns = None
    out: Path = option(
        Path("results/occupancy"),
        "Folder for summary.json and, for a log, process.json and rates.png.",
        short="-o",
    )

    def run(self) -> None:
        from parkenv.studies.occupancy import fit
        from parkenv.world.occupancy.log import RecordedFile

        with stages(self.console) as progress:
            make_folder(self.out)
            recorded = RecordedFile((self.log,), self.timezone, self.capacity, self.columns)
            report = fit(recorded, self.out, max_gap_s=3600.0 * self.max_gap_h, progress=progress)
        _show(self, report, self.out, None, COLUMNS)


class Evaluate(Command):
    """Models: day-curves (ours); last-four-weekdays, the mean of the hour on the last four same weekdays; last-week.

    Also hour-mean, over all earlier weekdays or weekend days; and gradient-boosting. The variances of ours are fitted
    to the days before --from. Differences of log-losses are to ours, with 95 % intervals over car parks and weeks.

    For a log of slots, every slot is forecast in each half-hour, by slot-days (ours) and the same baselines for slots.
    """

    examples = """
        parkenv occupancy evaluate car_parks.csv.gz --from 2024-01-01
        parkenv occupancy evaluate CNR-EXT.csv.gz --from 2015-12-03
        """

    log: LogFile = Field(description=_LOG_HELP)
    from_day: Date | None = option(
        None, "First scored day.", name="--from", takes="DATE", default="the middle of the file"
    )
    car_parks: Axis[str] | None = option(None, "Car parks.", takes="NAME[,...]", default="all")
    timezone: TimeZone = None
    capacity: Places = None
    columns: Columns = None
    seed: Seed = Field(0, description="Seed of the bootstrap.")
    out: Path = option(
        Path("results/forecasts"), "Folder for summary.json and a picture of each model.", short="-o"
    )

    def run(self) -> None:
        from parkenv.studies.occupancy import evaluate
        from parkenv.world.occupancy.log import RecordedFile

        with stages(self.console) as progress:
            make_folder(self.out)
            report = evaluate(
                RecordedFile((self.log,), self.timezone, self.capacity, self.columns),
                self.out,
                from_day=self.from_day,
                car_parks=self.car_parks,
                seed=self.seed,
                progress=progress,
            )
        _show(self, report, self.out, self.seed, SCORE_COLUMNS, [column.key for column in SCORE_COLUMNS])


class Record(Command):
    """The log holds the states of slots on simulated days of a town with a demand: the other cars of a single search.

    Name the log in the scenario's table `occupancy`, as `log`, with `mapping = "same"`; then `parkenv compare` and
    environments replay its days. A garage is taken while it is full.
    """

    examples = """
        parkenv occupancy record --scenario town.toml --out days.csv.gz
        """

    scenario: OneScenario = scenario_spec("town")
    agent: OneAgent = AgentSpec(name="usual")
    days: int = option(6, "Days.", name="--episodes", short="-n", ge=2, le=1_000)
    rounds: int = option(
        4,
        "Number of simulation rounds: from the second, drivers expect the occupancy of the round before.",
        ge=1,
        le=100,
    )
    seed: Seed = Field(0, description="Seed of the days.")
    out: Path = option(..., "The log, .csv or .csv.gz.", short="-o", takes="FILE")

    def run(self) -> None:
        from parkenv.studies.fleet.drivers import record_days

        check_writable(self.out)
        with stages(self.console) as progress:
            lines = record_days(
                self.scenario, self.out, agent=self.agent, days=self.days, rounds=self.rounds, seed=self.seed,
                progress=progress,
            )  # fmt: skip
        self.say(f"{self.out}: {lines:,} observations of {plural(self.days, 'day')}", soft_wrap=True)


def _show(
    command: Command,
    report: FitReport,
    out: Path,
    seed: int | None,
    columns: Sequence[Column],
    keys: Sequence[str] = (),
) -> None:
    print_rows(command.console, report.title, report.summary["rows"], keys, columns)
    command.say(*report.notes, soft_wrap=True)
    save_summary(out, seed, **report.summary)
    command.say(f"Summary and pictures are in {out}")
