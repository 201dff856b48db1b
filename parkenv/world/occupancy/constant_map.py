"""A deliberately wrong forecast: the same probability for every slot."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from parkenv.errors import require_number
from parkenv.world.occupancy.kernel import MAX_PROBABILITY, MIN_PROBABILITY
from parkenv.world.occupancy.process import Arrival, Forecast, PriorModel


@dataclass(frozen=True, eq=False)
class FlatMap:
    """A `prior` of a `Scenario` with the same occupancy probability for every slot.

    Raises:
        InputError: `p_occupied` is not a probability.

    Examples:
        >>> from parkenv import make_scenario
        >>> mini = make_scenario("mini")
        >>> FlatMap(1.0, mini.occupancy).forecast(Arrival(0.0)).p_occupied[:2].tolist()
        [0.999, 0.999]
    """

    p_occupied: float  # the probability, 0 to 1; clipped to the range of forecasts
    true: PriorModel  # provides the decay rates and the day error, which remain correct

    def __post_init__(self) -> None:
        require_number("p_occupied", self.p_occupied, least=0.0, most=1.0)

    @property
    def n_slots(self) -> int:
        """Number of slots."""
        return self.true.n_slots

    def forecast(self, arrival: Arrival) -> Forecast:
        """Forecast the same probability for every slot."""
        p = min(max(self.p_occupied, MIN_PROBABILITY), MAX_PROBABILITY)
        return replace(self.true.forecast(arrival), p_occupied=np.full(self.n_slots, p))
