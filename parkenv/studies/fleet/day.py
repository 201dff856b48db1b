"""A simulated day with many cars: shortest drives, samples of the occupancy, metres in lanes, and measures."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.engine.fleet import Fleet
from parkenv.engine.records import SEARCHING, STEP
from parkenv.studies.fleet.clairvoyant_bound import ParkingDay, clairvoyant_bound_s
from parkenv.studies.fleet.setting import BY_HOUR
from parkenv.studies.results import Row
from parkenv.studies.statistics import mean_or_nan
from parkenv.world.cost_terms import COST_FIELDS
from parkenv.world.drive_graph import linestrings
from parkenv.world.scenario import Scenario, SearchProblem, drive_metres, zone_prices
from parkenv.world.tariff import NO_ZONE
from parkenv.world.week import DAY_S, HOUR_S

MOST_PAIRS = 5_000_000  # pairs of a car and a slot up to which a day has a clairvoyant bound


class Roads:
    def __init__(self, problem: SearchProblem) -> None:
        lot = problem.lot
        entries = np.unique(lot.entry_vertices)
        metres, timed = (drive_metres(lot, entries, timed=timed) for timed in (False, True))
        self._entries, self._metres, self._drive_s = entries, metres, timed / problem.v_drive
        self._problem, self._cost_s = problem, problem.walk_s + lot.slot_parking_cost_s
        # Mean drive from an entry to the slot nearest to it, m at the scenario's speed.
        self.first_slot_m = float(timed.min(axis=1).mean())

    def direct_m(self, cars: NDArray[np.void]) -> FloatArray:
        return self._direct(cars, self._metres)

    def direct_s(self, cars: NDArray[np.void]) -> FloatArray:
        return self._direct(cars, self._drive_s)

    def _direct(self, cars: NDArray[np.void], drives: FloatArray) -> FloatArray:
        rows = np.searchsorted(self._entries, cars["entry"])
        return np.where(cars["slot"] >= 0, drives[rows, cars["slot"]], 0.0)

    def cruised_m(self, cars: NDArray[np.void]) -> FloatArray:
        return np.maximum(cars["driven_m"] - self.direct_m(cars), 0.0)

    @cached_property
    def lane_of_edge(self) -> IntArray:
        lot = self._problem.lot
        middle = (lot.vertex_xy[:, None] + lot.vertex_xy[lot.neighbors]).reshape(-1, 2) / 2
        tree = shapely.STRtree(linestrings([lane.points for lane in lot.lanes]))
        edge, lane = tree.query_nearest(shapely.points(middle), all_matches=False)
        lanes = np.zeros(len(middle), np.int64)
        lanes[edge] = lane
        return lanes.reshape(lot.neighbors.shape)

    def alone_s(self, fleet: Fleet) -> FloatArray:
        """Return the total time of each car in an empty lot that it knows, (n,) s: no car can be faster."""
        cars, lot = fleet.cars, self._problem.lot
        rows, free_s = np.searchsorted(self._entries, cars["entry"]), np.zeros((len(cars), len(lot.zones)))
        for place, walks in sorted(
            {*zip(cars["scenario_index"].tolist(), cars["walks"].tolist(), strict=True)}
        ):
            alike = (cars["scenario_index"] == place) & (cars["walks"] == walks)
            cost_s = fleet.scenarios[place].walk_s * walks + lot.slot_parking_cost_s
            by_zone = [
                (self._drive_s[:, lot.zone_of_slot == zone] + cost_s[lot.zone_of_slot == zone]).min(axis=1)
                for zone in range(len(lot.zones))
            ]
            free_s[alike] = np.stack(by_zone, axis=1)[rows[alike]]
        least_s = (free_s + fleet.drawn.zone_costs()).min(axis=1)
        return np.where(np.isfinite(least_s), least_s, self._problem.give_up_s)

    def reach(self) -> dict[str, int]:
        capacity, can = self._problem.lot.capacity, np.isfinite(self._drive_s)
        return {"entries": len(can), "entries_cut_off": int((can @ capacity < 0.5 * capacity.sum()).sum())}

    def clairvoyant_s(self, fleet: Fleet) -> float:
        """Return the clairvoyant bound of the day of a fleet that has been reset, s, for all cars together.

        It is NaN where it would take longer than the day itself, and where it does not hold: with several goals,
        counted facilities, or cars that are parked at first.
        """
        lot = self._problem.lot
        is_single = len(fleet.scenarios) == 1 and (lot.capacity == 1).all()
        if (
            len(fleet.cars) * lot.n_slots > MOST_PAIRS
            or not is_single
            or (fleet.cars["parked_at"] >= 0).any()
        ):
            return float("nan")
        return clairvoyant_bound_s(self.parking_day(fleet))

    def parking_day(self, fleet: Fleet) -> ParkingDay:
        cars = fleet.cars
        arrival, stay_s, patience_s = (
            np.array(cars[name], np.float64) for name in ("arrival", "stay_s", "patience_s")
        )
        return ParkingDay(
            arrival,
            stay_s,
            patience_s,
            entry=np.searchsorted(self._entries, cars["entry"]).astype(np.int64),
            drive_s=self._drive_s,
            cost_s=np.asarray(self._cost_s, np.float64),
            free_from=np.where(fleet.taken(), fleet.slots["leaves_at"], -np.inf).astype(np.float64),
            zone=np.array(self._problem.lot.zone_of_slot),
            zone_cost_s=fleet.drawn.zone_costs(),
            give_up_s=float(self._problem.give_up_s),
        )


ALL = "all"  # stands for cars of every purpose
SAMPLE_S = 300.0  # time between two samples of the occupancy, s


class Day(NamedTuple):
    fleet: Fleet
    roads: Roads
    clairvoyant_s: float  # see `Roads.clairvoyant_s`
    times: FloatArray  # (k,) samples, s since Monday 00:00
    taken: IntArray  # (k, n_slots) numbers of cars in each slot then
    lanes: LaneCounts

    @property
    def purposes(self) -> tuple[tuple[str, ...], IntArray]:
        return purpose_names(self.fleet), np.array(self.fleet.cars["purpose"])

    def hour_of(self, time: FloatArray) -> IntArray:
        return hour_of(self.fleet, time)

    def paid(self) -> FloatArray:
        cars, scenario = self.fleet.cars, self.fleet.scenario
        zone = scenario.lot.zone_of_slot[cars["slot"]]
        amounts = zone_prices(scenario.zone_rules, self.fleet.drawn.drivers)[np.arange(len(cars)), zone]
        return np.where(cars["slot"] >= 0, amounts, 0.0)


def simulate(fleet: Fleet, agents: Sequence[Any], roads: Roads, seed: int, number: int) -> Day:
    fleet.reset(seed, number)
    clairvoyant_s, window = roads.clairvoyant_s(fleet), fleet.scenario.arrival
    times = fleet.begin + np.arange(0.0, window.end_s - window.start_s, SAMPLE_S)
    taken, lanes = [], LaneCounts(fleet, roads)
    for time in times:
        fleet.run(agents, until=float(time))
        taken.append(fleet.counts())
        lanes.update()
    fleet.run(agents)
    lanes.update()
    return Day(fleet, roads, clairvoyant_s, times, np.array(taken), lanes)


def purpose_names(fleet: Fleet) -> tuple[str, ...]:
    purposes = fleet.demand.purposes
    return (ALL,) if len(purposes) == 1 else tuple(purpose.name for purpose in purposes)


def hour_of(fleet: Fleet, time: FloatArray) -> IntArray:
    return np.asarray((time - fleet.begin // DAY_S * DAY_S) // HOUR_S, np.int64)


class LaneCounts:
    """Metres in each lane, (n_hours, n_lanes, 2) driven and cruised, and failed attempts, (k, 3) car, slot, hour.

    Metres beyond the shortest way to a car's slot count as cruising; for cars that give up, all metres do. They are
    driven at the end, so the detours in all lanes add up to those of all cars. Hours count from the first of the day.
    """

    def __init__(self, fleet: Fleet, roads: Roads) -> None:
        self._fleet, self._roads = fleet, roads
        self._open = np.zeros(0, STEP)
        self._direct_m, self._driven_m = np.full(len(fleet.cars), np.nan), np.zeros(len(fleet.cars))
        self.metres = np.zeros((0, len(fleet.scenario.lot.lanes), 2))
        self.refused = np.zeros((0, 3), np.int64)
        fleet.keep_steps()

    def update(self) -> None:
        fleet, lot = self._fleet, self._fleet.scenario.lot
        ended = np.flatnonzero((fleet.cars["state"] > SEARCHING) & np.isnan(self._direct_m))
        self._direct_m[ended] = self._roads.direct_m(fleet.cars[ended])
        first, last = hour_of(fleet, np.array([fleet.begin, fleet.time])).tolist()
        more = np.zeros((max(last + 1 - first - len(self.metres), 0), *self.metres.shape[1:]))
        self.metres = np.concatenate([self.metres, more])
        steps, since = np.concatenate([self._open, fleet.take_steps()]), fleet.begin // HOUR_S * HOUR_S
        graph = lot.neighbors, lot.edge_length, self._roads.lane_of_edge
        _add_metres(steps, since, *graph, self._direct_m, self._driven_m, self.metres)
        searches = np.isnan(self._direct_m[steps["car"]])
        failed = steps[steps["failed"] & ~searches]
        refused = [failed["car"], failed["vertex"], hour_of(fleet, failed["begin"])]
        self.refused = np.concatenate([self.refused, np.stack(refused, axis=1)])
        self._open = steps[searches]


@compiled(error_model="numpy")
def _add_metres(
    steps: NDArray[np.void],
    since: float,
    neighbors: NDArray[np.int32],
    edge_length: FloatArray,
    lane_of_edge: IntArray,
    direct_m: FloatArray,
    driven_m: FloatArray,
    metres: FloatArray,
) -> None:
    """Add the steps of cars whose shortest drive is known to `metres`, by hour and lane, and to `driven_m`, by car."""
    for step in steps:
        origin, car = step.origin, step.car
        if origin == step.vertex or np.isnan(direct_m[car]):
            continue
        for k in range(neighbors.shape[1]):
            if neighbors[origin, k] == step.vertex:
                length, hour = edge_length[origin, k], int((step.begin - since) // 3600.0)
                driven_m[car] += length
                lane = metres[hour, lane_of_edge[origin, k]]
                lane[0] += length
                lane[1] += min(max(driven_m[car] - direct_m[car], 0.0), length)
                break


def gini(values: FloatArray) -> float:
    """Return the Gini coefficient of values of at least 0: 0 if all are equal, near 1 if one has everything."""
    n, total = len(values), float(values.sum())
    if n == 0 or total == 0.0:
        return 0.0
    return float(2.0 * (np.arange(1, n + 1) * np.sort(values)).sum() / (n * total) - (n + 1.0) / n)


def day_measures(day: Day, counted: FloatArray) -> Row:
    arrives, lot = day.fleet.cars["parked_at"] < 0, day.fleet.scenario.lot
    cars, amounts = day.fleet.cars[arrives], day.paid()[arrives]
    times, parked, members = cars["total_s"], cars["slot"] >= 0, cars["kind"] == 0
    cruised_m, driven_m = day.roads.cruised_m(cars), float(cars["driven_m"].sum())
    taken, hours = (
        day.taken.sum(axis=1) / lot.capacity.sum(),
        np.flatnonzero(np.diff(day.times // HOUR_S)) + 1,
    )
    by_hour = [
        " ".join(f"{shares.mean():.4f}" for shares in np.split(occupied, hours))
        for occupied in (taken, counted)
    ]
    return {
        "cars": len(cars),
        "total_s": float(times.mean()),
        "median_s": float(np.median(times)),
        "p95_s": float(np.quantile(times, 0.95)),
        "gini": gini(times),
        "search_s": float((cars["ended_at"] - cars["arrival"]).mean()),
        "queued_s": float(cars["queued_s"].mean()),
        "failed_attempts": float(cars["failed_parks"].mean()),
        "driven_m": driven_m / len(cars),
        "cruised_m": float(cruised_m.mean()),
        "cruising_share": float(cruised_m.sum()) / driven_m if driven_m else 0.0,
        "balked_fraction": float((~parked).mean()),
        "occupancy": float(np.mean(taken)),
        "counted_occupancy": float(np.mean(counted)),
        **dict(zip(BY_HOUR, by_hour, strict=True)),
        "members_s": mean_or_nan(times[members]),
        "others_s": mean_or_nan(times[~members]),
        "bound_s": float(day.roads.alone_s(day.fleet)[arrives].mean()),
        "clairvoyant_s": day.clairvoyant_s / len(cars),
        **{name: float(cars[name].mean()) for name in COST_FIELDS},
        "paid": float(amounts.mean()),
        "paying_share": float((amounts > 0.0).mean()),
    }


def has_zones(scenario: Scenario) -> bool:
    return scenario.has_rules or scenario.lot.zones != (NO_ZONE,)


def car_lists(day: Day) -> dict[str, str]:
    fleet, arrives = day.fleet, day.fleet.cars["parked_at"] < 0
    cars, lot = fleet.cars[arrives], fleet.scenario.lot
    lists = {"total_cs": 100.0 * cars["total_s"], "member": cars["kind"] == 0}
    if has_zones(fleet.scenario):
        zone = np.where(cars["slot"] >= 0, 1 + lot.zone_of_slot[cars["slot"]], 0)
        lists |= {"zone": zone, "paid_cents": 100.0 * day.paid()[arrives]}
    if len(fleet.demand.purposes) > 1:
        lists["purpose"] = cars["purpose"]
    return {name: " ".join(map(str, np.rint(values).astype(int).tolist())) for name, values in lists.items()}


def random_order_search_s(problem: SearchProblem, occupancy: FloatArray) -> FloatArray:
    """Return the search time, s, of looking at slots in random order, (n + 1)/(m + 1) of them if m of n are free.

    A look takes the median drive from a slot to the next one; the drive from the entry to the first slot comes before.
    """
    lot, n = problem.lot, problem.lot.n_slots
    source, column = np.nonzero(lot.neighbors[:n] >= 0)
    to_slot = lot.neighbors[source, column] < n
    hop_s = float(np.median(problem.move_s[source[to_slot], column[to_slot]])) if to_slot.any() else 0.0
    first_s = Roads(problem).first_slot_m / problem.v_drive
    return np.asarray(first_s + hop_s * ((n + 1.0) / ((1.0 - occupancy) * n + 1.0) - 1.0))
