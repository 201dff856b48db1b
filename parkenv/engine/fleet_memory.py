"""Memory of a fleet: the records that the compiled engine works on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.memory import address_of, sparse_zeros
from parkenv.engine import events, records
from parkenv.engine.fleet_cars import FleetCars
from parkenv.engine.fleet_options import TIMES, FleetOptions
from parkenv.engine.records import CAR, FLEET, REPORT, SEARCH, STEP
from parkenv.engine.searches import ScenarioRecords, Searches, most_observed_in
from parkenv.engine.shared_slots import shared_slots_taken_at
from parkenv.world.lot import ParkingLot
from parkenv.world.occupancy.kernel import SHARED_KIND

_FIRST_CHUNK = 16


class FleetMemory:
    """The FLEET record, and the arrays that it points to.

    Args:
        drawn: the cars as the demand draws them.
        options: the options of the fleet.

    Attributes:
        scenarios: the scenarios of the cars, one for each goal with a weight; see `cars["scenario_index"]`.
        record: the FLEET record.
        address: its address, for compiled code.
        world: address of the occupancy that the background is drawn from; 0 if Python makes it.
        arrays: by field of the record, the array that it points to.
        slots: (n_slots,) of the dtype SHARED_SLOT.
        cars: (n_cars,) of the dtype CAR, in order of arrival.
        copiers: by address of a SEARCH record, what copies its observation; see `Searches.copiers`.
    """

    def __init__(self, drawn: FleetCars, options: FleetOptions) -> None:
        self.drawn, self.options, self.drivers = drawn, options, options.drivers
        scenarios = self.scenarios = drawn.scenarios
        lot, self._records = scenarios[0].lot, np.zeros(1, FLEET)
        self.record, self.address = self._records[0], address_of(self._records, FLEET)
        # A car may learn of every slot at once, and attempt one.
        learns_all = any(kind.knows in ("shared", "full") for kind in self.drivers)
        self._most_observed = 1 + lot.n_slots if learns_all else most_observed_in(scenarios)
        self._observes = any(kind.policy is None for kind in self.drivers)
        self._tables = ScenarioRecords(scenarios)
        tables = self._tables.records
        self.record["world_kind"], self.world = tables[0]["world_kind"], int(tables[0]["world"])
        tables["world_kind"], tables["world"] = SHARED_KIND, self.address
        tables["leave_full_lot"] = options.leave_full_lot
        if scenarios[0].has_rules:
            # Where a car may park depends on its driver.
            self._masks = np.ascontiguousarray(scenarios[0].graph_masks, np.uint8)
            tables["action_masks"] = address_of(self._masks, np.uint8)
        policies = (kind.policy for kind in self.drivers)
        self._policies = [None if policy is None else policy.data_for(scenarios) for policy in policies]
        numbers = {
            "background": records.BACKGROUNDS.index(options.background),
            "max_steps": options.max_steps,
            "n_slots": lot.n_slots,
            "n_vertices": lot.n_vertices,
            "first_counted": lot.n_slots - np.count_nonzero(lot.is_counted),
            "scenarios": tables.ctypes.data,
            **{name: getattr(options, name) for name in TIMES},
        }
        for name, number in numbers.items():
            self.record[name] = number
        self.slots, self.cars = np.zeros(lot.n_slots, records.SHARED_SLOT), np.zeros(0, CAR)
        cost_s = np.array([scenario.arrival_cost_s for scenario in scenarios])
        self.arrays: dict[str, NDArray[Any]] = {}
        self._point_to(
            slots=self.slots,
            live_map=np.zeros(lot.n_slots, records.LIVE_SLOT),
            blocked_until=np.zeros(lot.n_vertices),
            blocked_by=np.zeros(lot.n_vertices, np.int64),
            junction_of_vertex=lot.junction_of_vertex,
            by_cost=np.argsort(cost_s, axis=1, kind="stable").astype(np.int64),
            counted=_counted(lot),
            policy_data=np.array([data.address if data else 0 for data in self._policies], np.int64),
        )
        self._pool: list[Searches] = []
        self._moves: list[NDArray[np.uint8]] = []
        self._rows: dict[int, tuple[Searches, int]] = {}
        self.copiers: dict[int, tuple[Callable[[], NDArray[Any]], ...]] = {}
        self._requests: dict[int, Callable[[], None]] = {
            events.NEEDS_SEARCH: self._add_searches,
            events.NEEDS_FORECAST: self._compute_forecast,
            events.NEEDS_REPORTS: self._grow_reports,
            events.NEEDS_STEPS: self._grow_steps,
        }
        if options.delay_s > 0.0:
            self._grow_reports()

    def _point_to(self, **arrays: NDArray[Any]) -> None:
        """Keep arrays alive, and write their addresses into the fields of the record."""
        self.arrays |= arrays
        for name, array in arrays.items():
            self.record[name] = address_of(array, array.dtype)

    def hold_cars(self, cars: NDArray[np.void], zone_cost_s: NDArray[np.float64] | None) -> None:
        """Point to the cars of a world; no car has a search."""
        self.cars, n = cars, len(cars)
        # Looking up fields takes a tenth of a decision in Python.
        self._states, self._vertices, self._addresses = cars["state"], cars["vertex"], cars["search"]
        self.record["n_cars"], self.record["n_free"], self.record["zone_cost_s"] = n, 0, 0
        if zone_cost_s is not None:
            self._point_to(zone_cost_s=zone_cost_s)
            self.record["n_zones"] = zone_cost_s.shape[1]
        self._point_to(
            cars=cars,
            step_times=np.zeros(n),
            step_cars=np.zeros(n, np.int32),
            departure_times=np.zeros(n),
            departing_cars=np.zeros(n, np.int32),
            event_ranks=np.zeros(n, np.int64),
            ready=np.zeros(n, np.int64),
            free_searches=np.zeros(max(n, len(self._rows)), np.int64),
        )
        for searches in self._pool:
            self._add_free(searches)

    def serve_request(self, status: int) -> None:
        """Serve a request of the compiled engine, a negative status of `advance_at`."""
        self._requests[status]()

    def _add_free(self, searches: Searches) -> None:
        first, n = int(self.record["n_free"]), len(searches.records)
        addresses = searches.address + np.arange(n)[::-1] * SEARCH.itemsize
        self.arrays["free_searches"][first : first + n] = addresses
        self.record["n_free"] = first + n

    def _add_searches(self) -> None:
        size = len(self._rows)
        n = min(max(_FIRST_CHUNK, size), max(int(self.record["n_cars"]) - size, 1))
        lot, most = self.scenarios[0].lot, self._most_observed if self._observes else 0
        searches = Searches(self._tables, n, self._observes, most, lot.n_slots >= records.SPARSE_SLOTS)
        # A route may pass the street where it begins once more.
        moves = sparse_zeros((n, 2 * lot.n_vertices), np.uint8)
        searches.records["moves"] = address_of(moves, np.uint8) + np.arange(n) * moves.shape[1]
        self._pool.append(searches)
        self._moves.append(moves)
        for row in range(n):
            address = searches.address + row * SEARCH.itemsize
            self._rows[address] = searches, row
            if self._observes:
                self.copiers[address] = searches.copiers(row)
        self._add_free(searches)

    def _compute_forecast(self) -> None:
        searches, row = self._rows[int(self.cars["search"][self.record["pending"]])]
        searches.complete_arrival(row)
        events.init_forecast_at(self.address)

    def _grow_reports(self) -> None:
        first, n = int(self.record["first_report"]), int(self.record["n_reports"])
        old = self.arrays.get("reports", np.zeros(0, REPORT))
        reports = np.zeros(2 * max(len(old), 2 * len(self.slots), 1024), REPORT)
        reports[:n] = np.roll(old, -first)[:n]
        self._point_to(reports=reports)
        self.record["first_report"], self.record["report_capacity"] = 0, len(reports)

    def _grow_steps(self) -> None:
        old = self.arrays.get("steps", np.zeros(0, STEP))
        steps = np.zeros(max(2 * len(old), 4096), STEP)
        steps[: len(old)] = old
        self._point_to(steps=steps)
        self.record["step_capacity"] = len(steps)

    def keep_steps(self) -> None:
        """From now on, keep the steps of all cars; `steps` returns those of the present world."""
        if not self.record["step_capacity"]:
            self._grow_steps()

    @property
    def steps(self) -> NDArray[np.void]:
        """Steps of all cars since `keep_steps`, (n,) of the dtype STEP, in order of their beginning."""
        return self.arrays.get("steps", np.zeros(0, STEP))[: int(self.record["n_kept_steps"])].copy()

    def take_steps(self) -> NDArray[np.void]:
        """Return the kept steps, and keep only later ones: a day with many cars has more than fit into memory."""
        steps = self.steps
        self.record["n_kept_steps"] = 0
        return steps

    def search_of(self, address: int) -> np.void:
        """Return the SEARCH record at an address, a live view."""
        searches, row = self._rows[int(address)]
        record: np.void = searches.records[row]
        return record

    def taken(self) -> NDArray[np.bool_]:
        """Return whether each slot is taken now, (n_slots,)."""
        taken = np.zeros(len(self.slots), np.bool_)
        shared_slots_taken_at(self.address, float(self.record["time"]), taken)
        return taken

    def counts(self) -> NDArray[np.int64]:
        """Return how many cars are in each slot now, (n_slots,): at most 1, but for counted facilities."""
        counts, counted = self.taken().astype(np.int64), self.arrays["counted"]["n_cars"]
        counts[len(counts) - len(counted) :] = counted
        return counts

    @property
    def begin(self) -> float:
        """When the world began, s since Monday 00:00."""
        return float(self.record["arrival"])

    @property
    def time(self) -> float:
        """The time now, s since Monday 00:00."""
        return float(self.record["time"])

    @property
    def totals(self) -> dict[str, float]:
        """Numbers of cars now: due, searching, parked, gone; decisions so far; integrals of cars over time, s."""
        record = self.record
        counts = {name: float(record[f"n_{name}"]) for name in ("searching", "parked", "gone", "decisions")}
        sums = {name: float(record[name]) for name in ("searching_s", "parked_s")}
        return {"due": float(record["n_cars"] - record["next_car"])} | counts | sums

    @property
    def n_bytes(self) -> int:
        """Memory of cars, slots and searches, bytes, without the tables of the scenario."""
        arrays = [*self.arrays.values(), *self._moves]
        return sum(array.nbytes for array in arrays) + sum(searches.n_bytes for searches in self._pool)


def _counted(lot: ParkingLot) -> NDArray[Any]:
    facilities = [facility for facility in lot.facilities if facility.is_counted]
    counted = np.zeros(len(facilities), records.COUNTED)
    for name in ("capacity", "gate_s", "inside_s", "delay_s"):
        counted[name] = [getattr(facility, name) for facility in facilities] or counted[name]
    return counted
