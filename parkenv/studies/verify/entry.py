"""Ordered entry: every car takes the nearest free slot, and Erlang's B tells how often each slot is taken.

Cars arrive as a Poisson process, A of them in a mean stay. The nearest k slots are a loss system of their own: a car
enters one of them unless all k are taken, whatever happens further away. So they carry A(1 - B(k, A)), slot k alone
the difference A(B(k - 1, A) - B(k, A)), and an arriving car finds the nearest k slots taken with probability B(k, A):
its slot has the mean index sum over k >= 0 of B(k, A).
"""

from __future__ import annotations

from functools import partial

import numpy as np

from parkenv.studies.verify.fleets import (
    ORDERED_ENTRY,
    erlang_b,
    independent_runs,
    lane,
    loaded_fleet,
    mean_parked,
)
from parkenv.studies.verify.rows import Row, Task, mean_row
from parkenv.world.week import HOUR_S

SOURCE = "Erlang 1917; Cooper 1981, ordered hunting"
LOAD = 5.0
SLOTS = 24  # the lot is full for one car in 10^9
SHOWN = (1, 2, 3, 5, 8)
RUNS, WARM_UP_H, HOURS = 200, 10.0, 1000.0


def rows(seed: int) -> list[Row]:
    """Return rows for some slots, and for the mean index of the slot."""
    fleet = loaded_fleet(lane(SLOTS), ORDERED_ENTRY, LOAD, HOURS)
    taken, index = [], []
    for cars in independent_runs(fleet, RUNS, seed, HOURS):
        begin = fleet.begin + WARM_UP_H * HOUR_S
        # The last slot of the lane is at the goal.
        taken.append(mean_parked(cars, SLOTS, begin, fleet.begin + HOURS * HOUR_S)[::-1])
        index.append((SLOTS - cars["slot"][cars["arrival"] >= begin]).mean())
    shares = np.array(taken)
    made = [
        mean_row(
            f"ordered entry, A = {LOAD:g}: slot {k} is taken",
            LOAD * (erlang_b(k - 1, LOAD) - erlang_b(k, LOAD)),
            shares[:, k - 1],
            SOURCE,
        )
        for k in SHOWN
    ]
    expected = sum(erlang_b(k, LOAD) for k in range(SLOTS))
    return [
        *made,
        mean_row(f"ordered entry, A = {LOAD:g}: mean index of a car's slot", expected, index, SOURCE),
    ]


def tasks(seed: int) -> list[Task]:
    """Return the tasks of this case."""
    return [partial(rows, seed)]
