"""A map that is wrong on purpose: it says the same of every slot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from parkenv.errors import InputError
from parkenv.world.occupancy import MAX_PROBABILITY, MIN_PROBABILITY, Arrival, Forecast, PriorModel


@dataclass(frozen=True, eq=False)
class FlatMap:
    """Stands where a `Scenario` wants a `prior`: every slot is as likely to be taken as any other.

    Args:
        p_occupied: what it says, from 0 to 1; forecasts stay within what is allowed of them.
        true: whose rates are kept: how fast sightings grow old is known.

    Raises:
        InputError: no probability.

    Examples:
        >>> from parkenv import Scenario
        >>> mini = make_scenario("mini")
        >>> FlatMap(1.0, mini.occupancy).forecast(Arrival(0.0)).p_occupied[:2].tolist()
        [0.999, 0.999]
    """

    p_occupied: float
    true: PriorModel

    def __post_init__(self) -> None:
        if not 0.0 <= self.p_occupied <= 1.0:
            raise InputError(f"p_occupied is {self.p_occupied}, want a probability")

    @property
    def n_slots(self) -> int:
        """Number of slots."""
        return self.true.n_slots

    def forecast(self, arrival: Arrival) -> Forecast:
        """The same of every slot."""
        said = min(max(self.p_occupied, MIN_PROBABILITY), MAX_PROBABILITY)
        return Forecast(np.full(self.n_slots, said), self.true.forecast(arrival).decay_rate)
