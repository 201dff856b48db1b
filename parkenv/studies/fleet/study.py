"""Studies of many cars in one lot: information of drivers, and changes of the lot."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from parkenv.studies.fleet.columns import COLUMNS, SHOWN
from parkenv.studies.fleet.setting import OWN, Setting, rate_text
from parkenv.studies.fleet.spec import OPTIONS, FleetSpec
from parkenv.studies.results import Results, Row, Table
from parkenv.studies.workers import Task

if TYPE_CHECKING:
    from parkenv.studies.fleet.day import Day
    from parkenv.studies.report import ReplayJob
    from parkenv.studies.report_options import ReportOptions
    from parkenv.studies.runner import Result

PICTURE = "fleet.png"
MOST_BLOCKS = 60  # rows of blocks up to which the page has a table of them


class FleetStudy(FleetSpec):
    """On a day, residents are parked when the hours of arrival begin, and leave after the rest of their stay.

    Cars arrive as a Poisson process. All settings have the same days: arrivals, stays, patience and residents. The
    table gives the mean over cars and days with 95 % intervals over days. The price of anarchy is the total time
    divided by that of a guidance system that reserves slots for all cars; it needs reserve in --knows, and 1 in
    --share.

    Several scenarios, for example a lot before and after a change, are compared with the first one: the same cars
    arrive on the same days. The second table lists the changes by group of cars, for guidance as for scenarios.
    """

    heading: ClassVar = "Many cars"
    table_titles: ClassVar = {
        "changes": "What changes for whom",
        "rows": "Results",
        "purposes": "Purposes, a day",
        "zones": "Zones, a day",
        "blocks": "Blocks, a day",
        "hours": "Occupancy by hour, simulated and as counted",
    }

    columns: ClassVar = COLUMNS
    shown: ClassVar = SHOWN
    writes: ClassVar = "days.csv, blocks.csv, lanes.csv, hours.csv, summary.json, fleet.html and figures"
    examples: ClassVar = """
        parkenv fleet --scenario campus --arrivals-per-hour 60,120 --out crowd
        parkenv fleet --agents belief,greedy-drive --knows own,reserve -n 5
        parkenv fleet --knows own,shared --share 0.1,0.25,0.5,1 --delay 60
        parkenv fleet --scenario old.geojson,new.geojson --hours 08:00-12:00 --report
        parkenv fleet --lot zones.geojson --price centre=2/h --value-of-time 12/h
        parkenv fleet --manoeuvre 15 --leaving-soon 10
        parkenv fleet --resume --episodes 20
        """

    kind: Literal["fleet"] = "fleet"

    @property
    def shown_settings(self) -> list[Setting]:
        """One setting of each scenario, to be drawn: the last one where nobody knows more than it observes, if any."""
        settings = sorted(self.fleet_settings, key=lambda setting: setting.knows == OWN)
        by_scenario = {setting.scenario: setting for setting in settings}
        return [by_scenario[name] for name in self.built]

    @property
    def further_tables(self) -> tuple[Table, ...]:  # type: ignore[override]
        from parkenv.studies.fleet.blocks import TABLES

        return TABLES

    def day_tables(self, day: Day) -> dict[str, Row]:
        from parkenv.studies.fleet.blocks import day_rows

        return day_rows(day)

    def summarise(self, results: Results) -> Row:
        from parkenv.studies.fleet.blocks import BLOCKS, has_zones, summarize_blocks, zone_prices
        from parkenv.studies.fleet.day import ALL
        from parkenv.studies.fleet.tables import summarize_changes, summarize_days, summarize_hours

        days, built = self.finished_days(results), self.built
        keys = [key for work, items in self.cells() for item in items for key in self.keys(work, item)]
        blocks = results.rows(BLOCKS)
        shown = [blocks[key] for key in keys if key in blocks]
        first = next(iter(built.values())).arrival.start_s // 3600.0
        prices = {name: zone_prices(scenario) for name, scenario in built.items()}
        demands = {name: scenario.demand for name, scenario in built.items() if scenario.demand is not None}
        purposes = {name: [one.name for one in demand.purposes] for name, demand in demands.items()}
        return {
            "manoeuvre_s": self.blocked_s,
            **{name: getattr(self, name) for name in OPTIONS},
            "rows": summarize_days(days),
            "changes": summarize_changes(days, prices, purposes),
            "hours": summarize_hours(days, int(first)),
            "zones": summarize_blocks(
                [row for row in shown if has_zones(built[row["scenario"]])], "zone", prices
            ),
            "blocks": summarize_blocks(
                [row for row in shown if built[row["scenario"]].lot.is_town], "block", prices
            ),
            "purposes": summarize_blocks([row for row in shown if {*row["purpose"]} != {ALL}], "purpose"),
            "reach": [{"scenario": name, **roads.reach()} for name, roads in self.roads.items()],
            "cautions": self.cautions(),
        }

    def outputs(self, result: Result) -> list[Task[object]]:
        from parkenv.files.file_names import file_name
        from parkenv.show.figures.fleet import save_fleet_figure, save_zones_figure
        from parkenv.show.plurals import plural
        from parkenv.studies.fleet.blocks import BLOCKS, TABLES, by_hour, has_zones
        from parkenv.studies.fleet.day_map import write_map_page
        from parkenv.studies.fleet.measures import random_order_search_s

        tasks: list[Task[object]] = [
            partial(
                save_fleet_figure,
                [row for row in result.rows if row["scenario"] == name],
                partial(random_order_search_s, scenario),
                f"{name}: {plural(scenario.lot.n_slots, 'slot')}, {plural(self.days, 'day')}",
                result.folder / (PICTURE if len(self.built) == 1 else file_name(f"fleet_{name}", ".png")),
                [row for row in result.summary["hours"] if row["scenario"] == name],
            )
            for name, scenario in self.built.items()
        ]
        rows = {table.file: list(result.results.rows(table).values()) for table in TABLES}
        tasks.append(partial(write_map_page, self, result.summary, rows, result.folder))
        for setting in self.shown_settings:
            scenario = self.built[setting.scenario]
            days = [row for row in rows[BLOCKS.file] if setting.holds(row)]
            if has_zones(scenario) and days:
                name = "zones" if len(self.built) == 1 else f"zones_{setting.scenario}"
                title = f"{setting.scenario}: zones, {setting.agent.label}, {rate_text(setting.arrivals_per_hour)}"
                _, hours, courses = by_hour(days, "zone")
                path = result.folder / file_name(name, ".png")
                tasks.append(partial(save_zones_figure, scenario.lot, title, hours, courses, path))
        return tasks

    @classmethod
    def findings(cls, summary: Row) -> list[str]:
        """See `Study`: the first setting, and warnings of the imports of lots."""
        row = summary["rows"][0]
        setting = f"{row['agents']} on {row['scenario']}, {rate_text(row['arrivals_per_hour'])}"
        finding = f"{setting}: {row['total_s']:.1f} s a car, {row['balked_fraction']:.1%} find no slot."
        return [finding, *(f"On {name}, {caution}" for name, caution in summary["cautions"].items())]

    @classmethod
    def page_tables(cls, summary: Row, folder: Path) -> list[Row]:
        """See `Study`; of a town with many streets the map tells, and blocks.csv."""
        blocks = summary["blocks"] if len(summary["blocks"]) <= MOST_BLOCKS else []
        return super().page_tables({**summary, "blocks": blocks}, folder)

    def replays(self, folder: Path, options: ReportOptions) -> Sequence[ReplayJob]:
        from parkenv.studies.fleet.day_map import map_replay
        from parkenv.studies.fleet.day_replay import day_replay

        return [map_replay(self, folder), day_replay(self, folder, options)]
