"""Per-zone measures of a simulated day: the searches of the cars that go there, and how full it is around.

A *zone* is a goal of the lot, and the spaces within a walk of it. Zones may have spaces in common.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.studies.curve.lone_search import LoneSearches
from parkenv.studies.fleet.day import Day
from parkenv.studies.fleet.setting import SETTING_COLUMNS
from parkenv.studies.results import Table
from parkenv.world.scenario import Scenario
from parkenv.world.week import HOUR_S

INDEX = ("zone", "purpose", "hour")
OF_CARS = ("cars", "parked", "failed", "search_s", "walk_s")
"""Sums over the cars that arrive in an hour, by zone, purpose and hour."""
LONE = tuple(f"lone_{name}" for name in OF_CARS[1:])
"""The same as lone searches have them; see `LoneSearches`."""
SUMS = (*OF_CARS, *LONE)
STATE = ("occupancy", "demand", "town_occupancy", "town_demand")
"""Share of the spaces around that is taken, and cars that arrive in an hour for each, by zone and hour; and of all
spaces of the lot, by hour."""


ZONES = Table("zones.jsonl", (*SETTING_COLUMNS, "day"))
"""A line for each day: `SUMS` where cars arrive, with the numbers of zone, purpose and hour, and `STATE`. Hours
count from the first of the day's arrivals."""


@dataclass(frozen=True, eq=False)
class Zones:
    """The zones of a lot: one for each place that the cars of a fleet go to.

    Attributes:
        names: index of the goal of each.
        xy: (n, 2) m, the goals.
        near: (n, n_slots) 1 for slots within reach on foot; of a zone without any, for the nearest.
        neighbors: (n, n) 1 for zones whose goals are within reach.
        spaces: (n, 2) how many cars fit into them, in drawn slots and in counted facilities.
        own: (n, 2) the same of the slots to which no zone is nearer.
        streets_s: time to drive along all streets around a zone once, in the mean over zones, s.
    """

    names: tuple[str, ...]
    xy: FloatArray
    near: FloatArray
    neighbors: FloatArray
    spaces: FloatArray
    own: IntArray
    streets_s: float

    @classmethod
    def of(cls, scenarios: Sequence[Scenario], reach_m: float) -> Self:
        lot, goals = scenarios[0].lot, [one.goal for one in scenarios]
        walk_m, xy = np.array([lot.walk_m(goal) for goal in goals]), np.array(lot.goals, float)[goals]
        near = (walk_m <= np.maximum(reach_m, walk_m.min(axis=1, keepdims=True))).astype(float)
        neighbors = (np.linalg.norm(xy[:, None] - xy, axis=2) <= reach_m).astype(float)
        kinds = np.stack([lot.capacity * ~lot.is_counted, lot.capacity * lot.is_counted], axis=1)
        own = np.zeros((len(xy), 2), np.int64)
        np.add.at(own, walk_m.argmin(axis=0), kinds)
        edge_m = np.where(lot.neighbors >= 0, lot.edge_length / lot.edge_speed, 0.0)
        around = np.linalg.norm(xy[:, None] - lot.vertex_xy, axis=2) <= reach_m
        streets_s = float((around @ edge_m.sum(axis=1)).mean()) / scenarios[0].v_drive or 1.0
        return cls(tuple(map(str, goals)), xy, near, neighbors, near @ kinds, own, streets_s)


def day_of_zones(day: Day, zones: Zones, lone: LoneSearches) -> dict[str, Any]:
    """Return the row of `ZONES` of a day, without setting and day.

    The search time of a car is its time from the entry to its space beyond the direct drive there: detours, failed
    attempts, queues, and the way inside a garage.
    """
    names, purpose = day.purposes
    fleet, taken, arrives = day.fleet, day.taken, day.fleet.cars["parked_at"] < 0
    cars, sampled = fleet.cars[arrives], day.hour_of(day.times)
    first, sampled = sampled[0], sampled - sampled[0]
    n_samples = np.bincount(sampled)
    hour = np.minimum(day.hour_of(cars["arrival"]) - first, len(n_samples) - 1)
    shape = len(zones.names), len(names), len(n_samples)
    flat, parked = (
        np.ravel_multi_index((cars["scenario_index"], purpose[arrives], hour), shape),
        cars["slot"] >= 0,
    )
    search_s = np.maximum(cars["ended_at"] - cars["arrival"] - day.roads.direct_s(cars), 0.0)
    values = (
        np.ones(len(cars)), parked, cars["failed_parks"], search_s * parked, cars["walk_s"] * parked,
        *lone.of_day(fleet, taken, sampled, arrives, hour),
    )  # fmt: skip
    sums = [np.bincount(flat, weights, np.prod(shape)).reshape(shape) for weights in values]
    index, arrived = np.nonzero(sums[0]), sums[0].sum(axis=1)
    there = np.array([taken[sampled == k].mean(axis=0) for k in range(len(n_samples))]).T
    spaces, all_spaces = zones.spaces.sum(axis=1, keepdims=True), fleet.scenario.lot.capacity.sum()
    # The last hour may be a part of one.
    hours = n_samples * (day.times[1] - day.times[0] if len(day.times) > 1 else HOUR_S) / HOUR_S
    state = (
        zones.near @ there / spaces, zones.neighbors @ arrived / spaces / hours, there.sum(axis=0) / all_spaces,
        arrived.sum(axis=0) / all_spaces / hours,
    )  # fmt: skip
    return (
        {name: numbers.tolist() for name, numbers in zip(INDEX, index, strict=True)}
        | {name: total[index].round(2).tolist() for name, total in zip(SUMS, sums, strict=True)}
        | {name: shares.round(4).tolist() for name, shares in zip(STATE, state, strict=True)}
    )
