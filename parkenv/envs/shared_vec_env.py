"""What stable-baselines3 asks of environments that are one batch: nothing belongs to a single one of them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices


class SharedVecEnv(VecEnv):  # type: ignore[misc]
    """Base of batches for stable-baselines3: attributes are those of the batch, the same for every environment.

    Episodes are recorded in `info` as `Monitor` does, so that nobody puts one around it.

    Attributes:
        actions: what the next `step_wait` does.
    """

    actions: NDArray[Any]

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take note of what to do."""
        self.actions = np.asarray(actions)

    def close(self) -> None:
        """Nothing is held open."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of the batch, once for each environment; there is no render mode."""
        value = None if attr_name == "render_mode" else getattr(self, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Environments of a batch have no attributes of their own.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(f"environments of a batch share everything; {attr_name} cannot be set")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """What a method of the batch returns, the same for every environment."""
        value = getattr(self, method_name)(*method_args, **method_kwargs)
        return [value for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """As if by `Monitor`, and nothing else."""
        from stable_baselines3.common.monitor import Monitor

        return [issubclass(wrapper_class, Monitor) for _ in self._get_indices(indices)]
