"""The cars of a fleet as the agents of a multi-agent environment: what PettingZoo's two forms have in common."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from parkenv.engine.fleet import MAX_STEPS, DriverKind, Fleet
from parkenv.errors import InputError
from parkenv.scenarios.build import ScenarioSource, make_scenario
from parkenv.world.demand import MAX_CARS, Demand, Headways
from parkenv.world.lot import ACTIONS

if TYPE_CHECKING:
    from parkenv.show.frames.fleet import FleetRenderer

Observation = Mapping[str, Any]
MAX_CYCLES = MAX_STEPS
_FLEET_OPTIONS = ("delay_s", "leave_full_lot", "manoeuvre_s", "leaving_soon_s", "sees_cars")
METADATA: dict[str, Any] = {
    "name": "lot_v0",
    "render_modes": ["human", "rgb_array"],
    "render_fps": 8,
    "is_parallelizable": False,
}


class FleetAgents:
    """A fleet whose cars are all decided from outside.

    Args:
        scenario: as of `parkenv.make_scenario`.
        cars: number of cars, if there is no `demand`.
        demand: when cars arrive, how long they stay.
        background: as of `parkenv.engine.fleet.Fleet`.
        max_cycles: limit of a car's decisions.
        tick_s: as of `Fleet`.
        render_mode: `human`, `rgb_array` or None.
        knows: what all cars know, as of `parkenv.engine.fleet.DriverKind`; with `shared`, all share.
        changes: fields of the scenario to replace, and further options of `Fleet`: `delay_s`, `leave_full_lot`,
            `manoeuvre_s`, `leaving_soon_s`, `sees_cars`.

    Attributes:
        possible_agents: `car_0`, `car_1`, ... in order of arrival, as many as may arrive.

    Raises:
        InputError: a value out of its range; the message names it.
    """

    def __init__(
        self,
        scenario: ScenarioSource,
        cars: int,
        demand: Demand | None,
        background: str,
        max_cycles: int,
        tick_s: float,
        render_mode: str | None,
        knows: str,
        changes: Mapping[str, Any],
    ) -> None:
        if render_mode is not None and render_mode not in METADATA["render_modes"]:
            raise InputError(f"render_mode is {render_mode!r}, want one of {METADATA['render_modes']}")
        if demand is None:
            if isinstance(cars, bool) or not isinstance(cars, (int, np.integer)) or not 1 <= cars <= MAX_CARS:
                raise InputError(f"cars is {cars!r}, want a whole number from 1 to {MAX_CARS:,}")
            demand = Demand(Headways(int(cars)))
        if isinstance(max_cycles, bool) or not isinstance(max_cycles, (int, np.integer)) or max_cycles < 1:
            raise InputError(f"max_cycles is {max_cycles!r}, want a whole number of at least 1")
        options = {name: value for name, value in changes.items() if name in _FLEET_OPTIONS}
        fields = {name: value for name, value in changes.items() if name not in options}
        self.fleet = Fleet(
            make_scenario(scenario, **fields),
            demand,
            background=background,
            drivers=[DriverKind(knows=knows, shares=knows == "shared")],
            max_steps=max_cycles,
            tick_s=tick_s,
            **options,
        )
        self.render_mode = render_mode
        self.possible_agents = [f"car_{i}" for i in range(demand.arrivals.most)]
        self._observation_space = self.fleet.observation_space
        self._observation_spaces: dict[str, spaces.Dict] = {}
        self._action_spaces: dict[str, spaces.Discrete] = {}
        self._seed: int | None = None
        self._episode = 0
        self._renderer: FleetRenderer | None = None

    def observation_space(self, agent: str) -> spaces.Dict:
        """Return the space of an agent's observations, always the same object; that of `parkenv/Search-v2`."""
        if agent not in self._observation_spaces:
            self._observation_spaces[agent] = spaces.Dict(dict(self._observation_space.items()))
        return self._observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Discrete:
        """Return the space of an agent's actions, always the same object."""
        if agent not in self._action_spaces:
            self._action_spaces[agent] = spaces.Discrete(len(ACTIONS))
        return self._action_spaces[agent]

    def begin(self, seed: int | None) -> list[str]:
        """Begin the next world, and return its agents: the first of a seed, or the next one of the last seed."""
        if seed is not None:
            self._seed, self._episode = int(seed), 0
        elif self._seed is None:
            self._seed = int(np.random.SeedSequence().generate_state(1)[0])
        else:
            self._episode += 1
        self.fleet.reset(self._seed, self._episode)
        return self.possible_agents[: len(self.fleet.cars)]

    def blank_observation(self, car: int) -> dict[str, Any]:
        """Return the observation of a car that has not arrived: at its entry, nothing known, no action possible."""
        boxes = {name: one for name, one in self._observation_space.items() if isinstance(one, spaces.Box)}
        blank: dict[str, Any] = {name: np.zeros(box.shape, box.dtype) for name, box in boxes.items()}
        blank["vertex"] = np.int64(self.fleet.cars["entry"][car])
        blank["p_occupied"][:] = 1.0
        parts = blank["belief"].reshape(4, -1)
        parts[0], parts[2], parts[3] = 1.0, 1.0, -1.0
        return blank

    def render(self) -> NDArray[np.uint8] | None:
        """Return a frame from above, (480, 640, 3) uint8 RGB, or show it in a window, depending on `render_mode`."""
        if self.render_mode is None:
            gym.logger.warn('render() does nothing without a render_mode, e.g. env(render_mode="rgb_array")')
            return None
        if self._renderer is None:
            from parkenv.show.frames.fleet import FleetRenderer

            self._renderer = FleetRenderer(self.fleet)
        frame = self._renderer.frame()
        if self.render_mode == "rgb_array":
            return frame
        self._renderer.window.show(frame, METADATA["render_fps"])
        return None

    def close(self) -> None:
        """Close the window, if open."""
        if self._renderer is not None:
            self._renderer.window.close()
            self._renderer = None


def car_of(agent: str) -> int:
    """Return the index of an agent's car.

    >>> car_of("car_12")
    12
    """
    return int(agent.rpartition("_")[2])
