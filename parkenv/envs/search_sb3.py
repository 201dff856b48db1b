"""The compiled batch of searches as stable-baselines3's `VecEnv`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from parkenv.envs.scan_observation import SCANS
from parkenv.envs.scan_vector import StackedScanVectorEnv
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.envs.shared_vec_env import SharedVecEnv
from parkenv.errors import InputError
from parkenv.scenarios.build import ScenarioSources, make_scenarios

METRICS = (
    "drive_s", "failed_s", "walk_s", "gave_up_s", "total_s", "driven_m", "walked_m", "failed_parks",
    "slots_passed", "parked", "place",
)  # fmt: skip

_DEFAULT_K = {"scan": SCANS}


def search_batch(
    num_envs: int,
    scenario: ScenarioSources,
    observation: str,
    k: int | None,
    max_episode_steps: int = 2000,
    autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
) -> ParkSearchVectorEnv:
    """Return a compiled batch of searches that observe `local`, `full` or `scan`; see `SearchVecEnv`."""
    k = _DEFAULT_K.get(observation, 5) if k is None else k
    if observation != "scan":
        return ParkSearchVectorEnv(
            num_envs,
            scenario,
            observation=observation,
            max_episode_steps=max_episode_steps,
            autoreset_mode=autoreset_mode,
            k=k,
        )
    places = make_scenarios(scenario)
    if len(places) != 1:
        raise InputError(f"there are {len(places)} scenarios, want one for searches that observe scans")
    return StackedScanVectorEnv(
        num_envs, places[0], max_episode_steps=max_episode_steps, autoreset_mode=autoreset_mode, k=k
    )


class SearchVecEnv(SharedVecEnv):
    """`ParkSearchVectorEnv` for stable-baselines3 and sb3-contrib.

    When a search ends, its `info` has `terminal_observation`, `TimeLimit.truncated`, `episode` (return in seconds and
    length, as from `Monitor`) and the metrics of `parkenv/Search-v2`. `action_masks` is available to sb3-contrib.

    Args:
        num_envs: number of searches.
        scenario: a scenario, its name, a file, a folder of files, or a sequence of these; if there are several, one is
            drawn for each episode, and `info["place"]` names it at the end.
        reward_scale: factor of the rewards in seconds; returns near one are easiest to learn.
        k: number of slots in the `local` observation, 5 if None; or of scans in `scan`, 4 if None.
        observation: `local`; for a single lot also `full`, or `scan`, as from
            `parkenv.envs.scan_observation.ScanObservation`.
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

    def __init__(
        self,
        num_envs: int,
        scenario: ScenarioSources = "campus",
        reward_scale: float = 1.0,
        k: int | None = None,
        observation: str = "local",
        max_episode_steps: int = 2000,
    ) -> None:
        if not (np.isfinite(reward_scale) and reward_scale > 0.0):
            raise InputError(f"reward_scale is {reward_scale}, want a number above 0")
        self.batch = search_batch(
            num_envs, scenario, observation, k, max_episode_steps, AutoresetMode.SAME_STEP
        )
        super().__init__(num_envs, self.batch.single_observation_space, self.batch.single_action_space)
        self.reward_scale = reward_scale
        self._masks: NDArray[np.int8] = np.zeros((num_envs, 0), dtype=np.int8)

    def reset(self) -> dict[str, NDArray[Any]]:
        """Start all searches, in the worlds of `seed` or in the next ones."""
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds
        observations, _ = self.batch.reset(seed=seeds)
        self._reset_seeds()
        self._reset_options()
        self._start_all()
        self._masks = observations["action_mask"]
        return observations

    def step_wait(
        self,
    ) -> tuple[dict[str, NDArray[Any]], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all searches; see the class for `info`."""
        observations, rewards, terminated, truncated, info = self.batch.step(self.actions)
        self._masks = observations["action_mask"]
        self._count(rewards)
        done = terminated | truncated

        def final(i: int) -> tuple[dict[str, Any], dict[str, Any]]:
            metrics = info["final_info"]
            return info["final_obs"][i], {name: metrics[name][i].item() for name in METRICS}

        infos = self._end_episodes(done, truncated & ~terminated, final)
        return observations, (rewards * self.reward_scale).astype(np.float32), done, infos

    def get_state(self) -> dict[str, Any]:
        """Return a copy of the running searches as plain arrays, for `set_state`."""
        return {
            "searches": [a.view(np.uint8) if a.dtype.names else a for a in self.batch.get_state()],
            "masks": self._masks,
            "returns": self._returns,
            "lengths": self._lengths,
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a state that `get_state` returned for the same scenarios."""
        self.reset()
        self.batch.set_state(state["searches"])
        self._masks, self._returns, self._lengths = state["masks"], state["returns"], state["lengths"]

    def action_masks(self) -> NDArray[np.bool_]:
        """Return the action masks, (n_envs, 5) bool."""
        return self._masks.astype(np.bool_)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the adapter, else of the batch, for each environment."""
        if attr_name == "render_mode" or hasattr(self, attr_name):
            return super().get_attr(attr_name, indices)
        value = getattr(self.batch, attr_name)
        return [value for _ in self._get_indices(indices)]

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Return a row of `action_masks` per search, which sb3-contrib calls.

        Raises:
            NotImplementedError: for any other method.
        """
        if method_name != "action_masks" or method_args or method_kwargs:
            raise NotImplementedError(f"searches of a batch have no method {method_name} of their own")
        masks = self.action_masks()
        return [masks[i] for i in self._get_indices(indices)]
