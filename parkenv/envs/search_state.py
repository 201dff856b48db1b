"""The hidden state of a search, as oracles, pictures and recordings read it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import SlotBelief
from parkenv.envs.search_step import (
    ARRIVAL,
    CHOICE,
    FAILED_PARKS,
    FLAGS,
    GAVE_UP_S,
    KEY,
    LOOKED,
    N_TOUCHED,
    OVER,
    PARKED,
    PARKED_WALK_S,
    SAID,
    SEEN,
    TIME,
    VERTEX,
    WHO,
    Search,
    belief_now,
    spot,
)
from parkenv.world.occupancy import Arrival, World
from parkenv.world.recorded_occupancy import RecordedOccupancy
from parkenv.world.scenario import Scenario
from sim_sensors.compilation import compiled


class SearchState:
    """The episode under way, hidden truth included; it goes along with the environment.

    Attributes:
        path: vertices that the car has stopped at, in order.
    """

    def __init__(self, scenario: Scenario, search: Search) -> None:
        self._scenario, self._search = scenario, search
        self.path: list[int] = []
        self._world: tuple[np.uint64, World] | None = None

    def _number(self, column: int) -> float:
        return float(self._search.numbers[0, column])

    def _count(self, column: int) -> int:
        return int(self._search.counts[0, column])

    def come_along(self) -> None:
        """Add to the path where the car is, if it has moved."""
        if self.path[-1] != self.vertex:
            self.path.append(self.vertex)

    @property
    def key(self) -> np.uint64:
        """Key of the world."""
        return np.uint64(self._search.counts.view(np.uint64)[0, KEY])

    @property
    def arrival(self) -> Arrival:
        """When the search began."""
        return arrival_of(self._scenario, self._search, 0)

    @property
    def world(self) -> World:
        """The truth; questions to it change nothing."""
        if self._world is None or self._world[0] != self.key:
            self._world = self.key, self._scenario.occupancy.world(self.key, self.arrival)
        return self._world[1]

    @property
    def belief(self) -> SlotBelief:
        """The belief about the slots now, a copy, in float64."""
        forecast = self._scenario.forecast(self.arrival)
        belief = SlotBelief.of_forecast(forecast.p_occupied, forecast.decay_rate)
        belief.time = self.time - self.arrival.time
        _read_belief(self._search, belief.p_occupied, belief.p_observed, belief.observed_at)
        return belief

    @property
    def vertex(self) -> int:
        """Where the car is."""
        return self._count(VERTEX)

    @property
    def time(self) -> float:
        """Now, s since Monday 00:00."""
        return self._number(TIME)

    @property
    def walk_s(self) -> float:
        """The walk to the goal, s; 0 before the car is parked."""
        return self._number(PARKED_WALK_S)

    @property
    def gave_up_s(self) -> float:
        """What it cost to go elsewhere, s."""
        return self._number(GAVE_UP_S)

    @property
    def failed_parks(self) -> int:
        """Tries at taken slots."""
        return self._count(FAILED_PARKS)

    @property
    def parked(self) -> bool:
        """Whether the car is parked."""
        return self._count(PARKED) == 1

    @property
    def over(self) -> bool:
        """Whether the search is over."""
        return self._count(OVER) == 1


@compiled
def _read_belief(
    search: Search,
    p_occupied: NDArray[np.float64],
    p_observed: NDArray[np.float64],
    observed_at: NDArray[np.float64],
) -> None:
    for column in range(1, search.counts[0, N_TOUCHED] + 1):
        slot = search.marks[0, column, WHO]
        p_occupied[slot] = belief_now(search, 0, column)
        if search.marks[0, column, FLAGS] & SEEN != 0:
            at = spot(column)
            p_observed[slot] = search.memory[0, at + SAID]
            observed_at[slot] = search.memory[0, at + LOOKED] - search.numbers[0, ARRIVAL]


def arrival_of(scenario: Scenario, search: Search, e: int) -> Arrival:
    """When search `e` began."""
    time = float(search.numbers[e, ARRIVAL])
    if isinstance(scenario.occupancy, RecordedOccupancy):
        return Arrival(time, scenario.occupancy.days_in(scenario.arrival)[int(search.counts[e, CHOICE])])
    return Arrival(time)
