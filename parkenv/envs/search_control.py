"""The parts of a search step, for environments that drive or observe differently."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.envs.search_kernel import (
    act_in,
    apply_observations_in,
    fail_attempt_in,
    finish_step_in,
    observe_in,
    set_step_time,
    set_taken_in,
)
from parkenv.envs.search_records import Searches


class SearchControl:
    """Splits a step of the single search of `searches` into act, observe and finish.

    A step is `drive_or_park` or `fail_attempt`; then, unless the car is parked, `observe` or `apply_observations`;
    then `finish_step`.
    """

    def __init__(self, searches: Searches) -> None:
        self._searches = searches

    def drive_or_park(self, action: int) -> None:
        """Move along the graph or attempt to park, with the graph's times and the scenario's costs."""
        act_in(self._searches.address, action)

    def fail_attempt(self) -> None:
        """Count a failed attempt at a free slot that the car could not enter."""
        fail_attempt_in(self._searches.address)

    def set_step_time(self, begin: float, drive_s: float = 0.0, failed_s: float = 0.0) -> None:
        """Set the times, s, for driving and for a failed attempt, of the step that began at `begin`."""
        set_step_time(self._searches.address, begin, drive_s, failed_s)

    def observe(self) -> None:
        """Observe the slots in view with the scenario's sensor model."""
        observe_in(self._searches.address)

    def apply_observations(
        self,
        slots: NDArray[np.int64],
        taken: NDArray[np.bool_],
        hit_rate: NDArray[np.float64],
        false_alarm_rate: NDArray[np.float64],
    ) -> None:
        """Update the belief from observations of slots, (k,) each: observed states and error rates."""
        columns = (np.ascontiguousarray(a) for a in (slots, taken, hit_rate, false_alarm_rate))
        apply_observations_in(self._searches.address, *columns)

    def set_taken(self, slot: int) -> None:
        """Set the belief that a slot is taken to certainty, as of now."""
        set_taken_in(self._searches.address, slot)

    def finish_step(self) -> tuple[Any, ...]:
        """Add the step to the episode, and return the result of `parkenv.envs.search_kernel.step_result`."""
        result: tuple[Any, ...] = finish_step_in(self._searches.address)
        return result
