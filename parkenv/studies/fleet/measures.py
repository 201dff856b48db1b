"""Measures of one day with many cars."""

from __future__ import annotations

import numpy as np

from parkenv.compiled.arrays import FloatArray
from parkenv.studies.fleet.blocks import has_zones
from parkenv.studies.fleet.day import Day
from parkenv.studies.fleet.roads import Roads
from parkenv.studies.fleet.setting import BY_HOUR
from parkenv.studies.results import Row
from parkenv.studies.statistics import mean_or_nan
from parkenv.world.cost_terms import COST_FIELDS
from parkenv.world.scenario import SearchProblem
from parkenv.world.week import HOUR_S


def gini(values: FloatArray) -> float:
    """Return the Gini coefficient of values of at least 0: 0 if all are equal, near 1 if one has everything.

    Examples:
        >>> gini(np.array([2.0, 2.0, 2.0])), round(gini(np.array([0.0, 0.0, 1.0])), 3)
        (0.0, 0.667)
    """
    n, total = len(values), float(values.sum())
    if n == 0 or total == 0.0:
        return 0.0
    ranks = np.arange(1, n + 1)
    return float(2.0 * (ranks * np.sort(values)).sum() / (n * total) - (n + 1.0) / n)


def day_measures(day: Day, counted: FloatArray) -> Row:
    """Return the measures of a day; cars of the first kind of drivers are members.

    Args:
        day: the day.
        counted: (k,) numbers of taken slots at the samples, as counted; NaN where nobody counted.
    """
    arrives, lot = day.fleet.cars["parked_at"] < 0, day.fleet.scenario.lot
    cars, amounts = day.fleet.cars[arrives], day.paid()[arrives]
    times, parked, members = cars["total_s"], cars["slot"] >= 0, cars["kind"] == 0
    cruised_m, driven_m = day.roads.cruised_m(cars), float(cars["driven_m"].sum())
    taken, hours = (
        day.taken.sum(axis=1) / lot.capacity.sum(),
        np.flatnonzero(np.diff(day.times // HOUR_S)) + 1,
    )
    by_hour = [
        " ".join(f"{shares.mean():.4f}" for shares in np.split(occupied, hours))
        for occupied in (taken, counted)
    ]
    return {
        "cars": len(cars),
        "total_s": float(times.mean()),
        "median_s": float(np.median(times)),
        "p95_s": float(np.quantile(times, 0.95)),
        "gini": gini(times),
        "search_s": float((cars["ended_at"] - cars["arrival"]).mean()),
        "queued_s": float(cars["queued_s"].mean()),
        "failed_attempts": float(cars["failed_parks"].mean()),
        "driven_m": driven_m / len(cars),
        "cruised_m": float(cruised_m.mean()),
        "cruising_share": float(cruised_m.sum()) / driven_m if driven_m else 0.0,
        "balked_fraction": float((~parked).mean()),
        "occupancy": float(np.mean(taken)),
        "counted_occupancy": float(np.mean(counted)),
        **dict(zip(BY_HOUR, by_hour, strict=True)),
        "members_s": mean_or_nan(times[members]),
        "others_s": mean_or_nan(times[~members]),
        "bound_s": float(day.roads.alone_s(day.fleet)[arrives].mean()),
        "clairvoyant_s": day.clairvoyant_s / len(cars),
        **{name: float(cars[name].mean()) for name in COST_FIELDS},
        "paid": float(amounts.mean()),
        "paying_share": float((amounts > 0.0).mean()),
    }


def car_lists(day: Day) -> dict[str, str]:
    fleet, arrives = day.fleet, day.fleet.cars["parked_at"] < 0
    cars, lot = fleet.cars[arrives], fleet.scenario.lot
    lists = {"total_cs": 100.0 * cars["total_s"], "member": cars["kind"] == 0}
    if has_zones(fleet.scenario):
        zone = np.where(cars["slot"] >= 0, 1 + lot.zone_of_slot[cars["slot"]], 0)
        lists |= {"zone": zone, "paid_cents": 100.0 * day.paid()[arrives]}
    if len(fleet.demand.purposes) > 1:
        lists["purpose"] = cars["purpose"]
    return {name: " ".join(map(str, np.rint(values).astype(int).tolist())) for name, values in lists.items()}


def random_order_search_s(problem: SearchProblem, occupancy: FloatArray) -> FloatArray:
    """Return the search time, s, of looking at slots in random order, (n + 1)/(m + 1) of them if m of n are free.

    A look takes the median drive from a slot to the next one; the drive from the entry to the first slot comes before.
    """
    lot, n = problem.lot, problem.lot.n_slots
    source, column = np.nonzero(lot.neighbors[:n] >= 0)
    to_slot = lot.neighbors[source, column] < n
    hop_s = float(np.median(problem.move_s[source[to_slot], column[to_slot]])) if to_slot.any() else 0.0
    first_s = Roads(problem).first_slot_m / problem.v_drive
    return np.asarray(first_s + hop_s * ((n + 1.0) / ((1.0 - occupancy) * n + 1.0) - 1.0))
