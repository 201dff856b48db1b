"""Base class of batched environments for stable-baselines3."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices


class SharedVecEnv(VecEnv):  # type: ignore[misc]
    """A batch of environments as stable-baselines3's `VecEnv`.

    Attributes and methods belong to the whole batch. `info` reports returns and lengths of episodes as `Monitor` does,
    so no wrapper is needed.

    Attributes:
        actions: actions for the next `step_wait`.
    """

    actions: NDArray[Any]

    def __init__(
        self, num_envs: int, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
    ) -> None:
        super().__init__(num_envs, observation_space, action_space)
        self._returns, self._lengths = np.zeros(num_envs), np.zeros(num_envs, dtype=np.int64)

    def _start_all(self) -> None:
        """Start counting the episodes of all environments."""
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        self._returns[:], self._lengths[:] = 0.0, 0

    def _count(self, rewards: NDArray[np.floating]) -> None:
        """Add a step's rewards, (n_envs,), to the episode returns."""
        self._returns += rewards
        self._lengths += 1

    def _end_episodes(
        self,
        done: NDArray[np.bool_],
        truncated: NDArray[np.bool_],
        final: Callable[[int], tuple[dict[str, Any], dict[str, Any]]],
    ) -> list[dict[str, Any]]:
        """Return the step's `info` of all environments, and start counting new episodes where one has ended.

        Args:
            done: (n_envs,), whether the episode has ended.
            truncated: (n_envs,), whether a step limit ended it.
            final: function of an environment's index; returns the last observation and further entries of `info`.
        """
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done).tolist():
            observation, metrics = final(i)
            infos[i] = {
                "terminal_observation": observation,
                "TimeLimit.truncated": bool(truncated[i]),
                "episode": {"r": float(self._returns[i]), "l": int(self._lengths[i])},
                **metrics,
            }
        self._returns[done], self._lengths[done] = 0.0, 0
        return infos

    def step_async(self, actions: NDArray[Any]) -> None:
        """Set the actions of the next `step_wait`."""
        self.actions = np.asarray(actions)

    def close(self) -> None:
        """Do nothing: there are no resources to release."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the batch for each environment; the render mode is None."""
        value = None if attr_name == "render_mode" else getattr(self, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Raise an error: environments of a batch have no attributes of their own.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(f"environments of a batch share everything; {attr_name} cannot be set")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the batch; returns its result for each environment."""
        value = getattr(self, method_name)(*method_args, **method_kwargs)
        return [value for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Return True for `Monitor`: the batch has its function built in."""
        from stable_baselines3.common.monitor import Monitor

        return [issubclass(wrapper_class, Monitor) for _ in self._get_indices(indices)]
