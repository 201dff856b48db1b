"""The full state of a search, for oracle policies, rendering and recording."""

from __future__ import annotations

import numpy as np

from parkenv.belief.slot_belief import SlotBelief
from parkenv.engine.kernel import read_belief_at
from parkenv.engine.records import SEARCH, Searches, arrival_of
from parkenv.world.occupancy.process import Arrival, World
from parkenv.world.scenario import Scenario


class SearchState:
    """The current episode of a search, including the hidden occupancy; a live view of the environment.

    Args:
        searches: the searches of the environment.
        index: number of the search.

    Attributes:
        path: vertices where the car has stopped, in order.
    """

    def __init__(self, searches: Searches, index: int = 0) -> None:
        self._searches, self._index = searches, index
        self._record = searches.records[index]
        self.path: list[int] = []
        self._world: tuple[np.uint64, World] | None = None

    @property
    def scenario(self) -> Scenario:
        """Scenario of the episode."""
        return self._searches.scenario_of(self._index)

    def extend_path(self) -> None:
        """Add the car's vertex to the path if the car has moved."""
        if not self.path or self.path[-1] != self.vertex:
            self.path.append(self.vertex)

    @property
    def key(self) -> np.uint64:
        """Key of the world."""
        return np.uint64(self._record["key"])

    @property
    def arrival(self) -> Arrival:
        """When the search began."""
        return arrival_of(self.scenario, self._record)

    @property
    def world(self) -> World:
        """The true occupancy; queries do not change it."""
        if self._world is None or self._world[0] != self.key:
            self._world = self.key, self.scenario.occupancy.world(self.key, self.arrival)
        return self._world[1]

    @property
    def belief(self) -> SlotBelief:
        """A float64 copy of the current belief about the slots."""
        forecast = self.scenario.forecast(self.arrival)
        belief = SlotBelief.of_forecast(
            forecast.p_occupied, forecast.decay_rate, (forecast.day_error.level, forecast.day_error.slope)
        )
        belief.time = self.time - self.arrival.time
        address = self._searches.address + self._index * SEARCH.itemsize
        read_belief_at(address, belief.p_occupied, belief.p_observed, belief.observed_at)
        return belief

    @property
    def vertex(self) -> int:
        """Current vertex of the car."""
        return int(self._record["vertex"])

    @property
    def time(self) -> float:
        """Current time, s since Monday 00:00."""
        return float(self._record["time"])

    @property
    def walk_s(self) -> float:
        """Walk to the goal, s; 0 before the car is parked."""
        return float(self._record["walk_s"])

    @property
    def parking_cost_s(self) -> float:
        """Parking cost, s; 0 before the car is parked."""
        return float(self._record["parking_cost_s"])

    @property
    def total_s(self) -> float:
        """Total time so far, s: the sum of all costs."""
        return float(self._record["costs"].sum())

    @property
    def driven_m(self) -> float:
        """Length of the edges driven along, m."""
        return float(self._record["driven_m"])

    @property
    def failed_parks(self) -> int:
        """Number of failed parking attempts."""
        return int(self._record["failed_parks"])

    @property
    def parked(self) -> bool:
        """Whether the car has parked."""
        return bool(self._record["parked"])

    @property
    def over(self) -> bool:
        """Whether the search is over."""
        return bool(self._record["over"])
