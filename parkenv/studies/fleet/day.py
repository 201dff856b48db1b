"""A simulated day with many cars."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.compiled.jit import compiled
from parkenv.engine.fleet import Fleet
from parkenv.engine.records import SEARCHING, STEP
from parkenv.studies.fleet.roads import Roads
from parkenv.world.week import DAY_S, HOUR_S

ALL = "all"  # stands for cars of every purpose
SAMPLE_S = 300.0  # time between two samples of the occupancy, s


class Day(NamedTuple):
    """A day whose searches are over.

    Attributes:
        fleet: the fleet.
        roads: its shortest drives.
        clairvoyant_s: lower bound on the total time of all cars together, s; see `Roads.clairvoyant_s`.
        times: (k,) samples, s since Monday 00:00.
        taken: (k, n_slots) numbers of cars in each slot then.
        lanes: metres in each lane, and failed attempts.
    """

    fleet: Fleet
    roads: Roads
    clairvoyant_s: float
    times: FloatArray
    taken: IntArray
    lanes: LaneCounts

    @property
    def purposes(self) -> tuple[tuple[str, ...], IntArray]:
        return purpose_names(self.fleet), np.array(self.fleet.cars["purpose"])

    def hour_of(self, time: FloatArray) -> IntArray:
        return hour_of(self.fleet, time)

    def paid(self) -> FloatArray:
        """Return what each car pays, (n_cars,), in the currency of the prices."""
        cars, scenario = self.fleet.cars, self.fleet.scenario
        zone = scenario.lot.zone_of_slot[cars["slot"]]
        amounts = scenario.zone_price(self.fleet.drawn.drivers)[np.arange(len(cars)), zone]
        return np.where(cars["slot"] >= 0, amounts, 0.0)


def simulate(fleet: Fleet, agents: Sequence[Any], roads: Roads, seed: int, number: int) -> Day:
    """Simulate a day of a fleet, by its seed and number, with the agents of `Fleet.run`."""
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
    """Return the names of the purposes of a fleet's drivers; `ALL` if there is one."""
    purposes = fleet.demand.purposes
    return (ALL,) if len(purposes) == 1 else tuple(purpose.name for purpose in purposes)


def hour_of(fleet: Fleet, time: FloatArray) -> IntArray:
    """Return the hours of times, s since Monday 00:00, counted from the midnight before a fleet's day begins."""
    return np.asarray((time - fleet.begin // DAY_S * DAY_S) // HOUR_S, np.int64)


class LaneCounts:
    """Metres in each lane, and failed attempts, counted from the steps of a fleet's cars while it drives.

    Metres beyond the shortest way to a car's slot count as cruising; for cars that give up, all metres do. They are
    driven at the end, so the detours in all lanes add up to those of all cars.

    Args:
        fleet: the fleet, which has been reset.
        roads: its shortest drives.

    Attributes:
        metres: (n_hours, n_lanes, 2) float64, m, from the first hour of the day on: driven, and cruised.
        refused: (k, 3) int64, failed attempts: car, slot, hour.
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
