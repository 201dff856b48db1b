"""Measures of one day with many cars."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.engine.fleet import Fleet, drive_metres
from parkenv.studies.fleet.blocks import has_zones, paid
from parkenv.studies.fleet.clairvoyant_bound import ParkingDay, clairvoyant_bound_s
from parkenv.studies.fleet.setting import BY_HOUR
from parkenv.studies.statistics import mean_or_nan
from parkenv.world.cost_terms import COST_FIELDS
from parkenv.world.drive_graph import linestrings
from parkenv.world.scenario import SearchProblem
from parkenv.world.week import HOUR_S

MOST_PAIRS = 5_000_000
"""Pairs of a car and a slot up to which a day has a clairvoyant bound."""


class Roads:
    """Shortest drives from the entries of a scenario.

    Args:
        problem: lot, goal, speeds and costs.

    Attributes:
        first_slot_m: mean drive from an entry to the slot that is nearest to it, m at the scenario's speed.
    """

    def __init__(self, problem: SearchProblem) -> None:
        lot = problem.lot
        entries = np.unique(lot.entry_vertices)
        metres, timed = (drive_metres(lot, entries, timed=timed) for timed in (False, True))
        self._entries, self._metres, self._drive_s = entries, metres, timed / problem.v_drive
        self._problem, self._cost_s = problem, problem.walk_s + lot.slot_parking_cost_s
        self.first_slot_m = float(timed.min(axis=1).mean())

    def direct_m(self, cars: NDArray[np.void]) -> FloatArray:
        """Return the shortest drive of cars from their entries to their slots, (n,) m; 0 without a slot."""
        rows = np.searchsorted(self._entries, cars["entry"])
        return np.where(cars["slot"] >= 0, self._metres[rows, cars["slot"]], 0.0)

    def direct_s(self, cars: NDArray[np.void]) -> FloatArray:
        """Return the times of these drives, (n,) s; 0 without a slot."""
        rows = np.searchsorted(self._entries, cars["entry"])
        return np.where(cars["slot"] >= 0, self._drive_s[rows, cars["slot"]], 0.0)

    def cruised_m(self, cars: NDArray[np.void]) -> FloatArray:
        """Return what the drives of cars exceed the shortest ones by, (n,) m: all of it without a slot."""
        return np.maximum(cars["driven_m"] - self.direct_m(cars), 0.0)

    @cached_property
    def lane_of_edge(self) -> IntArray:
        """Lane of each edge of the drive graph, (n_vertices, 4): the nearest to its middle."""
        lot = self._problem.lot
        ends = lot.vertex_xy[lot.neighbors]
        middle = (lot.vertex_xy[:, None] + ends).reshape(-1, 2) / 2
        tree = shapely.STRtree(linestrings([lane.points for lane in lot.lanes]))
        edge, lane = tree.query_nearest(shapely.points(middle), all_matches=False)
        found = np.zeros(len(middle), np.int64)
        found[edge] = lane
        return found.reshape(lot.neighbors.shape)

    def alone_s(self, fleet: Fleet) -> FloatArray:
        """Return the total time of each car in an empty lot that it knows, (n,) s: no car can be faster.

        A car that may park nowhere pays the give-up penalty.
        """
        cars, lot = fleet.cars, self._problem.lot
        rows, free_s = np.searchsorted(self._entries, cars["entry"]), np.zeros((len(cars), len(lot.zones)))
        for place, walks in sorted({*zip(cars["place"].tolist(), cars["walks"].tolist(), strict=True)}):
            its = (cars["place"] == place) & (cars["walks"] == walks)
            cost_s = fleet.scenarios[place].walk_s * walks + lot.slot_parking_cost_s
            by_zone = [
                (self._drive_s[:, lot.zone_of_slot == zone] + cost_s[lot.zone_of_slot == zone]).min(axis=1)
                for zone in range(len(lot.zones))
            ]
            free_s[its] = np.stack(by_zone, axis=1)[rows[its]]
        least_s = (free_s + fleet.zone_cost_s()).min(axis=1)
        return np.where(np.isfinite(least_s), least_s, self._problem.give_up_s)

    def reach(self) -> dict[str, int]:
        """Return how many `entries` there are, and from how many half of the spaces cannot be reached."""
        capacity, can = self._problem.lot.capacity, np.isfinite(self._drive_s)
        cut_off = int((can @ capacity < 0.5 * capacity.sum()).sum())
        return {"entries": len(can), "entries_cut_off": cut_off}

    def clairvoyant_s(self, fleet: Fleet) -> float:
        """Return the clairvoyant bound of the day of a fleet that has been reset, s, for all cars together.

        It is NaN where it would take longer than the day itself, and where it does not hold: with several goals,
        counted facilities, or cars that are parked at first.
        """
        lot = self._problem.lot
        holds = (
            len(fleet.scenarios) == 1 and (lot.capacity == 1).all() and (fleet.cars["parked_at"] < 0).all()
        )
        if len(fleet.cars) * lot.n_slots > MOST_PAIRS or not holds:
            return float("nan")
        return clairvoyant_bound_s(self.parking_day(fleet))

    def parking_day(self, fleet: Fleet) -> ParkingDay:
        """Return the day of a fleet that has been reset: its cars to come, and when its residents leave."""
        cars = fleet.cars
        leaves_at = np.where(fleet.taken(), fleet.slots["leaves_at"], -np.inf)
        return ParkingDay(
            arrival=np.array(cars["arrival"], np.float64),
            stay_s=np.array(cars["stay_s"], np.float64),
            patience_s=np.array(cars["patience_s"], np.float64),
            entry=np.searchsorted(self._entries, cars["entry"]).astype(np.int64),
            drive_s=self._drive_s,
            cost_s=np.asarray(self._cost_s, np.float64),
            free_from=leaves_at.astype(np.float64),
            zone=np.array(self._problem.lot.zone_of_slot),
            zone_cost_s=fleet.zone_cost_s(),
            give_up_s=float(self._problem.give_up_s),
        )


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


def day_measures(
    fleet: Fleet, roads: Roads, members: BoolArray, filled: dict[str, Any], clairvoyant_s: float
) -> dict[str, Any]:
    """Return the measures of a day whose searches are all over.

    Args:
        fleet: the fleet.
        roads: its shortest drives.
        members: (n_cars,) which cars know more than their own observations.
        filled: of `filling`, while cars arrived.
        clairvoyant_s: lower bound on the total time of all cars together, s.
    """
    arrives = fleet.cars["parked_at"] < 0
    cars, amounts, members = fleet.cars[arrives], paid(fleet)[arrives], members[arrives]
    times, parked = cars["total_s"], cars["slot"] >= 0
    cruised_m = roads.cruised_m(cars)
    driven_m = float(cars["driven_m"].sum())
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
        **filled,
        "members_s": mean_or_nan(times[members]),
        "others_s": mean_or_nan(times[~members]),
        "bound_s": float(roads.alone_s(fleet)[arrives].mean()),
        "clairvoyant_s": clairvoyant_s / len(cars),
        **{name: float(cars[name].mean()) for name in COST_FIELDS},
        "paid": float(amounts.mean()),
        "paying_share": float((amounts > 0.0).mean()),
    }


def car_lists(fleet: Fleet, members: BoolArray) -> dict[str, str]:
    """Return `CAR_LISTS` of a day whose searches are all over, as texts."""
    arrives, lot = fleet.cars["parked_at"] < 0, fleet.scenario.lot
    cars, members = fleet.cars[arrives], members[arrives]
    lists = {"total_cs": 100.0 * cars["total_s"], "member": members}
    if has_zones(fleet.scenario):
        zone = np.where(cars["slot"] >= 0, 1 + lot.zone_of_slot[cars["slot"]], 0)
        lists |= {"zone": zone, "paid_cents": 100.0 * paid(fleet)[arrives]}
    if len(fleet.demand.purposes) > 1:
        lists["purpose"] = cars["purpose"]
    return {name: " ".join(map(str, np.rint(values).astype(int).tolist())) for name, values in lists.items()}


def filling(times: FloatArray, taken: FloatArray, counted: FloatArray) -> dict[str, Any]:
    """Return means of shares of taken slots, simulated and as counted, at ascending times, (k,) s; also by hour."""
    hours = np.flatnonzero(np.diff(times // HOUR_S)) + 1
    by_hour = [
        " ".join(f"{its.mean():.4f}" for its in np.split(shares, hours)) for shares in (taken, counted)
    ]
    means = {"occupancy": float(np.mean(taken)), "counted_occupancy": float(np.mean(counted))}
    return means | dict(zip(BY_HOUR, by_hour, strict=True))


def looks_s(problem: SearchProblem, occupancy: FloatArray) -> FloatArray:
    """Return the search time, s, of looking at slots in random order, (n + 1)/(m + 1) of them if m of n are free.

    A look takes the median drive from a slot to the next one; the drive from the entry to the first slot comes before.
    """
    lot, n = problem.lot, problem.lot.n_slots
    source, column = np.nonzero(lot.neighbors[:n] >= 0)
    to_slot = lot.neighbors[source, column] < n
    hop_s = float(np.median(problem.move_s[source[to_slot], column[to_slot]])) if to_slot.any() else 0.0
    first_s = Roads(problem).first_slot_m / problem.v_drive
    return np.asarray(first_s + hop_s * ((n + 1.0) / ((1.0 - occupancy) * n + 1.0) - 1.0))
