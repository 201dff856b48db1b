"""The wrapper that observes the car's surroundings, for policies that transfer between lots."""

from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np

from parkenv.engine.local_observation import FollowedSearch, local_space


class LocalObservation(
    gym.Wrapper[dict[str, Any], np.int64, dict[str, Any], np.int64], gym.utils.RecordConstructorArgs
):
    """Observe `parkenv/Search-v2` as `local` and `action_mask`.

    `parkenv.engine.local_observation` describes `local`. It is computed from the observations alone.

    Args:
        env: `parkenv/Search-v2`, or an environment with its observations and attributes `scenarios` and `scenario`.
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

    __copy__ = deepcopy

    def __init__(self, env: gym.Env[Any, Any], k: int = 5) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, k=k)
        super().__init__(env)
        if "step_observed" not in getattr(env.observation_space, "spaces", ()):
            raise TypeError(f"LocalObservation wraps parkenv/Search-v2, not {type(env.unwrapped).__name__}")
        self._followed = FollowedSearch(self.get_wrapper_attr("scenarios"), k)
        self.observation_space = local_space(k)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        scenarios, scenario = self.get_wrapper_attr("scenarios"), self.get_wrapper_attr("scenario")
        index = next(i for i, other in enumerate(scenarios) if other is scenario)
        return self._followed.observe(observation, index), info

    def step(self, action: np.int64) -> tuple[dict[str, Any], Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._followed.observe(observation), reward, terminated, truncated, info
