"""The wrapper that observes the car's surroundings, for policies that transfer between lots."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from parkenv.engine.local_observation import (
    FIRST_NEAR,
    PER_NEAR,
    Surroundings,
    local_space,
    observe_surroundings_at,
)
from parkenv.envs.search import SearchEnv


class LocalObservation(
    gym.ObservationWrapper[dict[str, Any], np.int64, dict[str, Any]], gym.utils.RecordConstructorArgs
):
    """Observe `parkenv/Search-v2` as `local` and `action_mask`.

    `parkenv.engine.local_observation` describes `local`.

    Args:
        env: `parkenv/Search-v2`, or an environment with the same observations.
        k: number of slots described.

    Raises:
        TypeError: another environment.
        InputError: k is not a whole number from 1 to `MAX_SLOTS`.

    Examples:
        >>> import gymnasium as gym
        >>> import parkenv
        >>> env = LocalObservation(gym.make("parkenv/Search-v2", scenario="mini"), k=5)
        >>> observation, info = env.reset(seed=0)
        >>> observation["local"].shape
        (86,)
    """

    def __init__(self, env: gym.Env[Any, Any], k: int = 5) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, k=k)
        super().__init__(env)
        if not isinstance(env.unwrapped, SearchEnv):
            raise TypeError(f"LocalObservation wraps parkenv/Search-v2, not {type(env.unwrapped).__name__}")
        self._surroundings = Surroundings.of(env.unwrapped.scenarios, k)
        self.observation_space = local_space(k)
        self._n_numbers = FIRST_NEAR + PER_NEAR * k

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the local observation."""
        local = np.empty(self._n_numbers, dtype=np.float32)
        assert isinstance(self.env.unwrapped, SearchEnv)
        observe_surroundings_at(self.env.unwrapped.searches.address, self._surroundings, local)
        return {"local": local, "action_mask": observation["action_mask"]}
