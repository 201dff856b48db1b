"""Record what an agent observes on a search, as a trip for its map."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from parkenv.belief.slot_belief import Observations, SlotBelief
from parkenv.mapping.trips import Trip
from parkenv.studies.simulate import Observer, Step


class TripRecorder(Observer):
    """Collects the observations of one search.

    Attributes:
        observations: those of each step.
    """

    def on_reset(self, env: gym.Env[Any, Any], observation: Any) -> None:
        """Begin a trip."""
        del env, observation
        self.observations: list[Observations] = []

    def on_step(self, step: Step) -> None:
        """Add what the step observed."""
        self.observations.append(SlotBelief.of_observation(step.next_observation).observations)

    def trip(self, key: str, time: float, date: str) -> Trip:
        """Return the recorded trip; the arguments are those of `Trip`."""
        return Trip(
            key, time, date, *(np.concatenate(parts) for parts in zip(*self.observations, strict=True))
        )
