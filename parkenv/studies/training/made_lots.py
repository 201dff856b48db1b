"""Made lots to train on, of many sizes and shapes, so that a training needs no data."""

from __future__ import annotations

import numpy as np

from parkenv.lots import city_lot, grid_lot
from parkenv.scenarios.build import make_scenario
from parkenv.world.occupancy.real_week import DAY_ERROR, real_week_occupancy
from parkenv.world.scenario import KMH, Scenario

GRIDS = ((2, 8), (2, 20), (4, 10), (4, 25), (6, 15), (8, 12), (8, 30), (12, 20))
"""Rows of slots, and slots in a row."""
CITIES = (40, 80, 120, 160, 240, 320, 400, 500)
"""Slots along the streets of a made town."""
FULLER_THAN = (0.5, 0.7, 0.9, 0.95)
"""Shares of real car parks that are less full than the made ones, in turn."""


def made_places() -> list[Scenario]:
    """Return scenarios on made lots with real weeks: car parks with rows of bays, and towns with cars along streets."""
    lots = [grid_lot(rows, columns) for rows, columns in GRIDS]
    lots += [city_lot(slots, seed=number) for number, slots in enumerate(CITIES)]
    names = [f"grid {rows} x {columns}" for rows, columns in GRIDS] + [f"town {slots}" for slots in CITIES]
    made = []
    for number, (lot, name) in enumerate(zip(lots, names, strict=True)):
        occupancy = real_week_occupancy(lot, fuller_than=FULLER_THAN[number % len(FULLER_THAN)])
        made.append(make_scenario(lot, name=name, occupancy=occupancy, day_error=DAY_ERROR))
    return made


def varied(scenarios: list[Scenario], seed: int) -> list[Scenario]:
    """Return the scenarios with other speeds and costs, drawn within a factor of two of the usual ones.

    Args:
        scenarios: the scenarios.
        seed: seed of the draws.
    """
    rng = np.random.default_rng(seed)
    made = []
    for scenario in scenarios:
        drive, walk, failure = 2.0 ** rng.uniform(-0.5, 0.8, 3)
        changes = {"v_drive": 10.0 * KMH * drive, "v_walk": 4.0 * KMH * walk, "failure_s": 10.0 * failure}
        made.append(scenario.replace(**changes))
    return made
