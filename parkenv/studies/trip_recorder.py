"""Record what an agent observes on a search, as a trip for its map."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from parkenv.engine.records import DECAY_RATE, FORECAST, OBSERVED_AT, P_OBSERVED
from parkenv.mapping.trips import Trip
from parkenv.studies.simulate import Observer, Step
from parkenv.world.lot import PARK


class TripRecorder(Observer):
    """Collects the observations of one search from its belief state; the hidden occupancy is never read.

    Attributes:
        rows: slot, s since the start, observed taken, hit rate and false-alarm rate of each observation.
    """

    def on_reset(self, env: gym.Env[Any, Any], observation: Any) -> None:
        """Begin a trip."""
        del observation
        search: Any = env.unwrapped
        self._problem = search.scenario.public()
        # The belief that the observation holds, also where the agent gets a shorter observation.
        self._belief, self._clock = search.searches.belief[0], search.searches.records["clock"]
        self._path: list[int] = search.state.path
        self._before = self._belief.copy()
        self.rows: list[tuple[int, float, bool, float, float]] = []

    def on_step(self, step: Step) -> None:
        """Add what the belief gained in a step."""
        vertex, now, before, belief = self._path[-1], self._clock[0, 1], self._before, self._belief
        self._before = belief.copy()
        tried = -1
        if int(np.asarray(step.action).item()) == PARK and vertex < self._problem.lot.n_slots:
            tried = vertex
            self.rows.append((vertex, float(now), not step.info["parked"], 1.0, 0.0))
        if step.info["parked"]:
            return
        starts, viewed = self._problem.slots_in_view
        rows = slice(starts[vertex], starts[vertex + 1])
        slots, rates = viewed[rows], self._problem.sensor_rates.of(rows)
        new = (belief[OBSERVED_AT, slots] == now) & (before[OBSERVED_AT, slots] != now) & (slots != tried)
        slots, hit, false_alarm = slots[new], rates.hit[new], rates.false_alarm[new]
        prior, rate, p_before, since = (
            before[part, slots] for part in (FORECAST, DECAY_RATE, P_OBSERVED, OBSERVED_AT)
        )
        expected = prior + (p_before - prior) * np.exp(-rate * (now - since))
        p = belief[P_OBSERVED, slots]
        # Beliefs near 0 or 1 may not move any more.
        taken = np.where(p == expected, p > 0.5, p > expected)
        self.rows += zip(
            slots.tolist(), [float(now)] * len(slots), taken.tolist(), hit.tolist(), false_alarm.tolist(), strict=True
        )  # fmt: skip

    def trip(self, key: str, time: float, date: str) -> Trip:
        """Return the recorded trip; the arguments are those of `Trip`."""
        columns = list(zip(*self.rows, strict=True)) or [()] * 5
        kinds = (np.int64, np.float64, np.bool_, np.float64, np.float64)
        return Trip(key, time, date, *(np.array(c, kind) for c, kind in zip(columns, kinds, strict=True)))
