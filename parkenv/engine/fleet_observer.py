"""What the cars of a fleet observe."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from parkenv.engine.fleet_cars import FleetCars
from parkenv.engine.fleet_memory import FleetMemory
from parkenv.engine.fleet_options import FleetOptions
from parkenv.engine.kernel import read_step, step_result_at
from parkenv.engine.local_observation import FIRST_NEAR, PER_NEAR, Surroundings, observe_surroundings_at
from parkenv.engine.records import SEARCHING, STATES, UNGUIDED
from parkenv.engine.spaces import space_of
from parkenv.errors import InputError
from parkenv.world.lot import PARK

_MOST_SEEN = 127  # cars at a vertex, as observed


class StepOutcome(NamedTuple):
    """The result of a car's last step."""

    begun: bool  # whether there was a step: not before the first decision
    reward: float
    over: bool  # whether the search is over, but for the limit of steps
    info: dict[str, Any]  # see `parkenv/Search-v2`


class FleetObserver:
    """Observations of the cars of a fleet, and results of their steps.

    Args:
        cars: the cars.
        memory: their searches, which hold observations if a kind of driver has no policy.
        options: the options of the fleet.
        most_observed: maximum number of slots that a step observes.
    """

    def __init__(
        self, cars: FleetCars, memory: FleetMemory, options: FleetOptions, most_observed: int
    ) -> None:
        self._cars, self._memory, self._options = cars, memory, options
        self._problem, self._most_observed = cars.scenarios[0], most_observed
        self._is_guided = options.has_drivers_that_know("reserve")
        self._copy_masks = [mask.copy for mask in self._problem.graph_masks]
        self._surroundings: dict[int, Surroundings] = {}

    @property
    def space(self) -> spaces.Dict:
        space, lot = space_of(self._cars.scenarios, self._most_observed), self._problem.lot
        further: dict[str, spaces.Space[Any]] = {}
        if self._is_guided:
            further["reserved"] = spaces.Box(-1, 1, (lot.n_slots,), np.int8)
        if self._options.leaving_soon_s > 0.0:
            further["leaving"] = spaces.Box(0, 1, (lot.n_slots,), np.int8)
        if self._problem.has_rules:
            further["driver"] = spaces.Box(0.0, np.inf, (6,), np.float64)
        if self._options.sees_cars:
            further["cars"] = spaces.Box(0, _MOST_SEEN, (2, lot.n_vertices), np.int8)
        return spaces.Dict(dict(space.items()) | further)

    def begin(self) -> None:
        """Observe the cars of a new world."""
        # Looking up fields takes a tenth of a decision in Python.
        self._vertices, self._addresses = self._cars.records["vertex"], self._cars.records["search"]

    def observe(self, car: int) -> dict[str, Any]:
        """Return what a searching car observed last."""
        address, vertex = self._search_of(car), self._vertices[car]
        time, p_occupied, belief, step_observed, day_error = self._memory.copiers[address]
        observation = {
            "vertex": vertex,
            "time": time(),
            "p_occupied": p_occupied(),
            "belief": belief(),
            "step_observed": step_observed(),
            "day_error": day_error(),
            "action_mask": self._mask(car, vertex),
        }
        if self._is_guided:
            reserved = self._memory.search_of(address)["reserved"]
            own = np.arange(len(self._memory.slots)) == reserved
            observation["reserved"] = own.astype(np.int8) - np.int8(reserved == UNGUIDED)
        if self._options.leaving_soon_s > 0.0:
            observation["leaving"] = self._leaving_in_view(int(vertex))
        if self._problem.has_rules:
            driver = *self._cars.drivers_of(car), self._cars.records["walks"][car]
            observation["driver"] = np.array(driver, np.float64)
        if self._options.sees_cars:
            observation["cars"] = self._cars_in_view(car, int(vertex))
        return observation

    def observe_local(self, car: int, k: int) -> dict[str, Any]:
        """Return the `local` observation of a searching car, with k slots; once at each of its decisions."""
        address = self._search_of(car)
        if k not in self._surroundings:
            self._surroundings[k] = Surroundings.of(self._cars.scenarios, k)
        local = np.empty(FIRST_NEAR + PER_NEAR * k, np.float32)
        observe_surroundings_at(address, self._surroundings[k], local)
        return {"local": local, "action_mask": self._mask(car, self._vertices[car])}

    def outcome(self, car: int) -> StepOutcome:
        address = self._search_of(car)
        scenario = self._cars.scenarios[self._cars.records["place"][car]]
        reward, over, _, info = read_step(scenario.name, step_result_at(address))
        return StepOutcome(bool(self._memory.search_of(address)["n_steps"]), reward, over, info)

    def _search_of(self, car: int) -> int:
        address = int(self._addresses[car])
        if address == 0:
            state = STATES[self._cars.records["state"][car]]
            raise InputError(f"car {car} is {state}, want one that searches")
        if address not in self._memory.copiers:
            raise InputError("observations are kept only if a kind of driver has no policy")
        return address

    def _mask(self, car: int, vertex: int) -> NDArray[np.int8]:
        """Return the actions that a car has at a vertex, (5,): those of the graph, and parking where it may."""
        mask: NDArray[np.int8] = self._copy_masks[vertex]()
        if mask[PARK] and self._cars.zone_cost_s is not None:
            mask[PARK] = np.isfinite(self._cars.zone_cost_s[car, self._problem.lot.zone_of_slot[vertex]])
        return mask

    def _leaving_in_view(self, vertex: int) -> NDArray[np.int8]:
        slots = self._memory.slots
        leaving, viewed = np.zeros(len(slots), np.int8), self._problem.in_view(vertex)
        left_s = slots["leaves_at"][viewed] - self._memory.record["time"]
        leaving[viewed] = (left_s > 0.0) & (left_s <= self._options.leaving_soon_s)
        return leaving

    def _cars_in_view(self, car: int, vertex: int) -> NDArray[np.int8]:
        """Return the numbers of other searching cars by vertex, and of those that stand, (2, n_vertices)."""
        cars, lot = self._cars.records, self._problem.lot
        others = cars["state"] == SEARCHING
        others[car] = False
        at, stands = cars["vertex"][others], cars["stands"][others]
        away = lot.vertex_xy[at] - lot.vertex_xy[vertex]
        near = np.hypot(*away.T) <= self._problem.sensor_model.view_range
        counts = [np.bincount(at[which], minlength=lot.n_vertices) for which in (near, near & stands)]
        return np.minimum(counts, _MOST_SEEN).astype(np.int8)
