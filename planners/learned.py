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
from planners.model_file import load_model


class LearnedAgent:
    """A trained model as an agent, on `parkenv.engine.local_observation`.

    Args:
        problem: lot, goal, speeds and costs.
        algorithm: algorithm that it was trained with.
        path: the model file.

    Attributes:
        card: metadata of the file.
        model: the policy.
        local_k: number of slots in the observation.
    """

    def __init__(self, problem: SearchProblem, algorithm: str, path: str | os.PathLike[str]) -> None:
        self.name = f"{algorithm}:{path}"
        self.problem = problem.public()
        self.card, self.model = load_model(algorithm, path)
        lots = self.card.scenarios
        if lots and not {problem.lot.name, getattr(problem, "name", "")} & {*lots, *self.card.held_out}:
            named = ", ".join(lots[:3]) + (f" and {len(lots) - 3} more" if len(lots) > 3 else "")
            warnings.warn(f"{path}: was trained on {named}, not on {problem.lot.name}", stacklevel=2)
        self.local_k = self.card.k

    def predict(
        self,
        observation: Mapping[str, NDArray[Any]],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Any, Any]:
        """Choose an action for an observation of `LocalObservation`, as stable-baselines3 does."""
        if "local" not in observation:
            raise InputError(
                f"{self.name} wants observations of parkenv.envs.local_observation.LocalObservation, "
                f"got {', '.join(observation)}"
            )
        given, wanted = observation["local"].shape[-1:], self.model.observation_space["local"].shape
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
