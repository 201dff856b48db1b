"""`parkenv commute` and `parkenv fleet`: drivers who come day after day, and many at a time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli.study_command import AgentStudyCommand
from parkenv.cli.tables import make_table
from parkenv.files.option import option
from parkenv.show.plurals import plural
from parkenv.studies.commute.study import Commute as CommuteStudy
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.results import Row

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from parkenv.studies.runner import Result


class Commute(AgentStudyCommand):
    """Each driver comes at the same time of day, on the next of the scenario's weekdays or recorded days.

    What the car observes on a search goes into its map in the evening, with the sensor's error rates; the next day's
    forecast is corrected by it. Nobody tells the map what else was free.

    The table and the picture show mean total time and forecast error (Brier score of P(taken) at the arrival, over
    all slots) against the day. For comparison, each agent also drives with the right map that does not learn (fixed);
    agents that use no map (first-free, greedy-drive, ...) have one level. All meet the same worlds.
    """

    examples = """
        parkenv commute --scenario jam --map wrong
        parkenv commute --scenario campus,jam --map empty,wrong --days 20
        parkenv commute --agents belief,first-free --drivers 100
        parkenv commute --fleet 5 --map empty
        parkenv commute --resume --days 60
        """

    study: CommuteStudy = CommuteStudy()
    out: Path = option(
        Path("results/commute"),
        "Folder for experiment.json, episodes.csv, summary.json, commute.png and the maps.",
        short="-o",
    )

    def show(self, console: Console, result: Result) -> None:
        """Print the tables of a commute."""
        weeks = result.summary["weeks"]
        for name in dict.fromkeys(row["scenario"] for row in weeks):
            console.print(_table(name, [row for row in weeks if row["scenario"] == name]))


def _table(scenario: str, rows: list[dict[str, Any]]) -> Table:
    """Make a table of mean total times, s, by map, agent and week, each with its forecast error."""
    weeks = list(dict.fromkeys(row["days"] for row in rows))
    cells: dict[tuple[str, str], dict[str, str]] = {}
    for row in rows:
        error = "" if row["forecast_error"] != row["forecast_error"] else f" ({row['forecast_error']:.3f})"
        cells.setdefault((row["map"], row["agent"]), {})[row["days"]] = f"{row['total_s']:.1f}{error}"
    return make_table(
        f"{scenario}: total s (forecast error) by days, {plural(rows[0]['courses'], 'driver')}",
        ("map", "agent", *(f"days {week}" for week in weeks)),
        ((*key, *(its.get(week, "") for week in weeks)) for key, its in cells.items()),
    )


class Fleet(AgentStudyCommand):
    """On a day, residents are parked when the hours of arrival begin, and leave after the rest of their stay.

    Cars arrive as a Poisson process. All settings have the same days: arrivals, stays, patience and residents. The
    table gives the mean over cars and days with 95 % intervals over days. The price of anarchy is the total time over
    that of a guidance system that reserves slots for all cars; it needs reserve among --knows, and 1 among --share.
    """

    examples = """
        parkenv fleet --scenario campus --arrivals-per-hour 60,120 --out crowd
        parkenv fleet --agents belief,greedy-drive --knows own,reserve -n 5
        parkenv fleet --knows own,shared --share 0.1,0.25,0.5,1 --delay 60
        parkenv fleet --manoeuvre 15 --leaving-soon 10
        parkenv fleet --resume --episodes 20
        """

    study: FleetStudy = FleetStudy()
    out: Path = option(
        Path("results/fleet"), "Folder for experiment.json, days.csv, summary.json and fleet.png.", short="-o"
    )

    def show(self, console: Console, result: Result) -> None:
        """Print the table of a study of many cars."""
        if not result.rows:
            return
        headings = (
            "agents", "knows", "share", "per hour", "total s [95 %]", "search s", "p95 s", "failed", "balked",
            "cruising", "occupancy", "price of anarchy", "over bound",
        )  # fmt: skip
        console.print(make_table(self.study.title, headings, map(_cells, result.rows)))


def _cells(row: Row) -> tuple[str, ...]:
    low, high = row["total_s_ci95"]
    cheap, dear = row["price_of_anarchy_ci95"]
    price = row["price_of_anarchy"]
    return (
        row["agents"],
        row["knows"],
        f"{row['share']:g}",
        f"{row['arrivals_per_hour']:g}",
        f"{row['total_s']:.1f} [{low:.1f}, {high:.1f}]",
        f"{row['search_s']:.1f}",
        f"{row['p95_s']:.0f}",
        f"{row['failed_attempts']:.3f}",
        f"{row['balked_fraction']:.1%}",
        f"{row['cruising_share']:.0%}",
        f"{row['occupancy']:.0%}",
        "" if price != price else f"{price:.3f} [{cheap:.3f}, {dear:.3f}]",
        f"{row['price_over_bound']:.3f}",
    )
