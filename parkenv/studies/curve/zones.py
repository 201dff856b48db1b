"""Per-zone measures of a simulated day: the searches of the cars that go there, and how full it is around.

A *zone* is a goal of the lot, and the spaces within a walk of it. Zones may have spaces in common.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.engine.fleet import Fleet
from parkenv.studies.fleet.day import Day
from parkenv.world.occupancy.process import Arrival
from parkenv.world.scenario import Scenario
from parkenv.world.week import HOUR_S
from planners.heuristics.streets import PRIOR_PSEUDO_COUNT, streets_of

# What a second of arrival cost and one of the drive count for drivers that expect nothing of places.
RULES = {"greedy-drive": (0.0, 1.0), "greedy-goal": (1.0, 1e-6), "greedy-total": (1.0, 3.0)}
_ENOUGH = 0.01  # chance that nothing was found yet below which a search is not followed any more


class Places(NamedTuple):  # with a row for each entry or goal; places of a zone fill alike
    entry_drive_s: FloatArray  # (n_entries, k)
    drive_s: FloatArray  # (k, k), from the beginning of a place through it to that of another
    walk_s: FloatArray  # (n_goals, k)
    enter_s: FloatArray  # (k,) time inside that drivers expect
    size: IntArray  # (k,) slots
    zone: IntArray  # (k,)


class Hours(NamedTuple):
    believed: FloatArray  # P(taken) that drivers expect of a slot
    full: FloatArray  # chance that there is no space
    inside_s: FloatArray  # time at the barrier and inside


class LoneSearches:
    """Searches of one driver more in the days of the scenarios of a fleet, one for each goal; no number is fitted.

    The driver goes to the place that is cheapest by its rule, through it if it has no space, and on from there to the
    next. A *place* is a run of slots on one side of a street, between two junctions and in one zone, or a counted
    facility. Rules are those of `planners.heuristics`: `usual` (and any other agent) weighs the arrival cost against
    the drive over the chance that it expects of a space; where places were full, others of their kind promise less.
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

        All cars have the rule of the fleet's first drivers. `taken` are numbers of cars in each slot, (k, n_slots), at
        the samples, of which `sampled` (k,) are the hours; `which` (n_cars,) chooses the n cars, and `hour` (n,) is
        that of their arrival.
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

    The cars are of the dtype CAR, `entry` (n,) are rows of `places.entry_drive_s`, `hour` (n,) of `hours`,
    `zone_cost_s` is (n, n_zones). `weights` are what a second of arrival cost and one of the drive count for the cars.

    Returns (4, n): chance to park; places without a space on the way; search time beyond the direct drive, and walk, s,
    both times the chance.
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


INDEX = ("zone", "purpose", "hour")
# Sums over the cars that arrive in an hour, by zone, purpose and hour.
OF_CARS = ("cars", "parked", "failed", "search_s", "walk_s")
# The same as lone searches have them; see `LoneSearches`.
LONE = tuple(f"lone_{name}" for name in OF_CARS[1:])
SUMS = (*OF_CARS, *LONE)
# Share of the spaces around that is taken, and cars that arrive in an hour for each, by zone and hour; and of all
# spaces of the lot, by hour.
STATE = ("occupancy", "demand", "town_occupancy", "town_demand")


class Zones(NamedTuple):
    names: tuple[str, ...]  # index of the goal of each
    xy: FloatArray  # (n, 2) m, the goals
    near: FloatArray  # (n, n_slots) 1 for slots within reach on foot; of a zone without any, for the nearest
    neighbors: FloatArray  # (n, n) 1 for zones whose goals are within reach
    spaces: FloatArray  # (n, 2) how many cars fit into them, in drawn slots and in counted facilities
    own: IntArray  # (n, 2) the same of the slots to which no zone is nearer
    streets_s: float  # time to drive along all streets around a zone once, in the mean over zones, s

    @classmethod
    def of(cls, scenarios: Sequence[Scenario], reach_m: float) -> Self:
        lot, goals = scenarios[0].lot, [scenario.goal for scenario in scenarios]
        walk_m, xy = np.array([lot.walk_m(goal) for goal in goals]), np.array(lot.goals, float)[goals]
        near = (walk_m <= np.maximum(reach_m, walk_m.min(axis=1, keepdims=True))).astype(float)
        neighbors = (np.linalg.norm(xy[:, None] - xy, axis=2) <= reach_m).astype(float)
        kinds = np.stack([lot.capacity * ~lot.is_counted, lot.capacity * lot.is_counted], axis=1)
        own = np.zeros((len(xy), 2), np.int64)
        np.add.at(own, walk_m.argmin(axis=0), kinds)
        edge_m = np.where(lot.neighbors >= 0, lot.edge_length / lot.edge_speed, 0.0)
        around = np.linalg.norm(xy[:, None] - lot.vertex_xy, axis=2) <= reach_m
        streets_s = float((around @ edge_m.sum(axis=1)).mean()) / scenarios[0].v_drive or 1.0
        return cls(tuple(map(str, goals)), xy, near, neighbors, near @ kinds, own, streets_s)


def day_of_zones(day: Day, zones: Zones, lone: LoneSearches) -> dict[str, Any]:
    """Return the row of a day in `ZONES`, without setting and day.

    The search time of a car is its time from the entry to its space beyond the direct drive there.
    """
    names, purpose = day.purposes
    fleet, taken, arrives = day.fleet, day.taken, day.fleet.cars["parked_at"] < 0
    cars, sampled = fleet.cars[arrives], day.hour_of(day.times)
    first, sampled = sampled[0], sampled - sampled[0]
    n_samples = np.bincount(sampled)
    hour = np.minimum(day.hour_of(cars["arrival"]) - first, len(n_samples) - 1)
    shape = len(zones.names), len(names), len(n_samples)
    flat = np.ravel_multi_index((cars["scenario_index"], purpose[arrives], hour), shape)
    parked = cars["slot"] >= 0
    search_s = np.maximum(cars["ended_at"] - cars["arrival"] - day.roads.direct_s(cars), 0.0)
    values = (
        np.ones(len(cars)), parked, cars["failed_parks"], search_s * parked, cars["walk_s"] * parked,
        *lone.of_day(fleet, taken, sampled, arrives, hour),
    )  # fmt: skip
    sums = [np.bincount(flat, weights, np.prod(shape)).reshape(shape) for weights in values]
    index, arrived = np.nonzero(sums[0]), sums[0].sum(axis=1)
    there = np.array([taken[sampled == k].mean(axis=0) for k in range(len(n_samples))]).T
    spaces, all_spaces = zones.spaces.sum(axis=1, keepdims=True), fleet.scenario.lot.capacity.sum()
    # The last hour may be a part of one.
    hours = n_samples * (day.times[1] - day.times[0] if len(day.times) > 1 else HOUR_S) / HOUR_S
    state = (
        zones.near @ there / spaces, zones.neighbors @ arrived / spaces / hours, there.sum(axis=0) / all_spaces,
        arrived.sum(axis=0) / all_spaces / hours,
    )  # fmt: skip
    return (
        {name: numbers.tolist() for name, numbers in zip(INDEX, index, strict=True)}
        | {name: total[index].round(2).tolist() for name, total in zip(SUMS, sums, strict=True)}
        | {name: shares.round(4).tolist() for name, shares in zip(STATE, state, strict=True)}
    )
