"""Insensitivity: how many slots are taken does not depend on the law of the stay, only on its mean.

For Poisson arrivals it holds in a lot that is never full (M/G/infinity: Poisson with mean A) and in one that turns
cars away (M/G/c/c, Sevast'yanov 1957: A(1 - B(c, A)) slots are taken).
"""

from __future__ import annotations

from functools import partial

from parkenv.engine.policy import CompiledPolicy
from parkenv.lots.generators import grid_lot
from parkenv.studies.verify.fleets import (
    ORDERED_ENTRY,
    STAY_S,
    erlang_b,
    independent_runs,
    lane,
    loaded_fleet,
    mean_parked,
)
from parkenv.studies.verify.rows import Row, Task, mean_row
from parkenv.world.demand import ConstantTime, Duration, EmpiricalTime, ExponentialTime, LogNormalTime
from parkenv.world.scenario import Scenario
from parkenv.world.week import HOUR_S
from planners.heuristics import POLICIES

SOURCE = "Sevast'yanov 1957"
LITTLE = "Little 1961, M/G/infinity"
LAWS: dict[str, Duration] = {
    "exponential": ExponentialTime(STAY_S),
    "constant": ConstantTime(STAY_S),
    "log-normal, cv 2": LogNormalTime(STAY_S, 2.0),
    "0.2 or 1.8 h": EmpiricalTime((0.2 * STAY_S, 1.8 * STAY_S)),
}
LOAD, SLOTS = 5.0, 5
DRIVERS_LOAD, ROWS, COLUMNS = 30.0, 4, 15  # a lot of 60 slots is full for one car in a million
WARM_UP_H = 30.0


def loss_row(law: str, seed: int, runs: int = 200, hours: float = 600.0) -> list[Row]:
    """Return the row of a small lot that turns cars away."""
    expected = LOAD * (1.0 - erlang_b(SLOTS, LOAD))
    samples = _mean_taken(lane(SLOTS), ORDERED_ENTRY, LOAD, law, seed, runs, hours)
    return [
        mean_row(f"{SLOTS} slots, A = {LOAD:g}, stays {law}: mean number taken", expected, samples, SOURCE)
    ]


def drivers_row(law: str, seed: int, runs: int = 50, hours: float = 200.0) -> list[Row]:
    """Return the row of a lot in which cars drive and search."""
    lot = grid_lot(ROWS, COLUMNS)
    scenario = lane(1).replace(lot=lot, occupancy=lane(lot.n_slots).occupancy)
    samples = _mean_taken(scenario, POLICIES["greedy-drive"], DRIVERS_LOAD, law, seed, runs, hours)
    case = f"{lot.n_slots} slots, A = {DRIVERS_LOAD:g}, stays {law}: mean number taken, greedy-drive"
    return [mean_row(case, DRIVERS_LOAD, samples, LITTLE)]


def _mean_taken(
    scenario: Scenario, policy: CompiledPolicy, load: float, law: str, seed: int, runs: int, hours: float
) -> list[float]:
    fleet = loaded_fleet(scenario, policy, load, hours, LAWS[law])
    return [
        float(
            mean_parked(
                cars,
                scenario.lot.n_slots,
                fleet.begin + WARM_UP_H * HOUR_S,
                fleet.begin + hours * HOUR_S,
            ).sum()
        )
        for cars in independent_runs(fleet, runs, seed, hours)
    ]


def tasks(seed: int) -> list[Task]:
    """Return the tasks of this case."""
    return [
        *(partial(loss_row, law, seed) for law in LAWS),
        *(partial(drivers_row, law, seed) for law in LAWS),
    ]
