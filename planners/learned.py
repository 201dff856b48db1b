"""Trained models as agents that search."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.world.scenario import SearchProblem
from planners.model_file import SEARCH_OBSERVATIONS, load_model

_WRAPPERS = {
    "local": "parkenv.envs.local_observation.LocalObservation",
    "scan": "parkenv.envs.scan_observation.ScanObservation",
}


class LearnedAgent:
    """A trained model as an agent: on `parkenv.engine.local_observation`, or on `parkenv.envs.scan_observation`.

    Args:
        problem: lot, goal, speeds and costs.
        algorithm: algorithm that it was trained with.
        path: the model file.

    Raises:
        InputError: the file is not a model, or is one of another algorithm, task or observation.

    Attributes:
        card: metadata of the file.
        model: the policy.
        local_k: number of slots in the observation; None for a model that observes scans.
        scans_k: number of scans in the observation; None for a model that observes `local`.
    """

    def __init__(self, problem: SearchProblem, algorithm: str, path: str | os.PathLike[str]) -> None:
        self.name = f"{algorithm}:{path}"
        self.problem = problem.public()
        self.card, self.model = load_model(algorithm, path, "search", *SEARCH_OBSERVATIONS)
        lots = self.card.scenarios
        if lots and not {problem.lot.name, getattr(problem, "name", "")} & {*lots, *self.card.held_out}:
            named = ", ".join(lots[:3]) + (f" and {len(lots) - 3} more" if len(lots) > 3 else "")
            warnings.warn(f"{path}: was trained on {named}, not on {problem.lot.name}", stacklevel=2)
        self._key = SEARCH_OBSERVATIONS[self.card.observation][0]
        self.local_k = self.card.k if self._key == "local" else None
        self.scans_k = self.card.k if self._key == "scan" else None

    def predict(
        self,
        observation: Mapping[str, NDArray[Any]],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """Choose an action for an observation of `LocalObservation` or `ScanObservation`, as stable-baselines3 does.

        Raises:
            InputError: the observation has another layout, or its mask allows no action.
        """
        key = self._key
        if key not in observation:
            raise InputError(
                f"{self.name} wants observations of {_WRAPPERS[key]}, got {', '.join(observation)}"
            )
        given, wanted = observation[key].shape[-1:], self.model.observation_space[key].shape
        if given != wanted:
            raise InputError(
                f"{self.name} observes {wanted[0]} numbers, got {given[0]} for its k = {self.card.k}"
            )
        if not np.any(observation["action_mask"], axis=-1).all():
            raise InputError("action_mask allows nothing; a search that goes on allows at least one action")
        masks = {"action_masks": observation["action_mask"]} if self.card.algorithm == "maskable-ppo" else {}
        action, state = self.model.predict(
            dict(observation), state=state, episode_start=episode_start, deterministic=deterministic, **masks
        )
        return action, state
