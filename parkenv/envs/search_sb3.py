"""The compiled batch as stable-baselines3 wants its environments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.envs.shared_vec_env import SharedVecEnv
from parkenv.errors import InputError
from parkenv.world.scenario import Scenario

METRICS = (
    "drive_s", "failed_s", "walk_s", "gave_up_s", "total_s", "driven_m", "walked_m", "failed_parks",
    "slots_passed", "parked",
)  # fmt: skip


class SearchVecEnv(SharedVecEnv):
    """`ParkSearchVectorEnv` for stable-baselines3 and sb3-contrib.

    Where a search ends, its `info` has `terminal_observation`, `TimeLimit.truncated`, `episode` (return in seconds, and
    length, as `Monitor` has them) and the metrics of `parkenv/Search-v1`. sb3-contrib finds `action_masks`.

    Args:
        num_envs: how many searches at once.
        scenario: one, by name or itself; or several, which take turns.
        reward_scale: rewards are seconds times this. Learning is easiest with returns of about one.
        k: how many slots the `local` observation tells of.
        observation: local, or full where all lots are one.
        max_episode_steps: after which a search is truncated.

    Raises:
        InputError: an argument out of its range, by name.

    Examples:
        >>> venv = SearchVecEnv(4, "mini")
        >>> venv.seed(0)
        [0, 1, 2, 3]
        >>> venv.reset()["local"].shape
        (4, 86)
    """

    def __init__(
        self,
        num_envs: int,
        scenario: str | Scenario | Sequence[str | Scenario] = "campus",
        reward_scale: float = 1.0,
        k: int = 5,
        observation: str = "local",
        max_episode_steps: int = 2000,
    ) -> None:
        if not (np.isfinite(reward_scale) and reward_scale > 0.0):
            raise InputError(f"reward_scale is {reward_scale}, want a number above 0")
        self.batch = ParkSearchVectorEnv(
            num_envs,
            scenario,
            observation=observation,
            k=k,
            max_episode_steps=max_episode_steps,
            autoreset_mode=AutoresetMode.SAME_STEP,
        )
        super().__init__(num_envs, self.batch.single_observation_space, self.batch.single_action_space)
        self.reward_scale = reward_scale
        self._masks: NDArray[np.int8] = np.zeros((num_envs, 0), dtype=np.int8)
        self._returns = np.zeros(num_envs)
        self._lengths = np.zeros(num_envs, dtype=np.int64)

    def reset(self) -> dict[str, NDArray[Any]]:
        """Start a search everywhere: in the worlds of `seed`, or in the next ones."""
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds
        observations, _ = self.batch.reset(seed=seeds)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        self._returns[:] = 0.0
        self._lengths[:] = 0
        self._masks = observations["action_mask"]
        return observations

    def step_wait(
        self,
    ) -> tuple[dict[str, NDArray[Any]], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Do it; see the class for what `info` holds."""
        observations, rewards, terminated, truncated, told = self.batch.step(self.actions)
        self._masks = observations["action_mask"]
        self._returns += rewards
        self._lengths += 1
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done):
            final = told["final_info"]
            infos[i] = {name: final[name][i].item() for name in METRICS} | {
                "terminal_observation": told["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                "episode": {"r": float(self._returns[i]), "l": int(self._lengths[i])},
            }
        self._returns[done] = 0.0
        self._lengths[done] = 0
        return observations, (rewards * self.reward_scale).astype(np.float32), done, infos

    def action_masks(self) -> NDArray[np.bool_]:
        """(n_envs, 5) bool, what can be done now."""
        return self._masks.astype(np.bool_)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the adapter, or else of the batch."""
        if attr_name == "render_mode" or hasattr(self, attr_name):
            return super().get_attr(attr_name, indices)
        value = getattr(self.batch, attr_name)
        return [value for _ in self._get_indices(indices)]

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """`action_masks`, a row for each search: what sb3-contrib asks for.

        Raises:
            NotImplementedError: another method.
        """
        if method_name != "action_masks" or method_args or method_kwargs:
            raise NotImplementedError(f"searches of a batch have no method {method_name} of their own")
        masks = self.action_masks()
        return [masks[i] for i in self._get_indices(indices)]
