"""Batches of searches as stable-baselines3's `VecEnv`."""

from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices

from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.errors import require_number
from parkenv.scenarios.build import ScenarioSources


class SearchVecEnv(VecEnv):  # type: ignore[misc]
    """A compiled batch of searches, `parkenv.envs.search_vector.ParkSearchVectorEnv`, for stable-baselines3.

    Attributes and methods belong to the whole batch. When an episode ends, its `info` has `terminal_observation`,
    `TimeLimit.truncated`, `episode` (return and length, as from `Monitor`, so no wrapper is needed) and the metrics of
    the search. sb3-contrib finds the action masks. `set_options` takes the options of `reset`, one dictionary or one
    for each search; they hold for the next reset.

    Args:
        num_envs: number of searches.
        scenario: a scenario, its name, a file, a folder of files, or a sequence of these; if there are several, one is
            drawn for each episode, and `info["scenario_index"]` is its index at the end.
        reward_scale: factor of the rewards in seconds; returns near one are easiest to learn.
        k: number of slots in the `local` observation, 5 if None.
        observation: `local`; for a single lot also `full`.
        max_episode_steps: steps after which a search is truncated.

    Raises:
        InputError: an argument out of its range; the message names it.

    Examples:
        >>> venv = SearchVecEnv(4, "mini")
        >>> venv.seed(0)
        [0, 1, 2, 3]
        >>> venv.reset()["local"].shape
        (4, 86)
    """

    actions: NDArray[Any]
    __copy__ = deepcopy

    def __init__(
        self,
        num_envs: int,
        scenario: ScenarioSources = "campus",
        reward_scale: float = 1.0,
        k: int | None = None,
        observation: str = "local",
        max_episode_steps: int = 2000,
    ) -> None:
        require_number("reward_scale", reward_scale, above=0.0)
        self.batch = ParkSearchVectorEnv(
            num_envs, scenario, observation, k, max_episode_steps, AutoresetMode.SAME_STEP
        )
        super().__init__(num_envs, self.batch.single_observation_space, self.batch.single_action_space)
        self.reward_scale = reward_scale
        self._returns, self._lengths = np.zeros(self.num_envs), np.zeros(self.num_envs, dtype=np.int64)
        self._masks: NDArray[Any] = np.zeros((self.num_envs, 0), np.bool_)

    def reset(self) -> dict[str, NDArray[Any]]:
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds
        options: Any = self._options
        if options and options == options[:1] * self.num_envs:
            options = options[0]
        observations, _ = self.batch.reset(seed=seeds, options=options)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        self._returns[:], self._lengths[:] = 0.0, 0
        self._masks = np.array(observations["action_mask"], np.bool_)
        return dict(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        self.actions = np.asarray(actions)

    def step_wait(
        self,
    ) -> tuple[dict[str, NDArray[Any]], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        observations, rewards, terminated, truncated, info = self.batch.step(self.actions)
        self._masks = np.array(observations["action_mask"], np.bool_)
        self._returns += rewards
        self._lengths += 1
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        final = info.get("final_info", {})
        named = [name for name in final if f"_{name}" in final]
        for i in np.flatnonzero(done).tolist():
            infos[i] = {
                "terminal_observation": info["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                "episode": {"r": float(self._returns[i]), "l": int(self._lengths[i])},
                **{name: final[name][i].item() for name in named},
            }
        self._returns[done], self._lengths[done] = 0.0, 0
        return observations, (rewards * self.reward_scale).astype(np.float32), done, infos

    def action_masks(self) -> NDArray[np.bool_]:
        """Return the actions that are possible now, (n, 5) bool."""
        return self._masks.copy()

    def close(self) -> None:
        """Do nothing: there are no resources to release."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        value = None if attr_name == "render_mode" else getattr(self._owner(attr_name), attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Raise a NotImplementedError: environments of a batch have no attributes of their own."""
        raise NotImplementedError(f"environments of a batch share everything; {attr_name} cannot be set")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method; returns its result for each environment, a row of it from `action_masks`."""
        value = getattr(self._owner(method_name), method_name)(*method_args, **method_kwargs)
        of_rows = method_name == "action_masks"
        return [value[i] if of_rows else value for i in self._get_indices(indices)]

    def _owner(self, name: str) -> Any:
        return self if hasattr(self, name) else self.batch

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        from stable_baselines3.common.monitor import Monitor

        return [issubclass(wrapper_class, Monitor) for _ in self._get_indices(indices)]
