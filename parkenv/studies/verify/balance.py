"""Balance: no car is lost at any event, no slot holds two, and Little's law holds between totals and single cars.

Little's law is an identity for any window in which all searches begin and end: the integral over time of the number of
searching cars is the sum of their search times. The engine counts the one while it runs, and each car knows the other.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.scenarios.build import make_scenario
from parkenv.studies.verify.rows import Row, Task, certain_row
from parkenv.world.demand import ConstantTime, Demand, ExponentialTime, PoissonArrivals
from parkenv.world.week import HOUR_S
from planners.heuristics import POLICIES

SOURCE = "conservation of cars"
LITTLE = "Little 1961"
SCENARIOS = {"campus": 240.0, "street": 120.0, "mini": 90.0}
"""Scenarios, and arrivals an hour: more than find a slot at once."""
WORLDS = 2


def made_fleet(name: str) -> Fleet:
    """Return a fleet of three kinds of drivers, some of which balk, among cars that were parked before."""
    demand = Demand(
        PoissonArrivals(SCENARIOS[name], 8 * HOUR_S, 10 * HOUR_S),
        ExponentialTime(HOUR_S),
        ConstantTime(600.0),
    )
    kinds = [DriverKind(policy=POLICIES[name]) for name in ("greedy-drive", "first-free", "random")]
    return Fleet(make_scenario(name), demand, background="residents", drivers=kinds)


def rows(name: str, seed: int) -> list[Row]:
    """Return the rows of a scenario."""
    fleet = made_fleet(name)
    events = wrong = 0
    counted_s, summed_s, parked_s, stays_s = np.zeros((4, WORLDS))
    for world in range(WORLDS):
        fleet.reset(seed, world)
        fleet.run()
        end = fleet.time + 2 * HOUR_S
        fleet.run(until=end)
        cars, last = fleet.cars.copy(), fleet.totals
        counted_s[world], parked_s[world] = last["searching_s"], last["parked_s"]
        summed_s[world] = (cars["ended_at"] - cars["arrival"]).sum()
        parked = cars[cars["slot"] >= 0]
        stays_s[world] = (np.minimum(parked["left_at"], end) - parked["ended_at"]).sum()
        times = np.unique([cars["arrival"], cars["ended_at"], cars["left_at"]])
        times = times[np.isfinite(times)]
        events += len(times)
        wrong += sum(not balanced for balanced in checked_events(fleet, seed, world, times, cars))
    where = f"balance, {name}"
    return [
        certain_row(f"{where}: events of {events} at which cars are lost or doubled", 0, wrong, SOURCE),
        certain_row(
            f"{where}: searching, integral in hours",
            summed_s.sum() / HOUR_S,
            counted_s.sum() / HOUR_S,
            LITTLE,
        ),
        certain_row(
            f"{where}: parked, integral in hours", stays_s.sum() / HOUR_S, parked_s.sum() / HOUR_S, LITTLE
        ),
    ]


def checked_events(fleet: Fleet, seed: int, world: int, times: np.ndarray, cars: np.ndarray) -> list[bool]:
    """Run a world again, stop at every event, and return whether all cars are where they ought to be.

    Args:
        fleet: the fleet.
        seed: seed of the world.
        world: its episode.
        times: (k,) ascending, s, of all events.
        cars: the cars at the end of the first run.
    """
    fleet.reset(seed, world)
    good = []
    for time in times:
        fleet.run(until=float(time))
        now, totals = fleet.cars, fleet.totals
        due = cars["arrival"] > time
        searching = ~due & (cars["ended_at"] > time)
        parked = ~due & ~searching & (cars["slot"] >= 0) & (cars["left_at"] > time)
        gone = ~due & ~searching & ~parked
        expected = [group.sum() for group in (due, searching, parked, gone)]
        counted = [totals[name] for name in ("due", "searching", "parked", "gone")]
        here = fleet.slots["car"]
        standing = here[here >= 0]
        good.append(
            counted == expected
            and sum(counted) == len(cars)
            and len(np.unique(standing)) == len(standing) == totals["parked"]
            and np.array_equal(now["slot"][standing], np.flatnonzero(here >= 0))
            and fleet.time == time
        )
    return good


CASES: dict[str, Callable[[int], list[Task]]] = {
    "balance": lambda seed: [partial(rows, name, seed) for name in SCENARIOS]
}
