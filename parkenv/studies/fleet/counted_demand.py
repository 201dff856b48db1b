"""Demand of a town that fills its car parks as counted: fitted on some weeks, and measured on the weeks after."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import date, timedelta
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import spearmanr

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.engine.fleet import DriverKind, Fleet, drive_times
from parkenv.errors import InputError
from parkenv.files.atomic_write import atomic_write, make_folder
from parkenv.files.csv_tables import csv_columns
from parkenv.forecast.baselines import last_week
from parkenv.forecast.counts import Counts
from parkenv.forecast.day_curves import FIT_STEPS, fit_settings, forecast_days
from parkenv.scenarios.build import build
from parkenv.scenarios.purposes import PurposeSpec, demand_of
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.show.figures.counted_demand import CarParkDays, save_counted_demand
from parkenv.show.plurals import plural
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.fleet.drivers import compiled_policy_of
from parkenv.studies.occupancy import Found
from parkenv.studies.results import Row
from parkenv.studies.statistics import columns_of, mean_interval
from parkenv.studies.study import Progress, counted
from parkenv.studies.workers import Workers
from parkenv.world.counted_demand import STAYS_H, follow_counts
from parkenv.world.demand import hours_between, weights_of_all
from parkenv.world.week import DAY_HOURS, HOUR_S

KINDS: dict[str, tuple[int, ...]] = {"scenario": (0, 1, 2, 3, 4), "saturday": (5,), "sunday": (6,)}
"""Weekdays (Monday = 0) that have a demand of their own, by the name of its scenario file."""
PREDICTIONS = ("simulated", "forecast", "last_week", "mean_followed")
"""What was to be expected of the counts."""
_COLUMNS = ("car_park", "date", "hour", "counted", *PREDICTIONS)
"""Columns of `predicted.csv`, with shares of the places taken at the end of an hour."""
PATIENCE_S = 3600.0
"""Drivers come from far, and where a car park is full another one may be far, too."""
_STEP = 0.7  # share of what is off that a round corrects
_NEARLY_ALL = 0.95  # of the cars with a goal
_COUNTED_HOURS = 0.5  # of the hours, in which a car park that is followed has to be counted


class Weeks(NamedTuple):
    """Weeks that are followed, and later ones that are held out; several times, each time `held_out` weeks later."""

    first: date
    followed: int
    held_out: int
    roll_outs: int = 1

    def of(self, roll_out: int) -> tuple[date, date, date]:
        """Return the first day that is followed, the first that is held out, and the day after the last of these."""
        first = self.first + timedelta(weeks=self.held_out * roll_out)
        later = first + timedelta(weeks=self.followed)
        return first, later, later + timedelta(weeks=self.held_out)


def fit_demand(
    spec: ScenarioSpec,
    counts: Counts,
    folder: Path,
    *,
    weeks: Weeks,
    agent: AgentSpec,
    rounds: int,
    days: int,
    seed: int,
    jobs: int | None = 1,
    progress: Progress = lambda *_: None,
) -> Found:
    """Fit a purpose for each counted car park of a lot that has counts; write scenarios, predictions and a picture.

    The cars of a purpose have the goals, by the lot's weights, from which nearly all cars go to that car park, and its
    counts tell when they come and how many are there at first (`parkenv.world.counted_demand`). Where they park is up
    to them; so the fleet is driven, and what a car park lacks or has too much is added to what the next round follows.

    Each day that is held out is driven for itself: its demand follows the forecast that was made before it
    (`parkenv.forecast.day_curves`), with the stays and corrections of the weeks followed, and the cars that were
    counted when it began.

    Args:
        spec: lot, costs, days and hours, and the purposes of other cars.
        counts: counts of car parks; those that are named as counted facilities of the lot are used.
        folder: where the files go.
        weeks: days that are followed, of the scenario's weekdays, and later ones that are held out.
        agent: drives all cars.
        rounds: how often the fleet is driven for a fit.
        days: days of the fleet of each round, and for each day held out.
        seed: seed of the days.
        jobs: processes; None: one a core.
        progress: called as roll-outs end.

    Raises:
        InputError: no counted facility of the lot has counts on these days, or the hours are not full ones.
    """
    town = _Town(spec, counts, agent)
    later = weeks.of(0)[1]
    if not counts.days[0] < later <= counts.days[-1]:
        raise InputError(
            f"--from is {weeks.first}: {counts.source} has counts from {counts.days[0]} to {counts.days[-1]}, want "
            f"{plural(weeks.followed, 'week')} and days after these among them"
        )
    first = counts.day_index(later)
    settings = fit_settings(town.counts, first, counted(progress, "Fit", FIT_STEPS))
    forecast = forecast_days(town.counts, 0, "rolling", settings).occupancy
    done = counted(progress, "Roll-outs", weeks.roll_outs)
    roll_out = partial(_roll_out, spec, counts, agent, forecast, rounds, days, seed)
    make_folder(folder)
    found: list[_RollOut] = []
    with Workers(jobs) as workers:
        for one in workers.in_order([partial(roll_out, *weeks.of(k)) for k in range(weeks.roll_outs)]):
            found.append(one)
            done()
    found = [one for one in found if one.purposes]
    if not found:
        raise InputError(
            f"{counts.source}: no car park of the lot was counted on the days followed, want --from others"
        )
    for kind, purposes in found[-1].purposes.items():
        spec.changed(demand={**spec.demand, **purposes}).write(folder / f"{kind}.json")
    return _report(town, forecast, found, spec.title, folder)


class _RollOut(NamedTuple):
    """What was fitted on some weeks and predicted for the days held out; NaN: unknown."""

    purposes: dict[str, dict[str, PurposeSpec]]  # by kind of day
    days: IntArray  # (d,), held out
    simulated: FloatArray  # (n, d, n_hours), cars on days held out
    followed: FloatArray  # (n, d, n_hours), mean counts of their kind of day
    fit: FloatArray  # (n, d, n_hours), cars of the last round for that kind of day
    demand: FloatArray  # (n, d, 2), cars that come on the day, and their mean stay, h


def _roll_out(
    spec: ScenarioSpec, counts: Counts, agent: AgentSpec, forecast: FloatArray, rounds: int, n: int, seed: int,
    first: date, later: date, end: date,
) -> _RollOut:  # fmt: skip
    """Fit the demand of the days from `first` to `later`, and drive those until `end`."""
    town = _Town(spec, counts, agent)
    followed_days, days = town.days_of(first, later), town.days_of(later, end)
    simulated, followed, fit = np.full((3, len(town.names), len(days), len(town.hours)), np.nan)
    demand, purposes = np.full((len(town.names), len(days), 2), np.nan), {}
    before, expected = town.expected(forecast, days)
    for kind, weekdays in KINDS.items():
        mine = followed_days[np.isin(counts.weekday[followed_days], weekdays)]
        at_first, cars = (town.mean(values) for values in town.cars(town.counts.occupied, mine))
        if not np.isfinite(cars).any():
            continue
        target, stays_h = cars, dict[str, tuple[float, ...]]()
        for number in range(rounds):
            purposes[kind] = town.purposes(at_first, target, stays_h)
            stays_h = {name: (its.stay_s / HOUR_S,) for name, its in purposes[kind].items()}
            driven = town.driven(purposes[kind], seed, range(number * n, (number + 1) * n))
            target = np.maximum(target + _STEP * (cars - driven), 0.0)
        known = np.isfinite(cars).any(axis=1)
        for k in np.flatnonzero(np.isin(counts.weekday[days], weekdays)).tolist():
            its = town.purposes(before[k], np.maximum(expected[k] + target - cars, 0.0), stays_h)
            episode = int(days[k]) * n
            simulated[known, k] = town.driven(its, seed, range(episode, episode + n))[known]
            followed[:, k], fit[known, k] = cars, driven[known]
            demand[known, k] = [(sum(one.arrivals_per_hour), one.stay_s / HOUR_S) for one in its.values()]
    return _RollOut(purposes, days, simulated, followed, fit, demand)


class _Town:
    """The counted facilities of a lot that have counts, their days, and the fleet that drives there."""

    def __init__(self, spec: ScenarioSpec, counts: Counts, agent: AgentSpec) -> None:
        self.scenario = build(spec.changed(demand={}))
        self.spec, self.policy = spec, compiled_policy_of(agent, self.scenario)
        self._fleet: Fleet | None = None
        lot, window = self.scenario.lot, self.scenario.arrival
        if window.start_s % HOUR_S or window.end_s % HOUR_S or window.end_s <= window.start_s:
            raise InputError("arrivals.hours are not full hours, want those that counts are made in")
        slots = {lot.slot_ids[slot]: slot for slot in np.flatnonzero(lot.is_counted).tolist()}
        self.names = [name for name in counts.car_parks if name in slots]
        self.others = [name for name in counts.car_parks if name not in slots]
        if not self.names:
            raise InputError(
                f"{counts.source}: none of its car parks is a counted facility of lot {lot.name!r}; want names of "
                f"{', '.join(slots) or 'such ones'}"
            )
        self.slots: IntArray = np.array([slots[name] for name in self.names])
        self.capacity = lot.capacity[self.slots].astype(np.float64)
        self.hours = (hours_between(window.start_s, window.end_s)[:-1] // HOUR_S).astype(np.int64)
        self.counts, self._window = counts.chosen(self.names), window
        self.map_weight, self._goals = self._attraction()

    def _attraction(self) -> tuple[FloatArray, FloatArray]:
        """Return the lot's weight of the goals nearest to each car park, (n,), and weights of its own goals, (n, g).

        Of a car park's own goals nearly all cars, or as many as of any goal, would park there if nothing was full.
        """
        lot, scenario = self.scenario.lot, self.scenario
        weight = np.array(weights_of_all(lot.goal_weights) or np.ones(len(lot.goals)))
        walk_m = np.array([lot.walk_m(goal)[self.slots] for goal in range(len(lot.goals))])
        numbers = np.arange(len(self.names))
        near = (walk_m.argmin(axis=1) == numbers[:, None]) @ weight
        arrival_s = np.array([scenario.at_goal(k).arrival_cost_s[self.slots] for k in range(len(lot.goals))])
        drive_s = drive_times(scenario, lot.entry_vertices)[:, self.slots]
        best = (drive_s[:, None] + arrival_s).argmin(axis=2)  # of each entry and goal
        traffic = np.array(weights_of_all(lot.entry_weights) or np.ones(len(lot.entries)))
        share = np.array([traffic @ (best == number) for number in numbers]) / traffic.sum()
        chosen = share >= np.minimum(share.max(axis=1, keepdims=True), _NEARLY_ALL)
        own = np.where(chosen, np.maximum(weight, 1e-9), 0.0)
        unchosen = share.max(axis=1) == 0.0
        own[unchosen] = 0.0
        own[unchosen, walk_m.argmin(axis=0)[unchosen]] = 1.0
        return near, own

    def days_of(self, first: date, end: date) -> IntArray:
        """Return the indices of the scenario's weekdays from a date to before another one, (d,)."""
        days = np.arange(self.counts.day_index(first), self.counts.day_index(end))
        return days[np.isin(self.counts.weekday[days], self._window.weekdays)]

    def cars(self, occupied: FloatArray, days: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the cars at the beginning of the window, (d, n), and at the end of its hours, (d, n, n_hours).

        Args:
            occupied: (n, all days, 24) share of the places, NaN: not counted.
            days: (d,) indices.
        """
        start = int(self.hours[0])
        cars = occupied * self.capacity[:, None, None]
        before = cars[:, days, start - 1] if start else cars[:, np.maximum(days - 1, 0), DAY_HOURS - 1]
        return before.T, cars[:, days][:, :, self.hours].transpose(1, 0, 2)

    def expected(self, forecast: FloatArray, days: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return `cars` of the forecasts made before each day; what was counted at midnight is known by then."""
        before, hours = self.cars(forecast, days)
        if not self.hours[0]:
            known, _ = self.cars(self.counts.seen, days)
            before = np.where(np.isfinite(known), known, before)
        return before, hours

    def mean(self, cars: FloatArray) -> FloatArray:
        """Return the mean over days; NaN for hours, or car parks, that were rarely counted."""
        known = np.isfinite(cars)
        mean: FloatArray = np.nansum(cars, axis=0) / np.maximum(known.sum(axis=0), 1)
        mean[~known.any(axis=0)] = np.nan
        if mean.ndim == 2:
            mean[np.isfinite(mean).mean(axis=1) < _COUNTED_HOURS] = np.nan
        return mean

    def purposes(
        self, at_first: FloatArray, cars: FloatArray, stays_h: Mapping[str, tuple[float, ...]]
    ) -> dict[str, PurposeSpec]:
        """Return a purpose for each counted car park, with which it would have so many cars at the ends of the hours.

        Mean stays are those given, h, or else chosen.
        """
        made = {}
        for name, goals, first, counted_cars in zip(self.names, self._goals, at_first, cars, strict=True):
            if not np.isfinite(counted_cars).any():
                continue
            start = first if np.isfinite(first) else counted_cars[np.isfinite(counted_cars)][0]
            window = self._window.start_s, self._window.end_s
            found = follow_counts(start, counted_cars, *window, stays_h.get(name, STAYS_H))
            rates = np.zeros(DAY_HOURS)
            rates[self.hours] = found.per_hour
            made[name] = PurposeSpec(
                arrivals_per_hour=tuple(np.round(rates, 3).tolist()),
                stay_s=found.stay.mean_s,
                stay_law="log-normal",
                stay_cv=found.stay.cv,
                parked=round(start),
                patience_s=PATIENCE_S,
                goals=tuple(goals.tolist()),
            )
        return made

    def driven(self, purposes: Mapping[str, PurposeSpec], seed: int, days: range) -> FloatArray:
        """Return the mean cars in the car parks at the end of each hour of days of the fleet, (n, n_hours)."""
        scenario = self.scenario
        demand = demand_of({**self.spec.demand, **purposes}, scenario.lot, scenario.arrival)
        fleet = self._fleet = self._fleet or Fleet(
            scenario,
            drivers=[DriverKind(policy=self.policy)],
            background="none",
            leave_full_lot=False,
            demand=demand,
        )
        if demand is not None:
            fleet.demand = demand
        total = np.zeros((len(self.names), len(self.hours)))
        for day in days:
            fleet.reset(seed, day)
            fleet.run()
            cars = fleet.cars[np.isin(fleet.cars["slot"], self.slots)]
            for column, hour in enumerate(self.hours):
                time = fleet.begin + (hour + 1) * HOUR_S - self._window.start_s
                stands = (cars["ended_at"] <= time) & (time < cars["ended_at"] + cars["stay_s"])
                there = np.bincount(cars["slot"][stands], minlength=self.slots.max() + 1)
                total[:, column] += there[self.slots]
        return total / len(days)


def _report(town: _Town, forecast: FloatArray, found: list[_RollOut], title: str, folder: Path) -> Found:
    """Compare what was predicted with the counts; write the table of it and the picture."""
    counts, capacity = town.counts, town.capacity
    days, *arrays = (np.concatenate([one[k] for one in found], axis=min(k - 1, 1)) for k in range(1, 6))
    simulated, followed, fit, demand = arrays
    _, counted_cars = town.cars(counts.occupied, days)
    cars = {
        "counted": counted_cars,
        "simulated": simulated.transpose(1, 0, 2),
        "forecast": town.cars(forecast, days)[1],
        "last_week": town.cars(last_week(counts), days)[1],
        "mean_followed": followed.transpose(1, 0, 2),
    }
    shares = {name: its.transpose(1, 0, 2) / capacity[:, None, None] for name, its in cars.items()}
    # All are compared where all are known: (n, d, n_hours).
    known = np.all([np.isfinite(its) for its in shares.values()], axis=0)
    if not known.any():
        raise InputError(
            f"{counts.source}: no car park is counted both on days followed and on days held out"
        )
    dates, clock = [counts.days[day].isoformat() for day in days.tolist()], town.hours.tolist()
    labels = [
        [names[k] for k in index]
        for names, index in zip((town.names, dates, clock), np.nonzero(known), strict=True)
    ]
    table = csv_columns([*labels, *(shares[name][known].round(4).tolist() for name in _COLUMNS[3:])])
    with atomic_write(folder / "predicted.csv") as beside:
        beside.write_text(f"{','.join(_COLUMNS)}\n{table}", encoding="utf-8")
    errors = {name: np.where(known, np.abs(shares[name] - shares["counted"]), np.nan) for name in PREDICTIONS}
    errors["fit"] = np.where(known, np.abs(fit - followed) / capacity[:, None, None], np.nan)
    weeks = np.unique((days - days[0]) // 7, return_inverse=True)[1]
    rows: list[Row] = []
    used = np.flatnonzero(known.any(axis=(1, 2)))
    come, stay_h = (np.array([np.nanmean(demand[k, :, column]) for k in used]) for column in (0, 1))
    for row, number in enumerate(used.tolist()):
        rows.append({
            "car_park": town.names[number],
            "capacity": int(capacity[number]),
            "arrivals_a_day": float(come[row]),
            "stay_h": float(stay_h[row]),
            "map_weight": float(town.map_weight[number]),
            "days_held_out": int(known[number].any(axis=1).sum()),
            **_errors({name: error[[number]] for name, error in errors.items()}, weeks),
        })  # fmt: skip
    last = np.isin(days, found[-1].days) & np.isin(counts.weekday[days], counts.weekday[found[-1].days[0]])
    shown = zip(town.names, capacity, np.nanmean(simulated[:, last], axis=1), followed[:, last][:, 0],
                cars["counted"][last].transpose(1, 0, 2), strict=True)  # fmt: skip
    save_counted_demand(
        [CarParkDays(*its) for its in shown], town.hours.astype(np.float64) + 1.0, folder / "demand.png"
    )
    rank = float(spearmanr(town.map_weight[used], come).statistic) if len(used) > 2 else None
    more = {"map_rank_correlation": rank, "not_in_lot": town.others}
    what = (
        f"{plural(len(rows), 'car park')}, {plural(len(days), 'day')} held out, {come.sum():,.0f} cars a day"
    )
    return Found(f"{title}: {what}", {"rows": rows, **_errors(errors, weeks), **more})


def _errors(errors: Mapping[str, FloatArray], weeks: IntArray) -> Row:
    """Return mean errors, (n, d, n_hours) each, with intervals over weeks, (d,): the mean of the car parks of each."""
    row: Row = {}
    for name, error in errors.items():
        by_week = (error[:, weeks == week] for week in range(int(weeks.max()) + 1))
        means = [[np.nanmean(its) for its in one if np.isfinite(its).any()] for one in by_week]
        row |= columns_of(f"{name}_error", mean_interval([np.mean(its) for its in means if its]))
    return row
