"""The study of many cars: its tables, figures and replays."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from parkenv.files.file_names import file_name
from parkenv.show.tables import plural
from parkenv.studies.fleet.setting import COLUMNS, SHOWN, rate_text
from parkenv.studies.fleet.spec import OPTIONS, FleetSpec
from parkenv.studies.results import Results, Row, Table
from parkenv.studies.study import ReplayJob, ReportOptions
from parkenv.studies.workers import Task

if TYPE_CHECKING:
    from parkenv.studies.fleet.day import Day

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
        parkenv fleet --manoeuvre 15 --cues perfect
        parkenv fleet --resume --episodes 20
        """

    kind: Literal["fleet"] = "fleet"

    @property
    def further_tables(self) -> tuple[Table, ...]:  # type: ignore[override]
        from parkenv.studies.fleet.tables import TABLES

        return TABLES

    def day_tables(self, day: Day) -> dict[str, Row]:
        from parkenv.studies.fleet.tables import day_rows

        return day_rows(day)

    def summarise(self, results: Results) -> Row:
        from parkenv.studies.fleet.day import ALL, has_zones
        from parkenv.studies.fleet.tables import (
            BLOCKS,
            summarize_blocks,
            summarize_changes,
            summarize_days,
            summarize_hours,
        )

        days, built = self.finished_days(results), self.built
        keys = [key for work, items in self.cells() for item in items for key in self.keys(work, item)]
        blocks = [(built[key[0]], row) for key in keys if (row := results.rows(BLOCKS).get(key)) is not None]
        first = next(iter(built.values())).arrival.start_s // 3600.0
        prices = {
            name: {
                zone.name: float(zone.price.amount(scenario.priced_at_s, 3600.0))
                for zone in scenario.zone_rules
            }
            for name, scenario in built.items()
        }
        purposes = {
            name: [purpose.name for purpose in scenario.demand.purposes]
            for name, scenario in built.items()
            if scenario.demand is not None
        }
        zones = [row for scenario, row in blocks if has_zones(scenario)]
        in_towns = [row for scenario, row in blocks if scenario.lot.is_town]
        return {
            "manoeuvre_s": self.blocked_s,
            **{name: getattr(self, name) for name in OPTIONS},
            "rows": summarize_days(days),
            "changes": summarize_changes(days, prices, purposes),
            "hours": summarize_hours(days, int(first)),
            "zones": summarize_blocks(zones, "zone", prices),
            "blocks": summarize_blocks(in_towns, "block", prices),
            "purposes": summarize_blocks([row for _, row in blocks if {*row["purpose"]} != {ALL}], "purpose"),
            "reach": [{"scenario": name, **roads.reach()} for name, roads in self.roads.items()],
            "cautions": self.cautions(),
        }

    def outputs(self, results: Results, summary: Row) -> list[Task[object]]:
        from parkenv.show.figures.fleet import save_fleet_figure, save_zones_figure
        from parkenv.studies.fleet.day import has_zones, random_order_search_s
        from parkenv.studies.fleet.day_replay import write_map_page
        from parkenv.studies.fleet.tables import BLOCKS, TABLES, by_hour

        tasks: list[Task[object]] = [
            partial(
                save_fleet_figure,
                [row for row in summary["rows"] if row["scenario"] == name],
                partial(random_order_search_s, scenario),
                f"{name}: {plural(scenario.lot.n_slots, 'slot')}, {plural(self.days, 'day')}",
                results.path / (PICTURE if len(self.built) == 1 else file_name(f"fleet_{name}", ".png")),
                [row for row in summary["hours"] if row["scenario"] == name],
            )
            for name, scenario in self.built.items()
        ]
        rows = {table.file: list(results.rows(table).values()) for table in TABLES}
        tasks.append(partial(write_map_page, self, summary, rows, results.path))
        for setting in self.shown_settings:
            scenario = self.built[setting.scenario]
            days = [row for row in rows[BLOCKS.file] if setting.holds(row)]
            if has_zones(scenario) and days:
                name = "zones" if len(self.built) == 1 else f"zones_{setting.scenario}"
                title = f"{setting.scenario}: zones, {setting.agent.label}, {rate_text(setting.arrivals_per_hour)}"
                _, hours, courses = by_hour(days, "zone")
                path = results.path / file_name(name, ".png")
                tasks.append(partial(save_zones_figure, scenario.lot, title, hours, courses, path))
        return tasks

    @classmethod
    def findings(cls, summary: Row) -> list[str]:
        row = summary["rows"][0]
        setting = f"{row['agents']} on {row['scenario']}, {rate_text(row['arrivals_per_hour'])}"
        finding = f"{setting}: {row['total_s']:.1f} s a car, {row['balked_fraction']:.1%} find no slot."
        return [finding, *(f"On {name}, {caution}" for name, caution in summary["cautions"].items())]

    @classmethod
    def page_tables(cls, summary: Row, folder: Path) -> list[Row]:
        # Of a town with many streets the map tells, and blocks.csv.
        blocks = summary["blocks"] if len(summary["blocks"]) <= MOST_BLOCKS else []
        return super().page_tables({**summary, "blocks": blocks}, folder)

    def replays(self, folder: Path, options: ReportOptions) -> Sequence[ReplayJob]:
        from parkenv.studies.fleet.day_replay import day_replay, map_replay

        return [map_replay(self, folder), day_replay(self, folder, options)]
