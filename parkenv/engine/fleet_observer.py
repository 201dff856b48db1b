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


class ObservedFleet(FleetMemory):
    """The memory of a fleet, observations of its cars, and results of their steps."""

    def __init__(self, drawn: FleetCars, options: FleetOptions) -> None:
        super().__init__(drawn, options)
        self._problem = drawn.scenarios[0]
        self._is_guided = any(kind.knows == "reserve" for kind in self.drivers)
        self._copy_masks = [mask.copy for mask in self._problem.graph_masks]
        self._surroundings: dict[int, Surroundings] = {}

    @property
    def observation_space(self) -> spaces.Dict:
        """The space of a car's observations: that of `parkenv/Search-v2`, and further keys; see `Fleet`."""
        space, lot = space_of(self.scenarios, self._most_observed), self._problem.lot
        further: dict[str, spaces.Space[Any]] = {}
        if self._is_guided:
            further["reserved"] = spaces.Box(-1, 1, (lot.n_slots,), np.int8)
        if self.options.leaving_soon_s > 0.0:
            further["leaving"] = spaces.Box(0, 1, (lot.n_slots,), np.int8)
        if self._problem.has_rules:
            further["driver"] = spaces.Box(0.0, np.inf, (6,), np.float64)
        if self.options.sees_cars:
            further["cars"] = spaces.Box(0, _MOST_SEEN, (2, lot.n_vertices), np.int8)
        return spaces.Dict(dict(space.items()) | further)

    def observation(self, car: int) -> dict[str, Any]:
        """Return what a searching car observed last, as in `parkenv/Search-v2`."""
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
        if self._is_guided:
            reserved = self.search_of(address)["reserved"]
            own = np.arange(len(self.slots)) == reserved
            observation["reserved"] = own.astype(np.int8) - np.int8(reserved == UNGUIDED)
        if self.options.leaving_soon_s > 0.0:
            observation["leaving"] = self._leaving_in_view(int(vertex))
        if self._problem.has_rules:
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
        """Return the result of a car's last step."""
        address = self._search_of(car)
        scenario = self.scenarios[self.cars["scenario_index"][car]]
        reward, over, _, info = read_step(scenario.name, step_result_at(address))
        return StepOutcome(bool(self.search_of(address)["n_steps"]), reward, over, info)

    def _search_of(self, car: int) -> int:
        address = int(self._addresses[car])
        if address == 0:
            state = STATES[self.cars["state"][car]]
            raise InputError(f"car {car} is {state}, want one that searches")
        if address not in self.copiers:
            raise InputError("observations are kept only if a kind of driver has no policy")
        return address

    def _mask(self, car: int, vertex: int) -> NDArray[np.int8]:
        """Return the actions that a car has at a vertex, (5,): those of the graph, and parking where it may."""
        mask: NDArray[np.int8] = self._copy_masks[vertex]()
        if mask[PARK] and self.drawn.zone_cost_s is not None:
            mask[PARK] = np.isfinite(self.drawn.zone_cost_s[car, self._problem.lot.zone_of_slot[vertex]])
        return mask

    def _leaving_in_view(self, vertex: int) -> NDArray[np.int8]:
        slots = self.slots
        leaving, viewed = np.zeros(len(slots), np.int8), self._problem.in_view(vertex)
        left_s = slots["leaves_at"][viewed] - self.record["time"]
        leaving[viewed] = (left_s > 0.0) & (left_s <= self.options.leaving_soon_s)
        return leaving

    def _cars_in_view(self, car: int, vertex: int) -> NDArray[np.int8]:
        """Return the numbers of other searching cars by vertex, and of those that stand, (2, n_vertices)."""
        cars, lot = self.cars, self._problem.lot
        others = cars["state"] == SEARCHING
        others[car] = False
        at, stands = cars["vertex"][others], cars["stands"][others]
        away = lot.vertex_xy[at] - lot.vertex_xy[vertex]
        near = np.hypot(*away.T) <= self._problem.sensor_model.view_range
        counts = [np.bincount(at[which], minlength=lot.n_vertices) for which in (near, near & stands)]
        return np.minimum(counts, _MOST_SEEN).astype(np.int8)
