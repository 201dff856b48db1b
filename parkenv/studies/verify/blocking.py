"""Blocking: the share of cars that find the lot full and go elsewhere is Erlang's B (M/M/c/c, and M/G/c/c).

The number of cars N in c slots goes up at rate A (per mean stay) and down at rate N: detailed balance makes P(N = n)
proportional to A^n/n!, and Poisson arrivals find what is there on average: P(N = c) = B(c, A) of them find it full.
"""

from __future__ import annotations

from functools import partial

from parkenv.engine.policy import CompiledPolicy
from parkenv.engine.records import LEFT, PARKED
from parkenv.lots.generators import grid_lot
from parkenv.studies.verify.fleets import (
    ORDERED_ENTRY,
    STAY_S,
    erlang_b,
    independent_runs,
    lane,
    loaded_fleet,
)
from parkenv.studies.verify.rows import Row, Task, mean_row
from parkenv.world.demand import Duration, ExponentialTime, LogNormalTime
from parkenv.world.scenario import Scenario
from parkenv.world.sensor_model import SensorModel
from parkenv.world.week import HOUR_S
from planners.heuristics import POLICIES

SOURCE = "Erlang 1917"
SLOTS, LOAD = 10, 8.0
FAST = 1e4  # m/s: the search takes no time
RUNS, WARM_UP_H, HOURS = 200, 10.0, 600.0


def row(policy: CompiledPolicy, seed: int, stay: Duration, named: str) -> list[Row]:
    """Return the row of a kind of driver and a law of stays."""
    scenario = lane(SLOTS) if policy is ORDERED_ENTRY else searched_lot()
    fleet = loaded_fleet(scenario, policy, LOAD, HOURS, stay)
    blocked = []
    for cars in independent_runs(fleet, RUNS, seed, HOURS):
        # Searches may be under way when the run ends.
        over = cars[(cars["arrival"] >= fleet.begin + WARM_UP_H * HOUR_S) & (cars["ended_at"] <= fleet.time)]
        blocked.append(1.0 - ((over["state"] == PARKED) | (over["state"] == LEFT)).mean())
    case = f"{SLOTS} slots, A = {LOAD:g}, stays {named}: cars turned away, {policy.name}"
    return [mean_row(case, erlang_b(SLOTS, LOAD), blocked, SOURCE)]


def searched_lot() -> Scenario:
    """Return a lot in which all slots are in view from everywhere, and the drive takes no time."""
    lot = grid_lot(2, SLOTS // 2)
    sees_all = SensorModel(view_range=1e3)
    return lane(SLOTS).replace(lot=lot, v_drive=FAST, sensor_model=sees_all)


def tasks(seed: int) -> list[Task]:
    """Return the tasks of this case."""
    exponential, spread = ExponentialTime(STAY_S), LogNormalTime(STAY_S, 2.0)
    return [
        partial(row, ORDERED_ENTRY, seed, exponential, "exponential"),
        partial(row, ORDERED_ENTRY, seed, spread, "log-normal"),
        partial(row, POLICIES["greedy-drive"], seed, exponential, "exponential"),
    ]
