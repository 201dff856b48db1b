"""Demand of a town that fills its car parks as counted: fitted on some weeks, measured on the weeks after."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import date, timedelta
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field

from parkenv.errors import InputError, require
from parkenv.files.option import option
from parkenv.files.spec_file import FilePath
from parkenv.scenarios.spec import TIMEZONE_HELP, Date, PurposeSpec, scenario_spec
from parkenv.show.tables import Column, plural
from parkenv.studies.fields import AgentSpec, OneAgent, OneScenario, Seed
from parkenv.studies.results import Results, Row, Table, search_settings
from parkenv.studies.study import Cell, Stage, Study, counted
from parkenv.world.week import HOUR_S

if TYPE_CHECKING:
    from parkenv.compiled.arrays import FloatArray, IntArray
    from parkenv.studies.fleet.counted_demand import CountedTown
    from parkenv.studies.workers import Task

PREDICTIONS = ("simulated", "forecast", "last_week", "mean_followed")  # predictions of the counts
COLUMNS = (
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
# Mean difference from the counts, share of the places, above which a car park is said not to be followed.
FAR_OFF = 0.15
# Weekdays (Monday = 0) that have a demand of their own, by the name of its scenario file.
KINDS: dict[str, tuple[int, ...]] = {"scenario": (0, 1, 2, 3, 4), "saturday": (5,), "sunday": (6,)}


class _RollOut(NamedTuple):
    number: int
    fit: Mapping[str, Row] = {}  # of the kind of a day held out, by car park; see `CountedTown.fitted`
    expected: tuple[FloatArray, ...] = ()  # `before` and `expected` of that day; see `CountedTown.predicted`

    @property
    def columns(self) -> Row:
        return {"roll_out": self.number}


FITTED = Table("fitted.jsonl", ("roll_out", "kind"))
DAYS = Table("days.jsonl", ("date",))  # days held out; see `CountedTown.predicted`


class DemandStudy(Study):
    """Demand of a town that follows the counts of its car parks, and each later day as it was to be expected.

    The cars of a purpose have the goals, by the lot's weights, from which nearly all cars go to one car park, and its
    counts tell when they come and how many are there at first (`parkenv.world.arrivals`). Where they park is up
    to them; so the fleet is driven, and what a car park lacks or has too much is added to what the next round follows.

    Each day that is held out is driven for itself: its demand follows the forecast that was made before it
    (`parkenv.forecast.day_curves`), with the stays and corrections of the weeks followed, and the cars that were
    counted when it began.
    """

    table: ClassVar[Table] = DAYS
    further_tables: ClassVar = (FITTED,)
    block: ClassVar = 1
    doing: ClassVar = "Driving days held out"
    unit: ClassVar = ""
    heading: ClassVar = "Demand as counted"
    columns: ClassVar = COLUMNS
    shown: ClassVar = {"rows": [column.key for column in COLUMNS]}
    writes: ClassVar = (
        "scenario.json, saturday.json, sunday.json, summary.json, predicted.csv, demand.png, and finished work: "
        "fitted.jsonl and days.jsonl"
    )
    examples: ClassVar = """
        parkenv occupancy demand counts.csv.gz --scenario town.toml --from 2021-09-06
        parkenv fleet --scenario results/demand/scenario.json
        """

    kind: Literal["demand"] = "demand"
    counts: FilePath | None = option(
        None,
        "Counts, car_park,capacity,hour,free (or hour_utc, time, time_utc), as .csv or .csv.gz.",
        takes="FILE",
        argument=True,
    )
    # A factory, since a default with the paths of its files would stand in the schema.
    scenario: OneScenario = Field(default_factory=lambda: scenario_spec("town"))
    from_day: Date | None = option(
        None, "First day of the fit.", name="--from", takes="DATE", default="the first one counted"
    )
    weeks: int = option(8, "Weeks of the fit.", ge=1, le=520)
    held_out: int = option(4, "Predicted weeks after the fit.", ge=1, le=520)
    roll_outs: int = option(1, "Number of fits, each --held-out weeks later.", ge=1, le=520)
    agent: OneAgent = AgentSpec(name="usual")
    rounds: int = option(3, "Simulation rounds of the town for each fit.", ge=1, le=100)
    episodes: int = option(
        3, "Days of the fleet in each round, and for each predicted day.", short="-n", ge=1, le=1_000
    )
    timezone: str | None = option(None, TIMEZONE_HELP, takes="NAME", default="times are local")
    seed: Seed = Field(0, description="Seed of these days.")

    @cached_property
    def town(self) -> CountedTown:
        from parkenv.forecast.counts import Counts
        from parkenv.studies.fleet.counted_demand import CountedTown

        if self.counts is None:
            raise InputError("counts is missing, want a file of counts")
        return CountedTown(self.scenario, Counts.read(self.counts, self.timezone), self.agent)

    def days(self, roll_out: int) -> tuple[IntArray, IntArray]:
        # Those that are followed, and those held out, as indices into the days of the counts.
        first = self._first + timedelta(weeks=self.held_out * roll_out)
        later = first + timedelta(weeks=self.weeks)
        end = later + timedelta(weeks=self.held_out)
        return self.town.days_of(first, later), self.town.days_of(later, end)

    @property
    def _first(self) -> date:
        return self.from_day or self.town.counts.days[0]

    def check(self) -> None:
        counts = self.town.counts
        require(
            0 < counts.day_index(self._first + timedelta(weeks=self.weeks)) < len(counts.days),
            f"--from is {self._first}: {counts.source} has counts from {counts.days[0]} to {counts.days[-1]}, "
            f"want {plural(self.weeks, 'week')} and days after these among them",
        )
        require(
            len(self.days(self.roll_outs - 1)[1]),
            f"roll_outs is {self.roll_outs}, want fewer: {counts.source} ends with {counts.days[-1]}",
        )

    def settings(self) -> Row:
        more = ("weeks", "held_out", "rounds", "episodes", "timezone", "seed")
        return search_settings(self, *more) | {"from": str(self._first), "agent": self.agent.label}

    def cells(self) -> list[Cell]:
        days = self.town.counts.days
        return [
            Cell(_RollOut(number), [days[day].isoformat() for day in self.days(number)[1].tolist()])
            for number in range(self.roll_outs)
        ]

    def stages(self, results: Results) -> Iterator[Stage]:
        from parkenv.forecast.day_curves import FIT_STEPS, fit_settings, forecast_days

        fits = _Fits(**{name: getattr(self, name) for name in DemandStudy.model_fields})
        yield Stage(fits.doing, fits, fits.cells())
        counts = self.town.counts
        done = counted(results.progress, "Forecasting", FIT_STEPS)
        settings = fit_settings(counts, counts.day_index(self._first + timedelta(weeks=self.weeks)), done)
        forecast = forecast_days(counts, 0, "rolling", settings).occupancy
        cells = []
        for work, dates in self.cells():
            for text in dates:
                day = counts.day_index(date.fromisoformat(text))
                before, expected = self.town.expected(forecast, np.array([day]))
                fit = results.rows(FITTED)[work.number, kind_of(counts.weekday[day])]["car_parks"]
                cells.append(Cell(work._replace(fit=fit, expected=(before[0], expected[0])), [text]))
        yield Stage(self.doing, self, cells)

    def run(self, work: _RollOut, items: Sequence[Any]) -> list[Row]:
        day = self.town.counts.day_index(date.fromisoformat(items[0]))
        before, expected = work.expected
        lines = self.town.predicted(day, work.fit, before, expected, self.episodes, self.seed)
        return [{"date": items[0], **lines}]

    def label(self, work: _RollOut) -> str:
        return self.agent.label

    def summarise(self, results: Results) -> Row:
        from scipy.stats import spearmanr

        town, held_out = self.town, self._held_out(results)
        counts = held_out.shares["counted"]
        used = np.flatnonzero(np.isfinite(counts).any(axis=(1, 2)))
        if not used.size:
            if len(held_out.days) < sum(len(cell.items) for cell in self.cells()):
                return {"rows": []}
            raise InputError(
                f"{town.counts.source}: no car park is counted both on days followed and on days held out, want "
                "--from others"
            )
        errors = {name: np.abs(held_out.shares[name] - counts) for name in PREDICTIONS}
        errors["fit"] = np.where(np.isfinite(counts), held_out.fit_error, np.nan)
        weeks = np.unique((held_out.days - held_out.days[0]) // 7, return_inverse=True)[1]
        come, stay_h = np.nanmean(held_out.come, axis=1), np.nanmean(held_out.stay_h, axis=1)
        rows: list[Row] = []
        for number in used.tolist():
            known = np.isfinite(counts[number])
            row = {
                "car_park": town.names[number],
                "capacity": int(town.capacity[number]),
                "arrivals_a_day": float(come[number]),
                "stay_h": float(stay_h[number]),
                "map_weight": float(town.map_weight[number]),
                "days_held_out": int(known.any(axis=1).sum()),
                "counted": float(counts[number][known].mean()),
                "simulated": float(held_out.shares["simulated"][number][known].mean()),
            }
            rows.append(row | _errors({name: error[[number]] for name, error in errors.items()}, weeks))
        correlation = spearmanr(town.map_weight[used], come[used]).statistic if len(used) > 2 else None
        return {
            "rows": rows,
            **_errors(errors, weeks),
            "days_held_out": len(held_out.days),
            "map_rank_correlation": None if correlation is None else float(correlation),
            "not_in_lot": town.others,
        }

    @classmethod
    def findings(cls, summary: Row) -> list[str]:
        off = [row["car_park"] for row in summary["rows"] if row["simulated_error"] > FAR_OFF]
        lists = {"Not followed": off, "Not in the lot": summary["not_in_lot"]}
        return [
            f"{plural(summary['days_held_out'], 'day')} held out; error {summary['simulated_error']:.1%}.",
            *(f"{what}: {', '.join(names)}." for what, names in lists.items() if names),
        ]

    def _held_out(self, results: Results) -> HeldOutErrors:
        town, rows, fits = self.town, results.rows(DAYS), results.rows(FITTED)
        done = [(cell.work.number, item) for cell in self.cells() for item in cell.items if (item,) in rows]
        days = np.array([town.counts.day_index(date.fromisoformat(item)) for _, item in done], np.int64)
        shape = len(town.names), len(done), len(town.hours)
        shares = {name: np.full(shape, np.nan) for name in ("counted", *PREDICTIONS)}
        fit_error, come, stay_h = np.full(shape, np.nan), *np.full((2, *shape[:2]), np.nan)
        for k, (number, item) in enumerate(done):
            row = rows[item,]
            at = [town.names.index(name) for name in row["car_park"]]
            for name, values in shares.items():
                values[at, k, np.searchsorted(town.hours, row["hour"])] = row[name]
            for name, fit in fits[number, kind_of(town.counts.weekday[days[k]])]["car_parks"].items():
                i, purpose = town.names.index(name), PurposeSpec.parse(fit["purpose"], FITTED.file)
                driven, followed = (np.array(fit[column], np.float64) for column in ("driven", "followed"))
                fit_error[i, k] = np.abs(driven - followed) / town.capacity[i]
                come[i, k], stay_h[i, k] = sum(purpose.arrivals_per_hour), purpose.stay_s / HOUR_S
        return HeldOutErrors(days, shares, fit_error, come, stay_h)

    def outputs(self, results: Results, summary: Row) -> list[Task[object]]:
        from parkenv.show.figures.fleet import CarParkDays, save_counted_demand

        town, held_out, fits = self.town, self._held_out(results), results.rows(FITTED)
        last, first_kind = self.roll_outs - 1, None
        predictions = list(results.rows(DAYS).values())
        columns = ("car_park", "hour", "counted", *PREDICTIONS)
        table = Table("predicted.csv", ("date",), columns, long=True)
        tasks: list[Task[object]] = [partial(table.write, results.path, predictions)]
        for kind in KINDS:
            if car_parks := fits[last, kind]["car_parks"]:
                demand = self.scenario.demand | {name: fit["purpose"] for name, fit in car_parks.items()}
                scenario = self.scenario.changed(demand=demand)
                tasks.append(partial(scenario.write, results.path / f"{kind}.json"))
                first_kind = first_kind or kind
        if first_kind is None:
            return tasks  # nothing was counted in the last weeks
        shown = np.isin(held_out.days, self.days(last)[1])
        shown &= np.isin(town.counts.weekday[held_out.days], KINDS[first_kind])
        cars = {name: of[:, shown] * town.capacity[:, None, None] for name, of in held_out.shares.items()}
        simulated, followed, known = cars["simulated"], cars["mean_followed"], cars["counted"]
        car_park_days = [
            CarParkDays(
                town.names[k], town.capacity[k], np.nanmean(simulated[k], axis=0), followed[k][0], known[k]
            )
            for k in np.flatnonzero(np.isfinite(known).any(axis=(1, 2)))
        ]
        hours = town.hours.astype(np.float64) + 1.0
        return [*tasks, partial(save_counted_demand, car_park_days, hours, results.path / "demand.png")]


class HeldOutErrors(NamedTuple):  # finished days: n car parks on d days; NaN: unknown
    days: IntArray  # (d,) indices into the days of the counts
    shares: dict[str, FloatArray]  # (n, d, n_hours), `counted` and `PREDICTIONS`
    fit_error: FloatArray  # (n, d, n_hours), share of the places that the fit is off, of the weeks before
    come: FloatArray  # (n, d), cars that come on such a day, by the fit
    stay_h: FloatArray  # (n, d), their mean stay


class _Fits(DemandStudy):
    table: ClassVar[Table] = FITTED
    doing: ClassVar = "Fitting weeks followed"

    def cells(self) -> list[Cell]:
        return [Cell(_RollOut(number), tuple(KINDS)) for number in range(self.roll_outs)]

    def run(self, work: _RollOut, items: Sequence[Any]) -> list[Row]:
        (kind,), (followed, _) = items, self.days(work.number)
        days = followed[np.isin(self.town.counts.weekday[followed], KINDS[kind])]
        fit = self.town.fitted(days, self.rounds, self.episodes, self.seed)
        return [{**work.columns, "kind": kind, "car_parks": fit}]


def kind_of(weekday: int) -> str:
    return next(kind for kind, weekdays in KINDS.items() if weekday in weekdays)


def _errors(errors: Mapping[str, FloatArray], weeks: IntArray) -> Row:
    from parkenv.studies.statistics import columns_of, mean_interval

    row: Row = {}
    for name, error in errors.items():
        by_week = (error[:, weeks == week] for week in range(int(weeks.max()) + 1))
        means = [[np.nanmean(park) for park in week if np.isfinite(park).any()] for week in by_week]
        row |= columns_of(f"{name}_error", mean_interval([np.mean(parks) for parks in means if parks]))
    return row
