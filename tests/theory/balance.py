"""Balance: no car is lost at any event, no slot holds two, and Little's law holds between totals and single cars."""

from functools import cache, partial

import numpy as np
from closed_forms import Statement, closed_form
from small_lots import driven

from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.scenarios.build import make_scenario
from parkenv.world.demand import ConstantTime, Demand, ExponentialTime, PoissonArrivals
from parkenv.world.week import HOUR_S
from planners.heuristics import POLICIES

SCENARIOS = {"campus": 240.0, "street": 120.0, "mini": 90.0}
"""Scenarios, and arrivals an hour: more than find a slot at once."""


def made_fleet(name):
    arrivals = PoissonArrivals(SCENARIOS[name], 8 * HOUR_S, 10 * HOUR_S)
    kinds = [DriverKind(policy=POLICIES[name]) for name in ("greedy-drive", "first-free", "random")]
    demand = Demand(arrivals, ExponentialTime(HOUR_S), ConstantTime(600.0))
    return Fleet(make_scenario(name), demand, background="residents", drivers=kinds)


@cache
def day(name):
    fleet = driven(made_fleet(name), 0)
    fleet.run(until=fleet.time + 2 * HOUR_S)
    return fleet.cars.copy(), fleet.totals, fleet.time


def hours_apart(name):
    """Hours of search, and in which cars are parked, that the engine counts less those of single cars."""
    cars, totals, end = day(name)
    parked = cars[cars["slot"] >= 0]
    searched_s = (cars["ended_at"] - cars["arrival"]).sum()
    parked_s = (np.minimum(parked["left_at"], end) - parked["ended_at"]).sum()
    return (totals["searching_s"] - searched_s) / HOUR_S, (totals["parked_s"] - parked_s) / HOUR_S


def unbalanced_events(fleet, cars):
    """Run a day again, stop at every event, and count those at which a car is not where it ought to be."""
    times = np.unique([cars["arrival"], cars["ended_at"], cars["left_at"]])
    fleet.reset(0)
    wrong = 0
    for time in times[np.isfinite(times)]:
        fleet.run(until=float(time))
        due = cars["arrival"] > time
        searching = ~due & (cars["ended_at"] > time)
        parked = ~due & ~searching & (cars["slot"] >= 0) & (cars["left_at"] > time)
        groups = due, searching, parked, ~due & ~searching & ~parked
        counted = [fleet.totals[name] for name in ("due", "searching", "parked", "gone")]
        here = fleet.slots["car"]
        standing = here[here >= 0]
        wrong += not (
            counted == [group.sum() for group in groups]
            and sum(counted) == len(cars)
            and len(np.unique(standing)) == len(standing) == fleet.totals["parked"]
            and np.array_equal(fleet.cars["slot"][standing], np.flatnonzero(here >= 0))
            and fleet.time == time
        )
    return wrong


@closed_form("Balance", "Conservation of cars; Little 1961")
def balance():
    r"""A busy morning with residents, three kinds of drivers and a patience of ten minutes is repeated and stopped at
    every event (arrival, end of a search, departure). Each time, every car has to be in exactly one place, due,
    searching, parked or gone, as its own record says; no slot may hold two. Little's law is an identity over a window
    in which all searches begin and end: the integral of the number of searching cars, which the engine counts while
    it runs, is the sum of the search times of single cars; the same holds for parked ones.
    """
    return [
        Statement(f"{name}: {what}", 0.0, partial(measure, name), 1e-6)
        for name in SCENARIOS
        for what, measure in (
            (
                "events at which cars are lost or doubled",
                lambda name: unbalanced_events(made_fleet(name), day(name)[0]),
            ),
            ("hours of search, the engine's less those of single cars", lambda name: hours_apart(name)[0]),
            ("hours parked, the engine's less those of single cars", lambda name: hours_apart(name)[1]),
        )
    ]
