"""Studies of many cars in one lot: information of drivers, and changes of the lot."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from parkenv.studies.fleet.setting import OWN, Setting, rate_text
from parkenv.studies.fleet.spec import OPTIONS, FleetSpec
from parkenv.studies.results import Results, Row, Table
from parkenv.studies.workers import Task

if TYPE_CHECKING:
    from parkenv.show.report.page import Page
    from parkenv.studies.fleet.day import Day
    from parkenv.studies.report import Replay
    from parkenv.studies.runner import Result

PICTURE = "fleet.png"
MOST_BLOCKS = 60  # rows of blocks up to which the page has a table of them


class FleetStudy(FleetSpec):
    """Days on which many cars search a lot: what they know, and what changes with the lot."""

    heading: ClassVar = "Many cars"
    table_titles: ClassVar = {
        "changes": "What changes for whom",
        "rows": "Results",
        "purposes": "Purposes, a day",
        "zones": "Zones, a day",
        "blocks": "Blocks, a day",
        "hours": "Occupancy by hour, simulated and as counted",
    }

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
    def page(cls, summary: Row, folder: Path) -> Page:
        """See `Study`; some columns mean something else than in other tables."""
        from parkenv.show.report.tables import OF_FLEETS, tables_of

        # Of a town with many streets the map tells, and blocks.csv.
        blocks = summary["blocks"] if len(summary["blocks"]) <= MOST_BLOCKS else []
        tables = tables_of({**summary, "blocks": blocks}, cls.table_titles, OF_FLEETS)
        return super().page(summary, folder)._replace(tables=tables)

    def replays(self, folder: Path) -> Sequence[Replay]:
        from parkenv.studies.fleet.day_map import DayMaps
        from parkenv.studies.fleet.day_replay import FleetReplay

        return [DayMaps(self, folder), FleetReplay(self, folder)]
