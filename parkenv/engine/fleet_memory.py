"""Memory of a fleet: the records that the compiled engine works on, and the observations of its cars."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from parkenv.compiled.memory import address_of, sparse_zeros
from parkenv.engine import events, records
from parkenv.engine.fleet_cars import TIMES, FleetCars, FleetOptions
from parkenv.engine.kernel import read_step, step_result_at
from parkenv.engine.local_observation import FIRST_NEAR, PER_NEAR, Surroundings, observe_surroundings_at
from parkenv.engine.records import CAR, FLEET, REPORT, SEARCH, SEARCHING, STATES, STEP, UNGUIDED
from parkenv.engine.search_belief import shared_slots_taken_at
from parkenv.engine.searches import ScenarioRecords, Searches, most_observed_in
from parkenv.engine.spaces import space_of
from parkenv.errors import InputError
from parkenv.world.lot import PARK, ParkingLot
from parkenv.world.occupancy.kernel import SHARED_KIND

_FIRST_CHUNK = 16
_MOST_SEEN = 127  # cars at a vertex, as observed


class StepOutcome(NamedTuple):
    begun: bool  # whether there was a step: not before the first decision
    reward: float
    info: dict[str, Any]  # see `parkenv/Search-v2`


class FleetMemory:
    """The FLEET record, the arrays that it points to, and what cars observe.

    Attributes:
        scenarios: the scenarios of the cars, one for each goal with a weight; see `cars["scenario_index"]`.
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
        self._is_guided = any(kind.knows == "reserve" for kind in self.drivers)
        self._copy_masks = [mask.copy for mask in scenarios[0].graph_masks]
        self._surroundings: dict[int, Surroundings] = {}
        if options.delay_s > 0.0:
            self._grow_reports()

    def _point_to(self, **arrays: NDArray[Any]) -> None:
        self.arrays |= arrays
        for name, array in arrays.items():
            self.record[name] = address_of(array, array.dtype)

    def hold_cars(self, cars: NDArray[np.void], zone_cost_s: NDArray[np.float64] | None) -> None:
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

    def _grow(self, name: str, dtype: np.dtype[Any], least: int, first: int = 0) -> None:
        """Double the room of an array of records, a ring that begins at an index."""
        old = self.arrays.get(name, np.zeros(0, dtype))
        grown = np.zeros(max(2 * len(old), least), dtype)
        grown[: len(old)] = np.roll(old, -first)
        self._point_to(**{name: grown})
        self.record[f"{name[:-1]}_capacity"] = len(grown)

    def _grow_reports(self) -> None:
        least = max(4 * len(self.slots), 2048)
        self._grow("reports", REPORT, least, int(self.record["first_report"]))
        self.record["first_report"] = 0

    def _grow_steps(self) -> None:
        self._grow("steps", STEP, 4096)

    def keep_steps(self) -> None:
        """From now on, keep the steps of all cars; `steps` returns those of the present world."""
        if not self.record["step_capacity"]:
            self._grow_steps()

    @property
    def steps(self) -> NDArray[np.void]:
        return self.arrays.get("steps", np.zeros(0, STEP))[: int(self.record["n_kept_steps"])].copy()

    def take_steps(self) -> NDArray[np.void]:
        """Return the kept steps, and keep only later ones: a day with many cars has more than fit into memory."""
        steps = self.steps
        self.record["n_kept_steps"] = 0
        return steps

    def search_of(self, address: int) -> np.void:
        searches, row = self._rows[int(address)]
        return searches.records[row]  # type: ignore[no-any-return]

    def taken(self) -> NDArray[np.bool_]:
        taken = np.zeros(len(self.slots), np.bool_)
        shared_slots_taken_at(self.address, float(self.record["time"]), taken)
        return taken

    def counts(self) -> NDArray[np.int64]:
        counts, counted = self.taken().astype(np.int64), self.arrays["counted"]["n_cars"]
        counts[len(counts) - len(counted) :] = counted
        return counts

    @property
    def begin(self) -> float:
        return float(self.record["arrival"])

    @property
    def time(self) -> float:
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
        arrays = [*self.arrays.values(), *self._moves]
        return sum(array.nbytes for array in arrays) + sum(searches.n_bytes for searches in self._pool)

    @property
    def observation_space(self) -> spaces.Dict:
        space, lot = space_of(self.scenarios, self._most_observed), self.scenarios[0].lot
        further: dict[str, spaces.Space[Any]] = {}
        if self._is_guided:
            further["reserved"] = spaces.Box(-1, 1, (lot.n_slots,), np.int8)
        if self.scenarios[0].has_rules:
            further["driver"] = spaces.Box(0.0, np.inf, (6,), np.float64)
        if self.options.sees_cars:
            further["cars"] = spaces.Box(0, _MOST_SEEN, (2, lot.n_vertices), np.int8)
        return spaces.Dict(dict(space.items()) | further)

    def observation(self, car: int) -> dict[str, Any]:
        address, vertex = self._search_of(car), self._vertices[car]
        time, p_occupied, belief, step_observed, day_error = self.copiers[address]
        observation = {
            "vertex": vertex,
            "time": time(),
            "p_occupied": p_occupied(),
            "belief": belief(),
            "step_observed": step_observed(),
            "day_error": day_error(),
            "action_mask": self._mask(car, vertex),
        }
        searches, row = self._rows[address]
        if (copy_cues := searches.copier_of_cues(row)) is not None:
            observation["cues"] = copy_cues()
        if self._is_guided:
            reserved = self.search_of(address)["reserved"]
            own = np.arange(len(self.slots)) == reserved
            observation["reserved"] = own.astype(np.int8) - np.int8(reserved == UNGUIDED)
        if self.scenarios[0].has_rules:
            driver = *self.drawn.drivers_of(car), self.cars["walks"][car]
            observation["driver"] = np.array(driver, np.float64)
        if self.options.sees_cars:
            observation["cars"] = self._cars_in_view(car, int(vertex))
        return observation

    def local_observation(self, car: int, k: int = 5) -> dict[str, Any]:
        """Return the `local` observation of a searching car, with k slots; to be called once at each of its decisions.

        `parkenv.engine.local_observation` describes it.
        """
        address = self._search_of(car)
        if k not in self._surroundings:
            self._surroundings[k] = Surroundings.of(self.scenarios, k)
        local = np.empty(FIRST_NEAR + PER_NEAR * k, np.float32)
        observe_surroundings_at(address, self._surroundings[k], local)
        return {"local": local, "action_mask": self._mask(car, self._vertices[car])}

    def outcome(self, car: int) -> StepOutcome:
        address = self._search_of(car)
        reward, _, _, info = read_step(int(self.cars["scenario_index"][car]), step_result_at(address))
        return StepOutcome(bool(self.search_of(address)["n_steps"]), reward, info)

    def _search_of(self, car: int) -> int:
        address = int(self._addresses[car])
        if address == 0:
            state = STATES[self.cars["state"][car]]
            raise InputError(f"car {car} is {state}, want one that searches")
        if address not in self.copiers:
            raise InputError("observations are kept only if a kind of driver has no policy")
        return address

    def _mask(self, car: int, vertex: int) -> NDArray[np.int8]:
        mask: NDArray[np.int8] = self._copy_masks[vertex]()
        if mask[PARK] and self.drawn.zone_cost_s is not None:
            mask[PARK] = np.isfinite(self.drawn.zone_cost_s[car, self.scenarios[0].lot.zone_of_slot[vertex]])
        return mask

    def _cars_in_view(self, car: int, vertex: int) -> NDArray[np.int8]:
        cars, lot = self.cars, self.scenarios[0].lot
        others = cars["state"] == SEARCHING
        others[car] = False
        at, stands = cars["vertex"][others], cars["stands"][others]
        away = lot.vertex_xy[at] - lot.vertex_xy[vertex]
        near = np.hypot(*away.T) <= self.scenarios[0].sensor_model.view_range
        counts = [np.bincount(at[which], minlength=lot.n_vertices) for which in (near, near & stands)]
        return np.minimum(counts, _MOST_SEEN).astype(np.int8)


def _counted(lot: ParkingLot) -> NDArray[Any]:
    facilities = [facility for facility in lot.facilities if facility.is_counted]
    counted = np.zeros(len(facilities), records.COUNTED)
    for name in ("capacity", "gate_s", "inside_s", "delay_s"):
        counted[name] = [getattr(facility, name) for facility in facilities] or counted[name]
    return counted
