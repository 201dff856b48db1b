"""Fleets of the cases with many cars: lanes, independent runs, and what is counted in them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.memory import int64s
from parkenv.engine.events import LEAVE, TAKE_SLOT
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.engine.kernel import is_slot_open
from parkenv.engine.policy import CompiledPolicy
from parkenv.engine.records import car_at, fleet_at
from parkenv.studies.verify.line import THESIS_SPEEDS, Line
from parkenv.world.demand import Demand, Duration, ExponentialTime, PoissonArrivals
from parkenv.world.occupancy.kernel import kernel
from parkenv.world.scenario import Scenario
from parkenv.world.week import HOUR_S

STAY_S = HOUR_S  # mean stay, s: loads are arrivals an hour


def erlang_b(slots: int, load: float) -> float:
    """Return Erlang's B: the share of arrivals that find all slots taken.

    Examples:
        >>> erlang_b(1, 1.0), round(erlang_b(10, 8.0), 4)
        (0.5, 0.1217)
    """
    blocked = 1.0
    for k in range(1, slots + 1):
        blocked = load * blocked / (k + load * blocked)
    return blocked


@kernel
def decide_ordered_entry(address: int, number: int) -> int:
    """Stand in the free slot with the lowest cost of arrival at once; if there is none, park elsewhere.

    The driver of queueing theory's ordered entry: it knows everything and drives in no time.
    """
    fleet = fleet_at(address, 0)
    by_cost = int64s(fleet.by_cost + 8 * fleet.n_slots * car_at(fleet.cars, number).place)
    for i in range(fleet.n_slots):
        if is_slot_open(address, by_cost[i], number, fleet.time):
            return int(TAKE_SLOT + by_cost[i])
    return LEAVE


ORDERED_ENTRY = CompiledPolicy("ordered-entry", decide_ordered_entry)


def lane(slots: int) -> Scenario:
    """Return a lane of slots that ends at the goal: slot `slots - 1` is at the goal."""
    return Line(0.5, THESIS_SPEEDS, slots - 1, 0).scenario()


def loaded_fleet(
    scenario: Scenario, policy: CompiledPolicy, load: float, hours: float, stay: Duration | None = None
) -> Fleet:
    """Return a fleet on an empty lot: Poisson arrivals, `load` of them in a mean stay, for some hours."""
    demand = Demand(PoissonArrivals(load, 0.0, hours * HOUR_S), stay or ExponentialTime(STAY_S))
    return Fleet(scenario, demand, background="none", drivers=(DriverKind(policy=policy),))


def independent_runs(fleet: Fleet, runs: int, seed: int, hours: float) -> Iterator[NDArray[np.void]]:
    """Run worlds to the end of their arrivals; yield the cars of each."""
    for episode in range(runs):
        fleet.reset(seed, episode)
        fleet.run(until=fleet.begin + hours * HOUR_S)
        yield fleet.cars


def mean_parked(cars: NDArray[np.void], n_slots: int, begin: float, end: float) -> FloatArray:
    """Return the share of the time from `begin` to `end`, s, that cars stood in each slot, (n_slots,)."""
    parked = cars[cars["slot"] >= 0]
    inside = np.clip(parked["left_at"], begin, end) - np.clip(parked["ended_at"], begin, end)
    return np.bincount(parked["slot"], inside, n_slots) / (end - begin)
