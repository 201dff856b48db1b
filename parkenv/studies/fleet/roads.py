"""Shortest drives of the cars of a fleet, and bounds on their times."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray

from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.engine.fleet import Fleet
from parkenv.studies.fleet.clairvoyant_bound import ParkingDay, clairvoyant_bound_s
from parkenv.world.drive_graph import linestrings
from parkenv.world.scenario import SearchProblem, drive_metres

MOST_PAIRS = 5_000_000  # pairs of a car and a slot up to which a day has a clairvoyant bound


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
        lanes = np.zeros(len(middle), np.int64)
        lanes[edge] = lane
        return lanes.reshape(lot.neighbors.shape)

    def alone_s(self, fleet: Fleet) -> FloatArray:
        """Return the total time of each car in an empty lot that it knows, (n,) s: no car can be faster.

        A car that may park nowhere pays the give-up penalty.
        """
        cars, lot = fleet.cars, self._problem.lot
        rows, free_s = np.searchsorted(self._entries, cars["entry"]), np.zeros((len(cars), len(lot.zones)))
        for place, walks in sorted(
            {*zip(cars["scenario_index"].tolist(), cars["walks"].tolist(), strict=True)}
        ):
            alike = (cars["scenario_index"] == place) & (cars["walks"] == walks)
            cost_s = fleet.scenarios[place].walk_s * walks + lot.slot_parking_cost_s
            by_zone = [
                (self._drive_s[:, lot.zone_of_slot == zone] + cost_s[lot.zone_of_slot == zone]).min(axis=1)
                for zone in range(len(lot.zones))
            ]
            free_s[alike] = np.stack(by_zone, axis=1)[rows[alike]]
        least_s = (free_s + fleet.drawn.zone_costs()).min(axis=1)
        return np.where(np.isfinite(least_s), least_s, self._problem.give_up_s)

    def reach(self) -> dict[str, int]:
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
            zone_cost_s=fleet.drawn.zone_costs(),
            give_up_s=float(self._problem.give_up_s),
        )
