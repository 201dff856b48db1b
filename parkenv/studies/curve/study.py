"""Curves for other models: a town or a lot at several demands, and what searches there are like as functions of it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from parkenv.errors import require
from parkenv.files.file_names import file_name
from parkenv.files.option import Inside, Option, option, words_in
from parkenv.scenarios.spec import scenario_spec
from parkenv.show.tables import Column, plural, tables_of
from parkenv.studies.fields import TRAFFIC, ScenarioList, Values
from parkenv.studies.fleet.setting import COLUMNS, OWN, SETTING_COLUMNS, Demanded, times_demanded
from parkenv.studies.fleet.spec import FleetSpec
from parkenv.studies.results import Results, Row, Table
from parkenv.studies.study import counted
from parkenv.studies.workers import Task
from parkenv.world.week import HOUR_S

if TYPE_CHECKING:
    from parkenv.studies.curve.curves import Paths
    from parkenv.studies.curve.zones import LoneSearches, Zones
    from parkenv.studies.fleet.day import Day
    from parkenv.world.scenario import Scenario

PICTURE = "curve.png"
# Search times, s, of zones that were held out, by hour and demand: in the mean of the days, and by the curve that was
# fitted to the others.
HELD_OUT = Table(
    "held_out.csv", ("scenario", "zone", "hour", "multiple"), ("cars", "occupancy", "measured", "predicted")
)


_ERRORS = (
    Column("chance", "chance in the days", share=True, digits=0),
    Column("of_zones", "curve, day means", share=True, digits=0),
    Column("measured", "mean measured"),
    Column("bias", "curve, bias", share=True, signed=True),
)


# A line for each day: sums over the cars of a zone, purpose and hour where some arrive, and the `STATE` of zones by
# hour, as `zones.day_of_zones` returns them. Hours count from the first of the day's arrivals.
ZONES = Table("zones.jsonl", (*SETTING_COLUMNS, "day"))


def _size(rate: float | str) -> float:
    return times_demanded(rate) if isinstance(rate, str) else rate


class CurveStudy(FleetSpec):
    """The command simulates all cars of a town at several demands, with the same random numbers.

    For each zone (a goal and the spaces around), hour and purpose it fits the search time beyond the direct drive, the
    walk, failed attempts and the share of cars that find no space, as monotone functions of occupancy and demand,
    pooled over zones, with 95 % intervals over days and zones. The table gives the errors in held-out zones, towns and
    demands, and those of the usual closed forms. Other models can read the files in --out.
    """

    further_tables: ClassVar = (ZONES, HELD_OUT)
    heading: ClassVar = "Curves"
    table_titles: ClassVar = {"errors": "How far off where they were not fitted", "rows": "Whole lots"}

    shown: ClassVar = {
        "rows": (*SETTING_COLUMNS, "occupancy", "cruised_m", "walk_s", "failed_attempts", "balked_fraction"),
        "errors": (),
    }
    writes: ClassVar = (
        "days.csv, curve.csv, curve.json, activitysim.csv, matsim.csv, held_out.csv and figures"
    )
    examples: ClassVar = """
        parkenv curve town --out results/curve
        parkenv curve town.toml other.toml -n 10
        parkenv curve campus --arrivals-per-hour 40,80,120,160 --hours 08:00-12:00
        parkenv curve --resume --out results/curve -n 20
        """

    kind: Literal["curve"] = "curve"
    scenarios: Annotated[
        ScenarioList,
        Option("SCENARIO", takes="NAME|FILE|DIR", argument=True, default="town"),
        Inside(without=TRAFFIC),
        # A factory, since a default with the paths of its files would stand in the schema.
    ] = Field(default_factory=lambda: (scenario_spec("town"),))
    arrivals_per_hour: Values[Demanded] | None = option(
        ("0.4x", "0.7x", "1x", "1.2x", "1.4x", "1.6x"),
        "Demands to simulate: multiples of the scenario's own, or else of the counted one; or cars an hour.",
        takes="X|1.2x[,...]",
        panel="Demand",
        parse=words_in,
    )
    days: int = option(6, "Days of each demand.", name="--episodes", short="-n", ge=2, le=100_000)
    reach_m: float = option(
        300.0, "Largest walk from a space to the goal of its zone, m.", name="--reach", ge=1.0, le=10_000.0
    )
    bootstraps: int = option(
        20, "Number of bootstrap samples of days and zones, for intervals.", panel="Results", ge=2, le=10_000
    )

    @property
    def knowledge(self) -> tuple[str, ...]:
        return self.knows or (OWN,)

    @property
    def demands(self) -> tuple[float | str, ...]:
        return tuple(sorted(super().demands, key=_size))

    @cached_property
    def zones(self) -> dict[str, Zones]:
        from parkenv.studies.curve.zones import Zones

        return {name: Zones.of(goals, self.reach_m) for name, goals in self._goals.items()}

    @cached_property
    def _goals(self) -> dict[str, Sequence[Scenario]]:
        return {setting.scenario: self.fleet(setting)[0].scenarios for setting in self.fleet_settings}

    @cached_property
    def _lone(self) -> dict[str, LoneSearches]:
        from parkenv.studies.curve.zones import LoneSearches

        return {name: LoneSearches(goals) for name, goals in self._goals.items()}

    def day_tables(self, day: Day) -> dict[str, Row]:
        from parkenv.studies.curve.zones import day_of_zones

        name = day.fleet.scenario.name
        return {ZONES.file: day_of_zones(day, self.zones[name], self._lone[name])}

    def check(self) -> None:
        for name, values in (("agents", self.drivers), ("knows", self.knowledge), ("shares", self.shares)):
            require(
                len(values) <= 1, f"{name} has {len(values)} values, want one: a curve is of equal drivers"
            )
        require(
            len({isinstance(rate, str) for rate in self.demands}) <= 1,
            f"arrivals_per_hour is {self.demands}, want either multiples or cars an hour",
        )
        super().check()

    def settings(self) -> Row:
        return super().settings() | {"reach_m": self.reach_m}

    def _paths(self, results: Results) -> Paths | None:
        from parkenv.studies.curve.curves import Paths, Town
        from parkenv.studies.fleet.day import purpose_names

        rows = results.rows(ZONES)
        days: dict[str, list[list[Row]]] = {name: [] for name in self.built}
        purposes = {}
        for setting, items in self.cells():
            keys = [key for day in items for key in self.keys(setting, day)]
            days[setting.scenario].append([rows[key] for key in keys if key in rows])
            purposes[setting.scenario] = purpose_names(self.fleet(setting)[0])
        n_days = min(len(of_demand) for of_town in days.values() for of_demand in of_town)
        if n_days < 2:
            return None
        towns = {}
        for name, of_town in days.items():
            equal_days = [of_demand[:n_days] for of_demand in of_town]
            towns[name] = Town(self.zones[name], purposes[name], equal_days, self._usual(name))
        first_hour = int(next(iter(self.built.values())).arrival.start_s // HOUR_S)
        return Paths.of(towns, [_size(rate) for rate in self.demands], first_hour)

    def _usual(self, name: str) -> float:
        # A scenario's own demand, as `demands` has it; in cars an hour, without its own, the middle one.
        own, window = self.built[name].demand, self.built[name].arrival
        middle = self.demands[len(self.demands) // 2]
        per_hour = middle if own is None else own.expected / (window.end_s - window.start_s) * HOUR_S
        return 1.0 if isinstance(middle, str) else float(per_hour)

    def summarise(self, results: Results) -> Row:
        from parkenv.studies.curve.curves import (
            OUTCOMES,
            curve_table,
            held_out_errors,
            held_out_parts,
            write_curves,
        )
        from parkenv.studies.fleet.tables import summarize_days

        days = self.finished_days(results)
        summary: Row = {"rows": summarize_days(days), "errors": [], "cautions": self.cautions()}
        if (paths := self._paths(results)) is None:
            return summary
        fits = len(OUTCOMES) * (len([*held_out_parts(paths, self.seed)]) + 1 + self.bootstraps)
        how = self.seed, results.workers, counted(results.progress, "Fitting curves", fits)
        errors, held_out = held_out_errors(paths, *how)
        # The curves, `curve.csv` and the files for other models, are written here.
        results.replace(held_out, HELD_OUT)
        write_curves(paths, curve_table(paths, self.bootstraps, *how), results.path)
        zones = {name: len(zones.names) for name, zones in self.zones.items()}
        return summary | {"zones": zones, "reach_m": self.reach_m, "errors": errors}

    def outputs(self, results: Results, summary: Row) -> list[Task[object]]:
        from parkenv.show.figures.fleet import save_curves
        from parkenv.studies.curve.curves import FORMS, PREDICTORS, fit_form, form_at, load_curves
        from parkenv.studies.fleet.day import ALL

        if "zones" not in summary:
            return []
        curves, points = load_curves(results.path).curves, [*results.rows(HELD_OUT).values()]
        tasks: list[Task[object]] = []
        errors = [row for row in summary["errors"] if row["held_out"] == "zones"][:1]
        off = {key: row[key] for row in errors for key in (*PREDICTORS, "chance")}
        for name, zones in self.zones.items():
            by_purpose = {p: curve for (s, z, p, h), curve in curves.items() if (s, z, h) == (name, ALL, ALL)}
            by_purpose = {ALL: by_purpose[ALL]} | by_purpose
            of_zones = [row for row in points if row["scenario"] == name]
            x, y, cars = (
                np.array([row[name] for row in of_zones]) for name in ("occupancy", "measured", "cars")
            )
            forms = (
                {form: partial(form_at, form, fit_form(form, x, y, cars)) for form in FORMS} if len(x) else {}
            )
            title = f"{name}: {plural(len(zones.names), 'zone')}, {plural(self.days, 'day')} of each demand"
            path = results.path / (PICTURE if len(self.zones) == 1 else file_name(f"curve_{name}", ".png"))
            tasks.append(partial(save_curves, by_purpose, of_zones, off, forms, title, path))
        return tasks

    @classmethod
    def findings(cls, summary: Row) -> list[str]:
        findings = [f"On {name}, {caution}" for name, caution in summary["cautions"].items()]
        for row in summary["errors"][:1]:
            findings.insert(
                0, f"{row['outcome']}, {row['held_out']} held out: {row['curve']:.1%} off by zone-hours."
            )
        return findings

    @classmethod
    def page_tables(cls, summary: Row, folder: Path) -> list[Row]:
        from parkenv.studies.curve.curves import PREDICTORS

        labels = Column("held_out", "held out"), Column("outcome", "outcome")
        return tables_of(summary, cls.table_titles, (*COLUMNS, *labels, *PREDICTORS.values(), *_ERRORS))
