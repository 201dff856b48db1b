"""The search of one driver more, from how full each street and garage is: a model without any fitted number.

The driver goes to the place that is cheapest by its rule, through it if it has no space, and on from there to the next.
A *place* is a run of slots on one side of a street, between two junctions and in one zone, or a counted facility. Each
has a space as often as it had one in that hour of the day, whatever others had.

Rules are those of `planners.heuristics`, over places: `usual` (and any other agent) weighs the arrival cost against the
drive over the chance that it expects of a space; where places were full, others of their kind promise less.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.engine.fleet import Fleet
from parkenv.world.occupancy.process import Arrival
from parkenv.world.scenario import Scenario
from parkenv.world.week import HOUR_S
from planners.heuristics.streets import PRIOR_PSEUDO_COUNT, streets_of

RULES = {"greedy-drive": (0.0, 1.0), "greedy-goal": (1.0, 1e-6), "greedy-total": (1.0, 3.0)}
"""What a second of arrival cost and one of the drive count for drivers that expect nothing of places."""
_ENOUGH = 0.01  # chance that nothing was found yet below which a search is not followed any more


class Places(NamedTuple):
    """The places of a lot: columns of tables, with a row for each entry or goal; places of a zone fill alike."""

    entry_drive_s: FloatArray  # (n_entries, k)
    drive_s: FloatArray  # (k, k), from the beginning of a place through it to that of another
    walk_s: FloatArray  # (n_goals, k)
    enter_s: FloatArray  # (k,) time inside that drivers expect
    size: IntArray  # (k,) slots
    zone: IntArray  # (k,)


class Hours(NamedTuple):
    """States of places in each hour of a day, (n_hours, k)."""

    believed: FloatArray  # P(taken) that drivers expect of a slot
    full: FloatArray  # chance that there is no space
    inside_s: FloatArray  # time at the barrier and inside


class LoneSearches:
    """Searches of one driver more in the days of a scenario.

    Args:
        scenarios: those of a fleet, one for each goal.
    """

    def __init__(self, scenarios: Sequence[Scenario]) -> None:
        problem, lot = scenarios[0], scenarios[0].lot
        streets = streets_of(lot, np.asarray(problem.move_cost_s))
        begin, end = streets["place_first"][:-1], streets["place_first"][1:] - 1
        self._slots, self._begin, size = streets["slots"], begin, (end - begin + 1).astype(np.int64)
        first, last, zone = self._slots[begin], self._slots[end], lot.zone_of_slot[self._slots[begin]]
        self._capacity, self._entries = lot.capacity, np.unique(lot.entry_vertices)
        drives = lot.drive_matrix(timed=True)
        entry_drive_s, drive_s = (
            dijkstra(drives, indices=vertices)[:, first] / problem.v_drive
            for vertices in (self._entries, last)
        )
        drive_s += (streets["along_s"][end] - streets["along_s"][begin])[:, None]
        self._inside_s = np.zeros((2, len(first)))
        for place in np.flatnonzero(lot.is_counted[first]):
            facility = lot.facilities[lot.facility_of_slot[first[place]]]
            self._inside_s[:, place] = np.add(facility.gate_s, facility.inside_s)
        self._size = size
        walk_s = self._mean(np.array([scenario.walk_s for scenario in scenarios]))
        self._places = Places(entry_drive_s, drive_s, walk_s, self._mean(problem.enter_s), size, zone)

    def _mean(self, of_slots: FloatArray) -> FloatArray:
        return np.asarray(np.add.reduceat(of_slots[..., self._slots], self._begin, axis=-1) / self._size)

    def of_day(
        self, fleet: Fleet, taken: IntArray, sampled: IntArray, which: BoolArray, hour: IntArray
    ) -> FloatArray:
        """Return measures of lone searches of cars of a day, (4, n); see `simulate_single_driver`.

        Args:
            fleet: the fleet; all cars have the rule of its first kind of drivers.
            taken: (k, n_slots) numbers of cars in each slot at each sample.
            sampled: (k,) hours of the day's samples, from 0.
            which: (n_cars,) the cars, n of them.
            hour: (n,) the hours in which they arrive.
        """
        rule, cars = fleet.drivers[0].policy, fleet.cars[which]
        weights = RULES.get("" if rule is None else rule.name)
        no_space = np.logical_and.reduceat((taken >= self._capacity)[:, self._slots], self._begin, axis=1)
        full, filled, believed = np.zeros((3, int(sampled[-1]) + 1, len(self._size)))
        for k in range(len(full)):
            full[k] = no_space[sampled == k].mean(axis=0)
            filled[k] = self._mean(taken[sampled == k].mean(axis=0) / self._capacity)
            if weights is None:
                middle = fleet.begin // HOUR_S * HOUR_S + (k + 0.5) * HOUR_S
                forecast = fleet.scenario.occupancy.forecast(Arrival(middle, fleet.day.date))
                believed[k] = self._mean(np.asarray(forecast.p_occupied))
        empty_s, full_s = self._inside_s
        hours = Hours(believed, full, empty_s + filled * (full_s - empty_s))
        entry, zone_cost_s = np.searchsorted(self._entries, cars["entry"]), fleet.drawn.zone_costs()[which]
        of_cars = cars, entry, hour, zone_cost_s, weights or (1.0, 1.0)
        return np.asarray(simulate_single_driver(*of_cars, hours, self._places))


@compiled(error_model="numpy")
def simulate_single_driver(
    cars: NDArray[np.void], entry: IntArray, hour: IntArray, zone_cost_s: FloatArray, weights: tuple[float, float],
    hours: Hours, places: Places,
) -> FloatArray:  # fmt: skip
    """Follow the searches of n cars from place to place, in all ways that they may go.

    Args:
        cars: (n,) of the dtype CAR.
        entry: (n,) rows of `places.entry_drive_s`.
        hour: (n,) rows of `hours`.
        zone_cost_s: (n, n_zones) s.
        weights: what a second of arrival cost and one of the drive count for the cars.
        hours: states of places.
        places: the places.

    Returns:
        (4, n) chance to park; places without a space on the way; search time beyond the direct drive, and walk, s, both
        times the chance.
    """
    size, zone, (per_cost, per_drive) = places.size, places.zone, weights
    sums = np.zeros((4, len(cars)))
    cost_s, expected_free = np.empty(len(size)), np.empty(zone.max() + 1)
    for car in range(len(cars)):
        now, walk_s, walks = hour[car], places.walk_s[cars[car].scenario_index], cars[car].walks
        p, full_now, direct_s = hours.believed[now], hours.full[now], places.entry_drive_s[entry[car]]
        for k in range(len(size)):
            cost = walk_s[k] * walks + zone_cost_s[car, zone[k]] + places.enter_s[k]
            cost_s[k] = per_cost * cost if cost < np.inf else np.inf
        expected_free[:] = 0.0
        ahead_s, driven_s, left = direct_s, 0.0, 1.0
        while left > _ENOUGH and driven_s <= cars[car].patience_s:
            best, best_s = -1, np.inf
            for k in range(len(size)):
                index_s = cost_s[k] + per_drive * ahead_s[k]
                if index_s < best_s:
                    odds = (1.0 - p[k]) * PRIOR_PSEUDO_COUNT / (PRIOR_PSEUDO_COUNT + expected_free[zone[k]])
                    chance = 1.0 - (p[k] / (p[k] + odds)) ** size[k]
                    index_s = cost_s[k] + per_drive * ahead_s[k] / chance
                    if index_s < best_s:
                        best, best_s = k, index_s
            if best < 0:
                break
            driven_s += ahead_s[best]
            here = left * (1.0 - full_now[best])
            left -= here
            sums[0, car] += here
            sums[1, car] += left
            sums[2, car] += here * (max(driven_s - direct_s[best], 0.0) + hours.inside_s[now, best])
            sums[3, car] += here * walk_s[best] * walks
            expected_free[zone[best]] += size[best] * (1.0 - p[best])
            cost_s[best] = np.inf
            ahead_s = places.drive_s[best]
    return sums
