"""`parkenv commute`, `fleet` and `curve`: drivers who come day after day, and many at a time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli.study_command import AgentStudyCommand
from parkenv.cli.tables import make_table, print_rows
from parkenv.files.option import option
from parkenv.show.plurals import plural
from parkenv.show.report.tables import OF_FLEETS
from parkenv.studies.commute.study import Commute as CommuteStudy
from parkenv.studies.curve.study import CurveStudy
from parkenv.studies.fleet.setting import SETTING_COLUMNS
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.results import Row, without_nan
from parkenv.world.cost_terms import COST_FIELDS

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from parkenv.studies.runner import Result

MOST_SHOWN = 15
"""Blocks of which the terminal tells."""
SHOWN = (
    "total_s", "members_s", "others_s", "search_s", "p95_s", "failed_attempts", "balked_fraction", "cruising_share",
    "occupancy", "counted_occupancy", "price_of_anarchy", "price_over_bound",
)  # fmt: skip
OF_PLACES = (
    "slots", "price", "occupancy", "parked_a_day", "share_parked", "search_s", "walk_s", "paid_a_day", "paid_a_car",
)  # fmt: skip
OF_CHANGES = (
    "after", "before", "zone", "purpose", "change_s", "members_change_s", "others_change_s", "paid_change",
    "better_off", "worse_off",
)  # fmt: skip
OF_DEMANDS = ("occupancy", "cruised_m", "walk_s", "failed_attempts", "balked_fraction")
"""Columns that are printed of settings, of zones, blocks and purposes, of changes, of demands, and of errors."""


class Commute(AgentStudyCommand):
    """Each driver comes at the same time of day, on the next of the scenario's weekdays or recorded days.

    In the evening, the observations of the search update the driver's map, with the sensor's error rates, and correct
    the next day's forecast. The map gets no other data.

    The table and the figure show mean total time and forecast error (Brier score of P(taken) at the arrival, over all
    slots) against the day. For comparison, each agent also drives with the right map without learning (fixed); agents
    without a map (first-free, greedy-drive, ...) have one level. All run in the same worlds.
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
    table gives the mean over cars and days with 95 % intervals over days. The price of anarchy is the total time
    divided by that of a guidance system that reserves slots for all cars; it needs reserve in --knows, and 1 in
    --share.

    Several scenarios, for example a lot before and after a change, are compared with the first one: the same cars
    arrive on the same days. The second table lists the changes by group of cars, for guidance as for scenarios.
    """

    examples = """
        parkenv fleet --scenario campus --arrivals-per-hour 60,120 --out crowd
        parkenv fleet --agents belief,greedy-drive --knows own,reserve -n 5
        parkenv fleet --knows own,shared --share 0.1,0.25,0.5,1 --delay 60
        parkenv fleet --scenario old.geojson,new.geojson --hours 08:00-12:00 --report
        parkenv fleet --lot zones.geojson --price centre=2/h --value-of-time 12/h
        parkenv fleet --manoeuvre 15 --leaving-soon 10
        parkenv fleet --resume --episodes 20
        """

    study: FleetStudy = FleetStudy()
    out: Path = option(
        Path("results/fleet"),
        "Folder for experiment.json, days.csv, blocks.csv, lanes.csv, hours.csv, summary.json, fleet.html and figures.",
        short="-o",
    )

    def show(self, console: Console, result: Result) -> None:
        """Print the tables of a study of many cars."""
        rows, changes = result.rows, without_nan(result.summary["changes"])
        if not rows:
            return
        print_rows(console, self.study.title, rows, (*SETTING_COLUMNS, *SHOWN), OF_FLEETS)
        what = (
            *COST_FIELDS,
            "queued_s",
            *(("paid", "paying_share") if any(row["paid"] for row in rows) else ()),
        )
        print_rows(
            console, "What the total time is made of, a car", rows, (*SETTING_COLUMNS, *what), OF_FLEETS
        )
        for name in ("purpose", "zone", "block"):
            _show_places(console, name, result.summary[f"{name}s"])
        if changes:
            title = "What changes for whom: time after minus before, of the same cars on the same days"
            print_rows(console, title, changes, (*SETTING_COLUMNS, *OF_CHANGES))
        for line in self.study.findings(result.summary):
            console.print(line, soft_wrap=True)


class Curve(AgentStudyCommand):
    """The command simulates all cars of a town at several demands, with the same random numbers.

    For each zone (a goal and the spaces around), hour and purpose it fits the search time beyond the direct drive, the
    walk, failed attempts and the share of cars that find no space, as monotone functions of occupancy and demand,
    pooled over zones, with 95 % intervals over days and zones. The table gives the errors in held-out zones, towns and
    demands, and those of the usual closed forms. Other models can read the files in --out.
    """

    examples = """
        parkenv curve town --out results/curve
        parkenv curve town.toml other.toml -n 10
        parkenv curve campus --arrivals-per-hour 40,80,120,160 --hours 08:00-12:00
        parkenv curve --resume --out results/curve -n 20
        """

    study: CurveStudy = CurveStudy()
    out: Path = option(
        Path("results/curve"),
        "Folder for experiment.json, days.csv, curve.csv, curve.json, activitysim.csv, matsim.csv, held_out.csv, "
        "summary.json and curve.png.",
        short="-o",
    )

    def show(self, console: Console, result: Result) -> None:
        """Print how full a lot is at each demand, and how far curves are off."""
        from parkenv.studies.curve.fit import PREDICTORS

        if not result.rows:
            return
        print_rows(console, self.study.title, result.rows, (*SETTING_COLUMNS, *OF_DEMANDS), OF_FLEETS)
        summary = without_nan(result.summary)
        if errors := summary["errors"]:
            print_rows(console, self.study.table_titles["errors"], errors, errors[0], PREDICTORS)
        for line in self.study.findings(summary):
            console.print(line, soft_wrap=True)


def _show_places(console: Console, what: str, rows: Sequence[Row]) -> None:
    """Print what happens on a day to the cars of each purpose, in each zone or block, or in those with the most."""
    title = f"{what}s, a day".capitalize()
    if (count := len({row[what] for row in rows})) > MOST_SHOWN:
        title = f"The {MOST_SHOWN} {what}s with the most cars, of {count}, a day"
        rows = sorted(rows, key=lambda row: -row["parked_a_day"])
        names = list(dict.fromkeys(row[what] for row in rows))[:MOST_SHOWN]
        rows = [row for row in rows if row[what] in names]
    if rows:
        end = "balked_fraction" if what == "purpose" else "refused_a_day"
        print_rows(console, title, rows, (*SETTING_COLUMNS, what, *OF_PLACES, end), OF_FLEETS)
