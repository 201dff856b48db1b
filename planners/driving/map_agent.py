"""What agents of `parkenv/Drive-v1` have in common: single observations and batches, and the car that they drive."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.driving.vehicle import VehicleParameters
from parkenv.errors import InputError

Observation = Mapping[str, Any]


class MapAgent(ABC):
    """An agent that observes the obstacle map and drives one car, `vehicle`."""

    name: str
    vehicle: VehicleParameters

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: NDArray[np.bool_] | Sequence[bool] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """Decide on single observations, or on batches with a leading axis (stable-baselines3's interface).

        Args:
            observation: from `parkenv/Drive-v1` with `obstacle_map=True`, or a vector of them.
            state: returned by the previous call; None at the start.
            episode_start: for each environment, whether its episode has just begun. With None, episodes begin where
                `state` is None.
            deterministic: whether to use the mode of a trained policy instead of a sample; planners always do.

        Returns:
            The action, (2,) or (n_envs, 2) float32, and the state for the next call.

        Raises:
            InputError: an observation without the obstacle map, or of another vehicle than the agent's.
        """
        self.require_map(observation)
        if np.ndim(observation["achieved_goal"]) == 1:
            start = None if episode_start is None else [bool(np.any(episode_start))]
            several = {key: np.asarray(values)[None] for key, values in observation.items()}
            actions, memories = self._decide_all(several, [state], start, deterministic)
            return actions[0], memories[0]
        before = [None] * len(observation["achieved_goal"]) if state is None else list(state)
        return self._decide_all(observation, before, episode_start, deterministic)

    def require_map(self, observation: Observation) -> None:
        """Raise an `InputError` unless observations have the obstacle map and are of the agent's own vehicle."""
        for key in ("cars", "lines", "vehicle"):
            if key not in observation:
                raise InputError(
                    f"the observation has no {key!r}: make the environment with obstacle_map=True"
                )
        self.vehicle.require_same(observation["vehicle"], f"agent {self.name!r}")

    @abstractmethod
    def _decide_all(
        self, observation: Observation, memories: list[Any], start: Any, deterministic: bool
    ) -> tuple[NDArray[np.float32], list[Any]]:
        """Return the actions, (n, 2) float32, and the memories; a memory is None where an episode begins."""
