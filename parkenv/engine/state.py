"""The full state of a search, for oracle policies, rendering and recording."""

from typing import Any

import numpy as np

from parkenv.belief.slot_belief import SlotBelief
from parkenv.engine.kernel import read_belief_at
from parkenv.engine.records import SEARCH
from parkenv.engine.searches import Searches, arrival_of
from parkenv.world.occupancy.process import Arrival, World
from parkenv.world.scenario import Scenario


def _field(name: str, kind: type) -> Any:
    return property(lambda state: kind(state._record[name]))


class SearchState:
    """The current episode of a search, including the hidden occupancy; a live view of the environment.

    Attributes:
        path: vertices where the car has stopped, in order.
    """

    def __init__(self, searches: Searches, index: int = 0) -> None:
        self._searches, self._index = searches, index
        self._record = searches.records[index]
        self.path: list[int] = []
        self._world: tuple[np.uint64, World] | None = None

    def __setstate__(self, content: dict[str, Any]) -> None:
        vars(self).update(content)
        self._record = self._searches.records[self._index]

    @property
    def scenario(self) -> Scenario:
        return self._searches.scenario_of(self._index)

    def extend_path(self) -> None:
        if not self.path or self.path[-1] != self.vertex:
            self.path.append(self.vertex)

    @property
    def key(self) -> np.uint64:
        return np.uint64(self._record["key"])

    @property
    def arrival(self) -> Arrival:
        return arrival_of(self.scenario, self._record)

    @property
    def world(self) -> World:
        if self._world is None or self._world[0] != self.key:
            self._world = self.key, self.scenario.occupancy.world(self.key, self.arrival)
        return self._world[1]

    @property
    def belief(self) -> SlotBelief:
        forecast = self.scenario.forecast(self.arrival)
        belief = SlotBelief.of_forecast(
            forecast.p_occupied, forecast.decay_rate, (forecast.day_error.level, forecast.day_error.slope)
        )
        belief.time = self.time - self.arrival.time
        address = self._searches.address + self._index * SEARCH.itemsize
        if len(self._searches.cues):
            belief.cues = self._searches.cues[self._index].ravel()
        read_belief_at(address, belief.p_occupied, belief.p_observed, belief.observed_at)
        return belief

    @property
    def total_s(self) -> float:
        return float(self._record["costs"].sum())

    vertex = _field("vertex", int)
    time = _field("time", float)  # s since Monday 00:00
    walk_s = _field("walk_s", float)  # to the goal; 0 before the car is parked
    parking_cost_s = _field("parking_cost_s", float)
    driven_m = _field("driven_m", float)
    failed_parks = _field("failed_parks", int)
    parked = _field("parked", bool)
    over = _field("over", bool)
