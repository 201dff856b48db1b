"""A town whose car parks were counted, and the demand that follows the counts."""

from collections.abc import Mapping
from datetime import date

import numpy as np

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.errors import require
from parkenv.forecast.comparison import last_week
from parkenv.forecast.counts import Counts
from parkenv.scenarios.build import build, demand_of
from parkenv.scenarios.spec import PurposeSpec, ScenarioSpec
from parkenv.studies.fields import AgentSpec
from parkenv.studies.fleet.drivers import compiled_policy_of
from parkenv.studies.results import Row, without_nan
from parkenv.world.arrivals import STAYS_H, follow_counts, hours_between
from parkenv.world.demand import weights_of_all
from parkenv.world.scenario import drive_times
from parkenv.world.week import DAY_HOURS, HOUR_S

PATIENCE_S = 3600.0  # drivers come from far, and where a car park is full another one may be far, too
_STEP = 0.7  # share of what is off that a round corrects
_NEARLY_ALL = 0.95  # of the cars with a goal
_COUNTED_HOURS = 0.5  # of the hours, in which a car park that is followed has to be counted


class CountedTown:
    def __init__(self, spec: ScenarioSpec, counts: Counts, agent: AgentSpec) -> None:
        self.scenario = build(spec.changed(demand={}))
        self.spec, self.policy = spec, compiled_policy_of(agent, self.scenario)
        self._fleet: Fleet | None = None
        lot, window = self.scenario.lot, self.scenario.arrival
        require(
            not (window.start_s % HOUR_S or window.end_s % HOUR_S or window.end_s <= window.start_s),
            "arrivals.hours are not full hours, want those that counts are made in",
        )
        slots = {lot.slot_ids[slot]: slot for slot in np.flatnonzero(lot.is_counted).tolist()}
        self.names = [name for name in counts.car_parks if name in slots]
        self.others = [name for name in counts.car_parks if name not in slots]
        require(
            self.names,
            f"{counts.source}: none of its car parks is a counted facility of lot {lot.name!r}; want names of "
            f"{', '.join(slots) or 'such ones'}",
        )
        self.slots: IntArray = np.array([slots[name] for name in self.names])
        self.capacity = lot.capacity[self.slots].astype(np.float64)
        self.hours = (hours_between(window.start_s, window.end_s)[:-1] // HOUR_S).astype(np.int64)
        self.counts, self._window = counts.chosen(self.names), window
        self._last_week = last_week(self.counts)
        self.map_weight, self._goals = self._attraction()

    def _attraction(self) -> tuple[FloatArray, FloatArray]:
        """Return the weight of the goals nearest to each car park, (n,), and weights of its own goals, (n, g)."""
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
        # Of its own goals nearly all cars, or as many as of any goal, would park there if nothing was full.
        chosen = share >= np.minimum(share.max(axis=1, keepdims=True), _NEARLY_ALL)
        own = np.where(chosen, np.maximum(weight, 1e-9), 0.0)
        unchosen = share.max(axis=1) == 0.0
        own[unchosen] = 0.0
        own[unchosen, walk_m.argmin(axis=0)[unchosen]] = 1.0
        return near, own

    def days_of(self, first: date, end: date) -> IntArray:
        days = np.arange(self.counts.day_index(first), self.counts.day_index(end))
        return days[np.isin(self.counts.weekday[days], self._window.weekdays)]

    def cars(self, occupied: FloatArray, days: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the cars at the beginning of the window, (d, n), and at the end of its hours, (d, n, n_hours)."""
        start = int(self.hours[0])
        cars = occupied * self.capacity[:, None, None]
        before = cars[:, days, start - 1] if start else cars[:, np.maximum(days - 1, 0), DAY_HOURS - 1]
        return before.T, cars[:, days][:, :, self.hours].transpose(1, 0, 2)

    def expected(self, forecast: FloatArray, days: IntArray) -> tuple[FloatArray, FloatArray]:
        before, hours = self.cars(forecast, days)
        if not self.hours[0]:  # what was counted at midnight is known by then
            known, _ = self.cars(self.counts.seen, days)
            before = np.where(np.isfinite(known), known, before)
        return before, hours

    def mean(self, cars: FloatArray) -> FloatArray:
        known = np.isfinite(cars)
        mean: FloatArray = np.nansum(cars, axis=0) / np.maximum(known.sum(axis=0), 1)
        mean[~known.any(axis=0)] = np.nan
        if mean.ndim == 2:
            mean[np.isfinite(mean).mean(axis=1) < _COUNTED_HOURS] = np.nan
        return mean

    def purposes(
        self, at_first: FloatArray, cars: FloatArray, stays_h: Mapping[str, tuple[float, ...]]
    ) -> dict[str, PurposeSpec]:
        specs = {}
        for name, goals, first, counted_cars in zip(self.names, self._goals, at_first, cars, strict=True):
            if not np.isfinite(counted_cars).any():
                continue
            start = first if np.isfinite(first) else counted_cars[np.isfinite(counted_cars)][0]
            window = self._window.start_s, self._window.end_s
            followed = follow_counts(start, counted_cars, *window, stays_h.get(name, STAYS_H))
            rates = np.zeros(DAY_HOURS)
            rates[self.hours] = followed.per_hour
            specs[name] = PurposeSpec(
                arrivals_per_hour=tuple(np.round(rates, 3).tolist()),
                stay_s=followed.stay.mean_s,
                stay_law="log-normal",
                stay_cv=followed.stay.cv,
                parked=round(start),
                patience_s=PATIENCE_S,
                goals=tuple(goals.tolist()),
            )
        return specs

    def fitted(self, days: IntArray, rounds: int, episodes: int, seed: int) -> dict[str, Row]:
        """Fit a purpose for each car park to the mean of its counts on some days, (d,); the fleet drives for it.

        What car parks lack or have too much is added to what the next round follows. Of each car park that was counted
        there are the table of its `purpose`, and cars at the ends of the hours: `followed`, as counted; `driven`, of
        the last round; `aim`, what a further round would follow.
        """
        at_first, cars = (self.mean(values) for values in self.cars(self.counts.occupied, days))
        if not np.isfinite(cars).any():
            return {}
        aim, stays_h, purposes = cars, dict[str, tuple[float, ...]](), dict[str, PurposeSpec]()
        for number in range(rounds):
            purposes = self.purposes(at_first, aim, stays_h)
            stays_h = {name: (purpose.stay_s / HOUR_S,) for name, purpose in purposes.items()}
            driven = self.driven(purposes, seed, range(number * episodes, (number + 1) * episodes))
            aim = np.maximum(aim + _STEP * (cars - driven), 0.0)
        columns = {"followed": cars, "driven": driven, "aim": aim}
        return {
            name: {"purpose": purposes[name].tables()}
            | {column: without_nan(cars_of[k].tolist()) for column, cars_of in columns.items()}
            for k, name in enumerate(self.names)
            if name in purposes
        }

    def predicted(
        self,
        day: int,
        fit: Mapping[str, Row],
        before: FloatArray,
        expected: FloatArray,
        episodes: int,
        seed: int,
    ) -> Row:
        """Drive a day with the demand that its forecast tells: the mean of some days of the fleet.

        Cars there when the day begins, `before`, are (n,), those by the forecast before it, `expected`, (n, n_hours).
        Stays and corrections are those of the `fit` of the weeks before. Columns have a line for each car park and hour
        where all are known: shares of the places at the end of the hour, `counted`, and as it was to be expected.
        """
        aim, followed, simulated = np.full((3, *expected.shape), np.nan)
        known = [k for k, name in enumerate(self.names) if name in fit]
        for k in known:
            aim[k], followed[k] = fit[self.names[k]]["aim"], fit[self.names[k]]["followed"]
        stays_h = {name: (row["purpose"]["stay_s"] / HOUR_S,) for name, row in fit.items()}
        purposes = self.purposes(before, np.maximum(expected + aim - followed, 0.0), stays_h)
        if known:
            simulated[known] = self.driven(purposes, seed, range(day * episodes, (day + 1) * episodes))[known]
        only = np.array([day])
        cars = {
            "counted": self.cars(self.counts.occupied, only)[1][0],
            "simulated": simulated,
            "forecast": expected,
            "last_week": self.cars(self._last_week, only)[1][0],
            "mean_followed": followed,
        }
        shares = {name: number / self.capacity[:, None] for name, number in cars.items()}
        all_known = np.isfinite([*shares.values()]).all(axis=0)
        numbers, hours = np.nonzero(all_known)
        return {
            "car_park": [self.names[k] for k in numbers],
            "hour": self.hours[hours].tolist(),
            **{name: share[all_known].round(4).tolist() for name, share in shares.items()},
        }

    def driven(self, purposes: Mapping[str, PurposeSpec], seed: int, days: range) -> FloatArray:
        scenario = self.scenario
        demand = demand_of({**self.spec.demand, **purposes}, scenario.lot, scenario.arrival)
        if self._fleet is None:
            driver = DriverKind(policy=self.policy)
            self._fleet = Fleet(scenario, demand, drivers=[driver], background="none", leave_full_lot=False)
        fleet = self._fleet
        fleet.demand = demand or fleet.demand
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
