"""`parkenv occupancy`: fit models to recorded occupancy, and score their forecasts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from parkenv.cli.options import Command
from parkenv.cli.study_command import StudyCommand
from parkenv.cli.tables import make_console, print_rows, save_summary, stages
from parkenv.files.option import Option, option
from parkenv.files.spec_file import Axis
from parkenv.scenarios.spec import Date, scenario_spec
from parkenv.show.plurals import plural
from parkenv.show.report.tables import OF_FLEETS, Column
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.fields import OneAgent, OneScenario, Seed
from parkenv.studies.fleet.demand_study import PREDICTIONS, DemandStudy
from parkenv.studies.results import Row, without_nan

if TYPE_CHECKING:
    from rich.console import Console

    from parkenv.studies.runner import Result

FAR_OFF = 0.15
"""Mean difference from the counts, share of the places, above which a car park is said not to be followed."""
SCORE_COLUMNS = (
    Column("log_loss", "log-loss", digits=4),
    Column("brier", "Brier", digits=4),
    Column("crps", "CRPS", digits=4),
    Column("coverage_90", "days within their 90 % interval", share=True),
    Column("coverage_90_hours", "hours within theirs", share=True),
    Column("difference", "log-loss more than ours", digits=4, signed=True),
)
SCORES = ("model", *(column.key for column in SCORE_COLUMNS))
DEMAND_COLUMNS = (
    Column("car_park", "car park"),
    Column("capacity", "places", digits=0),
    Column("arrivals_a_day", "cars a day", digits=0),
    Column("stay_h", "stay", "h"),
    Column("days_held_out", "days", digits=0),
    Column("counted", "counted", share=True, digits=0),
    Column("simulated", "simulated", share=True, digits=0),
    Column("fit_error", "error, fit", share=True),
    *(Column(f"{name}_error", f"error, {name.replace('_', ' ')}", share=True) for name in PREDICTIONS),
)
LogFile = Annotated[Path, Option("LOG", takes="FILE", argument=True)]
TimeZone = Annotated[str, Option(takes="NAME")]


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

    log: LogFile = Field(
        description="A log, datetime,camera,slot_id,weather,occupied, or counts, car_park,capacity,hour,free (or "
        "hour_utc, time, time_utc), as .csv or .csv.gz."
    )
    max_gap_h: float = option(
        2.0, "Observations of a log that are farther apart than this, h, are independent.", takes="H", ge=0
    )
    timezone: TimeZone = Field("Europe/Berlin", description="Local time zone of counts in UTC.")
    out: Path = option(
        Path("results/occupancy"),
        "Folder for summary.json and, for a log, process.json and rates.png.",
        short="-o",
    )

    def run(self) -> None:
        from parkenv.files.atomic_write import make_folder
        from parkenv.forecast.counts import Counts, is_counts
        from parkenv.studies.occupancy import fit_counts, fit_log

        make_folder(self.out)
        console = make_console()
        if is_counts(self.log):
            with stages(console) as progress:
                title, summary = fit_counts(Counts.read(self.log, self.timezone), progress)
            print_rows(console, title, summary["rows"], summary["rows"][0])
            _print_notes(console, summary)
            drift = summary["level_drift_per_week"]
            console.print(f"Levels drift by {drift:.2f} logits a week. The summary is in {self.out}")
        else:
            with console.status("Fitting rates"):
                title, summary = fit_log(self.log, self.out, max_gap_s=3600.0 * self.max_gap_h)
            print_rows(console, title, summary["rows"], summary["rows"][0], OF_FLEETS)
            level = summary["day_error"]["level"]
            console.print(f"Days differ from the process by a standard deviation of {level:.2f} logits")
            console.print(f"Process, picture and summary are in {self.out}")
        save_summary(self.out, None, **summary)


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

    log: LogFile = Field(
        description="Counts, car_park,capacity,hour,free (or hour_utc, time, time_utc), or a log of slots, "
        "datetime,camera,slot_id,weather,occupied, as .csv or .csv.gz."
    )
    from_day: Date | None = option(
        None, "First scored day.", name="--from", takes="DATE", default="the middle of the file"
    )
    car_parks: Axis[str] | None = option(None, "Car parks.", takes="NAME[,...]", default="all")
    timezone: TimeZone = Field("Europe/Berlin", description="Local time zone of counts in UTC.")
    seed: Seed = Field(0, description="Seed of the bootstrap.")
    out: Path = option(
        Path("results/forecasts"), "Folder for summary.json and a picture of each model.", short="-o"
    )

    def run(self) -> None:
        from parkenv.files.atomic_write import make_folder
        from parkenv.forecast.counts import Counts, is_counts
        from parkenv.studies.occupancy import evaluate_counts, evaluate_log

        make_folder(self.out)
        console = make_console()
        with stages(console) as progress:
            if of_counts := is_counts(self.log):
                counts = Counts.read(self.log, self.timezone)
                if self.car_parks is not None:
                    counts = counts.chosen(list(self.car_parks))
                title, summary = evaluate_counts(
                    counts, self.out, from_day=self.from_day, seed=self.seed, progress=progress
                )
            else:
                title, summary = evaluate_log(
                    self.log, self.out, from_day=self.from_day, seed=self.seed, progress=progress
                )
        print_rows(console, title, summary["rows"], SCORES, {column.key: column for column in SCORE_COLUMNS})
        if of_counts:
            _print_notes(console, summary)
        save_summary(self.out, self.seed, **summary)
        console.print(f"Pictures and summary are in {self.out}")


class Demand(StudyCommand):
    """The fitted demand of a town reproduces the counted occupancy of its car parks.

    Each car park gets a purpose with the same name: arrivals by hour (least squares), and cars that are parked at the
    start. Drivers choose freely, so the command simulates the town and corrects the excess or deficit of each car park,
    --rounds times. Counts do not show how often cars change; of several mean stays, the longest that can follow the
    counts is used.

    The result, scenario.json, is the scenario with this demand for weekdays; Saturdays and Sundays have separate files.
    Each held-out day is simulated with its own demand, which follows the forecast from earlier counts.
    """

    examples = """
        parkenv occupancy demand counts.csv.gz --scenario town.toml --from 2021-09-06
        parkenv fleet --scenario results/demand/scenario.json
        """

    study: DemandStudy = DemandStudy()
    out: Path = option(
        Path("results/demand"),
        "Folder for scenario.json, saturday.json, sunday.json, summary.json, predicted.csv, "
        "demand.png, and finished work: fitted.jsonl and days.jsonl.",
        short="-o",
    )

    def show(self, console: Console, result: Result) -> None:
        """Print how far the town, and simpler predictions, are from the counts of the days held out that are done."""
        if not result.rows:
            return
        summary = result.summary
        what = f"{plural(len(result.rows), 'car park')}, {plural(summary['days_held_out'], 'day')} held out"
        rows = without_nan([*result.rows, {**summary, "car_park": "all"}])
        columns = {column.key: column for column in DEMAND_COLUMNS}
        print_rows(console, f"{self.study.scenario.title}: {what}", rows, columns, columns)
        off = [row["car_park"] for row in result.rows if row["simulated_error"] > FAR_OFF]
        if off:
            console.print(f"warning: not followed: {', '.join(off)}", style="yellow", soft_wrap=True)
        if summary["not_in_lot"]:
            console.print(f"Not in the lot: {', '.join(summary['not_in_lot'])}", soft_wrap=True)


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
        from parkenv.files.atomic_write import check_writable
        from parkenv.studies.fleet.recorded_days import record_days

        check_writable(self.out)
        console = make_console()
        with stages(console) as progress:
            lines = record_days(
                self.scenario, self.out, agent=self.agent, days=self.days, rounds=self.rounds, seed=self.seed,
                progress=progress,
            )  # fmt: skip
        console.print(f"{self.out}: {lines:,} observations of {plural(self.days, 'day')}", soft_wrap=True)


def _print_notes(console: Console, summary: Row) -> None:
    """Print what was wrong with the counts."""
    faults = ", ".join(f"{name.replace('_', ' ')} {n:,}" for name, n in summary["faults"].items() if n)
    console.print(f"Faults: {faults or 'none'}", soft_wrap=True)
    for name, what in summary["idle"].items():
        console.print(f"{name}: {what}", soft_wrap=True)
