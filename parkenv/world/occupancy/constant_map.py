"""A deliberately wrong forecast: the same probability for every slot."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from parkenv.files.field_types import Probability, Validated
from parkenv.world.occupancy.arrival_window import ArrivalWindow
from parkenv.world.occupancy.day_error import DayError
from parkenv.world.occupancy.kernel import EXTERNAL_KIND, MAX_PROBABILITY, MIN_PROBABILITY, PROCESS_KIND
from parkenv.world.occupancy.process import Arrival, CompiledModel, Forecast, OccupancyModel, PriorModel


@dataclass(frozen=True, eq=False)
class ConstantForecast(Validated, PriorModel):
    """A `prior` of a `Scenario` with the same occupancy probability for every slot.

    Examples:
        >>> from parkenv import make_scenario
        >>> mini = make_scenario("mini")
        >>> ConstantForecast(1.0, mini.occupancy).forecast(Arrival(0.0)).p_occupied[:2].tolist()
        [0.999, 0.999]
    """

    p_occupied: Probability  # the probability, 0 to 1; clipped to the range of forecasts
    true: PriorModel  # provides the decay rates and the day error, which remain correct

    @property
    def kind(self) -> int:  # type: ignore[override]
        return PROCESS_KIND if self.true.kind == PROCESS_KIND else EXTERNAL_KIND

    def compiled(self, window: ArrivalWindow) -> CompiledModel | None:
        model = self.true.compiled(window) if self.kind == PROCESS_KIND else None
        if model is None:
            return None
        record = model.record.copy()
        record["flat"] = min(max(self.p_occupied, MIN_PROBABILITY), MAX_PROBABILITY)
        return model._replace(record=record)

    @property
    def n_slots(self) -> int:
        return self.true.n_slots

    def with_day_error(self, day_error: DayError, walk: ArrayLike | None = None) -> ConstantForecast:
        return replace(self, true=self.true.with_day_error(day_error, walk))

    def for_world(self, world: OccupancyModel) -> ConstantForecast:
        return replace(self, true=world)

    def forecast(self, arrival: Arrival) -> Forecast:
        p = min(max(self.p_occupied, MIN_PROBABILITY), MAX_PROBABILITY)
        return replace(self.true.forecast(arrival), p_occupied=np.full(self.n_slots, p))
