"""Benchmark of fleets: decisions per second, days of many cars, memory."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from benchmarks.rows import Row, duration, median_of, rate
from benchmarks.sumo_days import sumo_rows
from parkenv.engine.fleet import DriverKind, Fleet
from parkenv.lots import city_lot, grid_lot
from parkenv.scenarios.build import make_scenario
from parkenv.world.demand import Demand, ExponentialTime, Headways, PoissonArrivals
from parkenv.world.scenario import Scenario
from parkenv.world.week import DAY_S, HOUR_S
from planners.heuristics import POLICIES

WORLDS, CARS = 64, 50
"""Worlds of the batch, and cars of each."""
SLOTS = (10, 20)
LARGE, DAY_CARS = 10_000, 1_000
FULL = 0.8  # share of taken slots
STEPS_S = (1.0, 0.1)
"""Time steps of SUMO, s."""
GROWTH = (10, 100, 1_000, 10_000)


def fleet_rows(
    seed: int = 0,
    seconds: float = 0.6,
    *,
    worlds: int = WORLDS,
    large: int = LARGE,
    day_cars: int = DAY_CARS,
    growth: Sequence[int] = GROWTH,
) -> list[Row]:
    """Return the rows of `python benchmarks/run.py fleet`, on one core.

    A batch is many worlds with random actions, from their beginning to their end, one world after the other. Days are
    24 hours in which cars arrive as a Poisson process and stay for two hours on average; the residents of the lot,
    which is 80 % full at midnight, leave and do not return. If SUMO is installed, it simulates the same days on a lot
    of one-way lanes.

    Args:
        seed: seed of the worlds.
        seconds: duration of each measurement.
        worlds: number of worlds of the batch.
        large: number of slots of the large lots.
        day_cars: cars of a day.
        growth: cars of the days in which time is measured against their number.
    """
    small = make_scenario(grid_lot(*SLOTS))
    rows: list[Row] = []
    batch = [_fleet(small, Demand(Headways(CARS)), "random") for _ in range(worlds)]
    case = f"batch of {worlds} worlds, {CARS} cars, {small.lot.n_slots} slots"
    rows += rate("decisions", f"{case}, random", _decisions_per_second(batch, seed, seconds), "decisions/s")
    alone = Fleet(small, Demand(Headways(CARS)), max_steps=200)
    python = _seconds_a_decision(alone, seed, seconds)
    rows += rate(
        "decisions", f"Fleet, {CARS} cars, {small.lot.n_slots} slots, Python", 1 / python, "decisions/s"
    )

    lots = {
        "city": make_scenario(city_lot(large, seed)),
        "rows": make_scenario(grid_lot(max(large // 200, 1), 200)),
    }
    for name, scenario in lots.items():
        for policy in ("greedy-drive", "first-free"):
            day = _fleet(scenario, _day(day_cars), policy)
            took = _seconds_a_day(day, seed, seconds)
            case = f"{name} of {scenario.lot.n_slots:,} slots, {day_cars:,} cars a day, {policy}"
            rows += duration("day", case, took, "s")
            rows += rate("memory", case, day.n_bytes / 2**20, "MiB")
    for cars in growth:
        day = _fleet(lots["rows"], _day(cars), "greedy-drive")
        took = _seconds_a_day(day, seed, seconds)
        case = (
            f"rows of {lots['rows'].lot.n_slots:,} slots, {cars:,} cars a day, greedy-drive, with its reset"
        )
        rows += duration("growth", case, 1e3 * took, "ms a day")
        rows += duration("growth", case, 1e9 * took / day.totals["decisions"], "ns a decision")
    return rows + _street_rows(seed)


def _street_rows(seed: int) -> list[Row]:
    """Return rows of the lot `street`, where all lanes are one-way, beside SUMO."""
    begin, end, cars = 8 * HOUR_S, 13 * HOUR_S, 60.0
    demand = Demand(PoissonArrivals(cars, begin, end), ExponentialTime(HOUR_S))
    kind = DriverKind(policy=POLICIES["greedy-drive"])
    fleet = Fleet("street", demand, background="none", drivers=[kind], leave_full_lot=False)
    return sumo_rows(fleet, f"street, {cars:g} cars an hour for 5 hours", seed, end - begin, STEPS_S, days=3)[
        0
    ]


def _day(cars: int) -> Demand:
    return Demand(PoissonArrivals(cars * HOUR_S / DAY_S, 0.0, DAY_S), ExponentialTime(2 * HOUR_S))


def _fleet(scenario: Scenario, demand: Demand, policy: str) -> Fleet:
    occupancy = scenario.occupancy
    if occupancy.adjustable:
        scenario = scenario.replace(occupancy=occupancy.at_mean_occupancy(FULL, 0.0))
    return Fleet(scenario, demand, drivers=[DriverKind(policy=POLICIES[policy])])


def _decisions_per_second(fleets: Sequence[Fleet], seed: int, seconds: float) -> float:
    """Return decisions per second of CPU time of worlds that run one after the other, without their resets."""

    def run(episode: int) -> float:
        for i, fleet in enumerate(fleets):
            fleet.reset(seed + i, episode)
        start = time.process_time()
        for fleet in fleets:
            fleet.run()
        took = time.process_time() - start
        return sum(fleet.totals["decisions"] for fleet in fleets) / took

    return median_of(run, seconds)


def _seconds_a_day(fleet: Fleet, seed: int, seconds: float) -> float:
    """Return the CPU time of a day with its reset, s."""

    def run(episode: int) -> float:
        start = time.process_time()
        fleet.reset(seed, episode)
        fleet.run()
        return time.process_time() - start

    return median_of(run, seconds)


def _seconds_a_decision(fleet: Fleet, seed: int, seconds: float) -> float:
    """Return the CPU time of a decision in Python, s, with its observation and a random action."""
    draws = np.random.default_rng(seed).random(4096)

    def run(episode: int) -> float:
        fleet.reset(seed, episode)
        n, start = 0, time.process_time()
        while (car := fleet.next_decision()) is not None:
            actions = np.flatnonzero(fleet.observation(car)["action_mask"])
            fleet.act(actions[int(draws[n % len(draws)] * len(actions))])
            n += 1
        return (time.process_time() - start) / n

    return median_of(run, seconds)
