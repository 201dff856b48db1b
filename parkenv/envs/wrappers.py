"""Wrappers for `parkenv/Search-v2`."""

from __future__ import annotations

from typing import Any, SupportsFloat

import gymnasium as gym

from parkenv.envs.search import SearchEnv


class ThesisReward(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """The thesis's reward: parking pays r_max - r_s instead of minus the walk (eq. 3.23-3.25).

    Success pays an additional constant r_max, the walk from the farthest slot. `info["reward_terms"]` gains the term
    `r_max`, so that the terms still add up.

    Examples:
        >>> import gymnasium as gym
        >>> import parkenv
        >>> env = ThesisReward(gym.make("parkenv/Search-v2", scenario="mini"))
    """

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env)
        if not isinstance(env.unwrapped, SearchEnv):
            raise TypeError(f"ThesisReward wraps parkenv/Search-v2, not {type(env.unwrapped).__name__}")
        self.r_max = float(env.unwrapped.scenario.walk_s.max())

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """Step, and add r_max for parking."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        bonus = self.r_max if info["parked"] else 0.0
        info["reward_terms"] = {**info["reward_terms"], "r_max": bonus}
        return observation, float(reward) + bonus, terminated, truncated, info
