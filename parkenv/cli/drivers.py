"""`parkenv commute` and `parkenv fleet`: drivers who come day after day, and many at a time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from parkenv.cli.study_command import AgentStudyCommand
from parkenv.cli.tables import make_table
from parkenv.files.option import option
from parkenv.show.plurals import interval_text, number_text, plural
from parkenv.studies.commute.study import Commute as CommuteStudy
from parkenv.studies.fleet.changes import interval_of, is_known, sentence, shown_changes
from parkenv.studies.fleet.study import FleetStudy
from parkenv.studies.fleet.tables import ONE_DAY, carried, departures, unreached
from parkenv.studies.results import Row, without_nan
from parkenv.world.cost_terms import COST_TERMS

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from parkenv.studies.runner import Result

MOST_SHOWN = 15
"""Blocks of which the terminal tells."""


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

    Several scenarios, such as a lot before and after a change, are compared with the first one: the same cars come on
    the same days. The second table says what changes for whom, with guidance as with scenarios.
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
        """Print the tables of a study of many cars, and what changes between scenarios in sentences."""
        if not result.rows:
            return
        names = _setting_columns(result.rows)
        setting = names.values()
        mixed = any(0.0 < row["share"] < 1.0 for row in result.rows)
        headings = [
            *setting, "total s [95 %]", *(["members s", "others s"] if mixed else []), "search s", "95 % below s",
            "failed attempts", "no slot found", "cruising", "slots taken", "price of anarchy", "over bound",
        ]  # fmt: skip
        cells = [[*_setting(row, names), *_cells(row, mixed=mixed)] for row in result.rows]
        agents = "" if "agents" in names else f", {result.rows[0]['agents']}"
        console.print(make_table(f"{self.study.title}{agents}", headings, cells))
        if all(row["days"] == 1 for row in result.rows):
            console.print(ONE_DAY, soft_wrap=True)
        _show_money(console, result, names)
        changes = without_nan(result.summary["changes"])
        if changes:
            groups = ["members s [95 %]", "others s [95 %]"] if mixed else []
            zone = ["zone before"] if any(row["zone"] for row in changes) else []
            purpose = ["purpose"] if any(row["purpose"] for row in changes) else []
            paid = ["paid a car"] if any(is_known(row["paid_change"]) for row in changes) else []
            headings = [
                "after", "before", *zone, *purpose, *setting, "all cars s [95 %]", *groups, *paid, "better off",
                "worse off",
            ]  # fmt: skip
            cells = [
                [
                    row["after"], row["before"], *([row["zone"] or "all"] if zone else []),
                    *([row["purpose"] or "all"] if purpose else []),
                    *_setting(row, names), _interval(row, "change_s", "+.1f"),
                    *(_interval(row, f"{group.split()[0]}_change_s", "+.1f") for group in groups),
                    *(_interval(row, "paid_change", "+.2f") for _ in paid),
                    *(_number(row[name], ".0%") for name in ("better_off", "worse_off")),
                ]
                for row in changes
            ]  # fmt: skip
            title = "What changes for whom: time after minus before, of the same cars on the same days"
            console.print(make_table(title, headings, cells))
        for row in shown_changes(changes):
            if row["change"] == "scenario":
                console.print(sentence(row), soft_wrap=True)
        told = [f"On {name}, {caution}" for name, caution in result.summary["cautions"].items()]
        told += carried(without_nan(result.rows), self.study.most_balked)
        told += unreached(result.summary["reach"])
        for line in [*told, *departures(result.summary["hours"], result.rows)]:
            console.print(line, soft_wrap=True)


def _show_money(console: Console, result: Result, names: dict[str, str]) -> None:
    """Print what the total time is made of, and who pays where."""
    setting, zones = names.values(), result.summary["zones"] or result.summary["blocks"]
    terms = [term for term in COST_TERMS if not term.optional or any(row[term.field] for row in result.rows)]
    fields = [*(term.field for term in terms), "queued_s"]
    headings = [*setting, *(term.label for term in terms), "of it in queues"]
    headings += ["paid a car", "cars that pay"] if zones else []
    cells = [
        [
            *_setting(row, names),
            *(f"{row[name]:.1f}" for name in fields),
            *([f"{row['paid']:.2f}", f"{row['paying_share']:.0%}"] if zones else []),
        ]
        for row in result.rows
    ]
    console.print(make_table("What the total time is made of, s a car", headings, cells))
    for what in ("purpose", "zone", "block"):
        rows = result.summary[f"{what}s"]
        _show_places(console, what, rows, names)


def _show_places(console: Console, what: str, rows: Sequence[Row], names: dict[str, str]) -> None:
    """Print what happens on a day to the cars of each purpose, in each zone, or in the blocks with the most cars."""
    if not rows:
        return
    title = f"{what}s".capitalize()
    if len({row[what] for row in rows}) > MOST_SHOWN:
        title = f"The {MOST_SHOWN} blocks with the most cars, of {len({row[what] for row in rows})}"
        cars = sorted(rows, key=lambda row: -row["parked_a_day"])
        shown = list(dict.fromkeys(row[what] for row in cars))[:MOST_SHOWN]
        rows = [row for row in cars if row[what] in shown]
    is_place = what != "purpose"
    headings = [
        *names.values(), what, *(["slots", "price/h"] if is_place else []), "slots taken", "cars a day", "of all",
        *(["refused"] if is_place else ["no slot found"]), "search s", "walk s",
        "paid a day [95 %]" if any(interval_of(row, "paid_a_day") for row in rows) else "paid a day", "paid a car",
    ]  # fmt: skip
    cells = [
        [
            *_setting(row, names), row[what], *([str(row["slots"]), f"{row['price']:g}"] if is_place else []),
            _number(row["occupancy"], ".0%"), f"{row['parked_a_day']:.0f}", f"{row['share_parked']:.0%}",
            f"{row['refused_a_day']:.0f}" if is_place else _number(row["balked_fraction"], ".1%"),
            _number(row["search_s"], ".1f"), _number(row["walk_s"], ".1f"), _interval(row, "paid_a_day", ".2f"),
            _number(row["paid_a_car"], ".2f"),
        ]
        for row in rows
    ]  # fmt: skip
    console.print(make_table(title, headings, cells))


def _setting_columns(rows: Sequence[Row]) -> dict[str, str]:
    """Return the columns that tell settings apart, and the demand, with their headings."""
    several = [name for name in ("scenario", "agents") if len({row[name] for row in rows}) > 1]
    guided = {"knows": "members know", "share": "members"} if any(row["share"] for row in rows) else {}
    return dict(zip(several, several, strict=True)) | guided | {"arrivals_per_hour": "cars/h"}


def _setting(row: Row, names: Iterable[str]) -> list[str]:
    written = {
        "share": f"{row['share']:.0%}",
        "arrivals_per_hour": str(row["arrivals_per_hour"]).removesuffix(".0"),
    }
    return [written.get(name) or str(row[name]) for name in names]


def _cells(row: Row, *, mixed: bool) -> list[str]:
    counted = row.get("counted_occupancy")
    return [
        _interval(row, "total_s", ".1f"),
        *([_number(row[name], ".1f") for name in ("members_s", "others_s")] if mixed else []),
        f"{row['search_s']:.1f}",
        f"{row['p95_s']:.0f}",
        f"{row['failed_attempts']:.3f}",
        f"{row['balked_fraction']:.1%}",
        f"{row['cruising_share']:.0%}",
        f"{row['occupancy']:.0%}" + (f" (counted {counted:.0%})" if is_known(counted) else ""),
        _interval(row, "price_of_anarchy", ".3f"),
        _number(row["price_over_bound"], ".3f"),
    ]


def _number(value: float | None, spec: str) -> str:
    return "" if value is None or not is_known(value) else number_text(value, spec)


def _interval(row: Row, name: str, spec: str) -> str:
    """Return a value and its interval, each as far as it is known."""
    return interval_text(row[name], interval_of(row, name), spec) if is_known(row[name]) else ""
