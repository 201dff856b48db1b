"""Demand of a town that fills its car parks as counted: fitted on some weeks, and measured on the weeks after."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import date, timedelta
from pathlib import Path
from typing import NamedTuple

import numpy as np

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.errors import InputError
from parkenv.forecast.counts import Counts
from parkenv.scenarios.build import build
from parkenv.scenarios.purposes import PurposeSpec
from parkenv.scenarios.spec import ScenarioSpec
from parkenv.show.figures.counted_demand import CarParkDays, save_counted_demand
from parkenv.show.plurals import plural
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.fleet.drivers import compiled_policy_of
from parkenv.studies.occupancy import Found
from parkenv.studies.results import Row
from parkenv.studies.study import Progress
from parkenv.world.counted_demand import STAYS_H, follow_counts
from parkenv.world.demand import hours_between
from parkenv.world.scenario import Scenario
from parkenv.world.week import DAY_HOURS, HOUR_S

SCENARIO_FILE = "scenario.json"
PATIENCE_S = 3600.0
"""Drivers come from far, and where a car park is full another one may be far, too."""
_STEP = 0.7  # share of what is off that a round corrects


class Weeks(NamedTuple):
    """Days that are followed, and later ones that are held out."""

    first: date
    followed: int
    held_out: int


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
    progress: Progress = lambda *_: None,
) -> Found:
    """Fit a purpose for each counted car park of a lot that has counts; write the scenario and a picture.

    The cars of a purpose have the goal nearest to the car park, and its counts tell when they come and how many are
    there at first (`parkenv.world.counted_demand`). Where they park is up to them; so the fleet is driven, and what a
    car park lacks or has too much is added to what the next round follows.

    Args:
        spec: lot, costs, days and hours, and the purposes of other cars.
        counts: counts of car parks; those that are named as counted facilities of the lot are used.
        folder: where the files go.
        weeks: days that are followed, of the scenario's weekdays, and later ones that the demand is measured on.
        agent: drives all cars.
        rounds: how often the fleet is driven.
        days: days of the fleet of each round.
        seed: seed of the days.
        progress: called as rounds end.

    Raises:
        InputError: no counted facility of the lot has counts on these days, or the hours are not full ones.
    """
    scenario = build(spec.changed(demand={}))
    car_parks = _CarParks(scenario, counts)
    at_first, counted = car_parks.mean_of(weeks.first, weeks.followed)
    target = counted
    policy = compiled_policy_of(agent, scenario)
    stays_h: dict[str, tuple[float, ...]] = {}
    for number in range(rounds):
        fitted = car_parks.purposes(at_first, target, stays_h)
        stays_h = {name: (its.stay_s / HOUR_S,) for name, its in fitted.items()}
        made = spec.changed(demand={**spec.demand, **fitted})
        town = build(made)
        fleet = Fleet(town, town.demand, drivers=[DriverKind(policy=policy)], leave_full_lot=False)
        simulated = car_parks.driven(fleet, seed, days)
        target = np.maximum(target + _STEP * (counted - simulated), 0.0)
        progress("Rounds", number + 1, rounds)
    made.write(folder / SCENARIO_FILE)
    later = car_parks.days_of(weeks.first + timedelta(weeks=weeks.followed), weeks.held_out)
    rows = [
        car_parks.row(number, fitted, simulated[number], counted[number], later[number])
        for number in range(len(car_parks.names))
    ]
    shown = [
        CarParkDays(name, capacity, its, mean, days)
        for name, capacity, its, mean, days in zip(
            car_parks.names, car_parks.capacity, simulated, counted, later, strict=True
        )
    ]
    save_counted_demand(shown, car_parks.hours.astype(np.float64) + 1.0, folder / "demand.png")
    means = {
        name: float(np.nanmean([row[name] for row in rows]))
        for name in ("fit_error", "held_out_error", "held_out_profile_error")
    }
    cars = sum(row["arrivals_a_day"] for row in rows)
    title = f"{spec.title}: {plural(len(rows), 'car park')}, {cars:,.0f} cars a day"
    return Found(title, {"rows": rows, **means, "not_in_lot": car_parks.others})


class _CarParks:
    """The counted facilities of a lot that have counts, and their days."""

    def __init__(self, scenario: Scenario, counts: Counts) -> None:
        lot, window = scenario.lot, scenario.arrival
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
        self._before = (self.hours[0] - 1) % DAY_HOURS
        self._counts, self._window = counts.chosen(self.names), window
        # The goal nearest to each car park.
        self._goals = np.argmin([lot.walk_m(goal)[self.slots] for goal in range(len(lot.goals))], axis=0)
        self._n_goals = len(lot.goals)

    def days_of(self, first: date, weeks: int, hours: IntArray | None = None) -> FloatArray:
        """Return the cars at the end of each hour on the scenario's weekdays, (n, d, n_hours); NaN: not counted.

        Hours are those of the window by default.
        """
        hours = self.hours if hours is None else hours
        counts = self._counts
        begin, end = counts.day_index(first), counts.day_index(first + timedelta(weeks=weeks))
        days = np.arange(begin, end)
        days = days[np.isin(counts.weekday[days], self._window.weekdays)]
        return counts.occupied[:, days][:, :, hours] * self.capacity[:, None, None]

    def mean_of(self, first: date, weeks: int) -> tuple[FloatArray, FloatArray]:
        """Return the mean cars at the beginning of the window, (n,), and at the end of each hour, (n, n_hours).

        At midnight these are those at the end of the same days.
        """
        days = self.days_of(first, weeks, np.concatenate([[self._before], self.hours]))
        silent: BoolArray = np.isfinite(days).any(axis=1).min(axis=1) == 0
        if silent.any():
            names = ", ".join(name for name, its in zip(self.names, silent, strict=True) if its)
            raise InputError(
                f"{self._counts.source}: {names} was not counted in all hours from {first} on for "
                f"{plural(weeks, 'week')}; leave it out, or set --from"
            )
        mean = np.nanmean(days, axis=1)
        return mean[:, 0], mean[:, 1:]

    def purposes(
        self, at_first: FloatArray, cars: FloatArray, stays_h: Mapping[str, tuple[float, ...]]
    ) -> dict[str, PurposeSpec]:
        """Return a purpose for each car park, with which it would have so many cars at the ends of the hours.

        Mean stays are those given, h, or else chosen.
        """
        made = {}
        for name, goal, first, counted in zip(self.names, self._goals.tolist(), at_first, cars, strict=True):
            window = self._window.start_s, self._window.end_s
            found = follow_counts(first, counted, *window, stays_h.get(name, STAYS_H))
            rates = np.zeros(DAY_HOURS)
            rates[self.hours] = found.per_hour
            made[name] = PurposeSpec(
                arrivals_per_hour=tuple(np.round(rates, 3).tolist()),
                stay_s=found.stay.mean_s,
                stay_law="log-normal",
                stay_cv=found.stay.cv,
                parked=round(first),
                patience_s=PATIENCE_S,
                goals=tuple(float(goal == one) for one in range(self._n_goals)),
            )
        return made

    def driven(self, fleet: Fleet, seed: int, days: int) -> FloatArray:
        """Return the mean cars in the car parks at the end of each hour of days of a fleet, (n, n_hours)."""
        total = np.zeros((len(self.names), len(self.hours)))
        for day in range(days):
            fleet.reset(seed, day)
            fleet.run()
            cars = fleet.cars[np.isin(fleet.cars["slot"], self.slots)]
            for column, hour in enumerate(self.hours):
                time = fleet.begin + (hour + 1) * HOUR_S - self._window.start_s
                stands = (cars["ended_at"] <= time) & (time < cars["ended_at"] + cars["stay_s"])
                total[:, column] += np.bincount(cars["slot"][stands], minlength=self.slots.max() + 1)[
                    self.slots
                ]
        return total / days

    def row(
        self,
        number: int,
        fitted: dict[str, PurposeSpec],
        simulated: FloatArray,
        counted: FloatArray,
        later: FloatArray,
    ) -> Row:
        """Return what was found of a car park; errors are mean absolute ones, shares of its places."""
        name, capacity = self.names[number], self.capacity[number]
        purpose = fitted[name]
        with np.errstate(invalid="ignore"):
            seen = np.isfinite(later)
            daily = np.abs(later - simulated)[seen]
            profile = np.abs(np.nansum(later, axis=0) / seen.sum(axis=0) - simulated)[seen.any(axis=0)]
        return {
            "car_park": name,
            "capacity": int(capacity),
            "arrivals_a_day": float(sum(purpose.arrivals_per_hour)),
            "parked_at_first": purpose.parked,
            "stay_h": purpose.stay_s / HOUR_S,
            "days_held_out": int(seen.any(axis=1).sum()),
            "fit_error": float(np.abs(simulated - counted).mean() / capacity),
            "held_out_error": float(daily.mean() / capacity) if daily.size else None,
            "held_out_profile_error": float(profile.mean() / capacity) if profile.size else None,
        }
