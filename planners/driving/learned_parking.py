"""Parking agent for `parkenv/Drive-v1` with a model trained by `parkenv train --env drive`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.driving.vehicle import ACCELERATION, SPEED, STATE_SIZE, STEERING, YAW, VehicleParameters
from parkenv.errors import InputError
from planners.driving import policy_interface as interface
from planners.driving.policy_interface import Outlines, PolicyInterface
from planners.model_file import load_model

Observation = Mapping[str, Any]


@dataclass
class LearnedParkingMemory:
    """State of the agent within an episode."""

    outlines: Outlines  # the obstacles
    # (2,) float32, the current decision
    action: NDArray[np.float32] = field(default_factory=lambda: np.zeros(2, dtype=np.float32))
    left: int = 0  # number of steps for which the action still holds


class LearnedParkingAgent:
    """A trained model as a parking agent, on any lot.

    Args:
        algorithm: the algorithm of the model.
        path: the model file.
        vehicle: the car; by default the one used in training.

    Raises:
        InputError: the file is not a model, or is one of another algorithm, task or observation.

    Attributes:
        card: metadata of the model file.
        model: the policy; its observation is that of `planners.driving.policy_interface`.
    """

    def __init__(
        self, algorithm: str, path: str | os.PathLike[str], vehicle: VehicleParameters | None = None
    ) -> None:
        self.name = f"{algorithm}:{path}"
        self.card, self.model = load_model(algorithm, path, "drive", interface.INTERFACE)
        self.view = PolicyInterface(vehicle or VehicleParameters())

    def predict(
        self,
        observation: Observation,
        state: Sequence[LearnedParkingMemory] | LearnedParkingMemory | None = None,
        episode_start: NDArray[np.bool_] | Sequence[bool] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Sequence[LearnedParkingMemory] | LearnedParkingMemory]:
        """Decide on single observations, or on batches with a leading axis (stable-baselines3's interface).

        Args:
            observation: from `parkenv/Drive-v1` with `obstacle_map=True`, or a vector of them.
            state: returned by the previous call; None at the start.
            episode_start: for each environment, whether its episode has just begun. With None, episodes begin where
                `state` is None.
            deterministic: whether to use the mode of the policy instead of a sample.

        Returns:
            The action, (2,) or (n_envs, 2) float32, and the state for the next call.

        Raises:
            InputError: an observation without the obstacle map.
        """
        for key in ("cars", "lines"):
            if key not in observation:
                raise InputError(
                    f"the observation has no {key!r}: make the environment with obstacle_map=True"
                )
        if np.ndim(observation["achieved_goal"]) == 1:
            start = None if episode_start is None else np.array([np.any(episode_start)])
            several = {key: np.asarray(values)[None] for key, values in observation.items()}
            before = None if state is None else [state]
            actions, memories = self._decide(several, before, start, deterministic)
            return actions[0], memories[0]
        return self._decide(observation, state, episode_start, deterministic)

    def _decide(
        self, observation: Observation, state: Any, start: Any, deterministic: bool
    ) -> tuple[NDArray[np.float32], list[LearnedParkingMemory]]:
        n = len(observation["achieved_goal"])
        memories: list[Any] = [None] * n if state is None else list(state)
        for i in range(n):
            if memories[i] is None or (start is not None and start[i]):
                memories[i] = LearnedParkingMemory(
                    Outlines.of_map(observation["cars"][i], observation["lines"][i])
                )
        due = [i for i in range(n) if memories[i].left == 0]
        if due:
            seen = {key: np.asarray(observation[key])[due] for key in ("achieved_goal", "desired_goal")}
            seen["observation"] = np.stack(
                [self._seen(observation["observation"][i], memories[i].outlines) for i in due]
            )
            decided, _ = self.model.predict(seen, deterministic=deterministic)
            for i, action in zip(due, decided, strict=True):
                memories[i].action, memories[i].left = action, interface.ACTION_REPEAT
        actions = np.empty((n, 2), dtype=np.float32)
        for i, memory in enumerate(memories):
            pedal = interface.pedal_command(
                memory.action, float(observation["observation"][i][4]), self.view.pedals
            )
            actions[i] = pedal, memory.action[1]
            memory.left -= 1
        return actions, memories

    def _seen(self, own: NDArray[np.float32], outlines: Outlines) -> NDArray[np.float32]:
        """Return the model's observation without the goals; `own` is the environment's `observation`."""
        values = own.astype(np.float64)
        state = np.zeros(STATE_SIZE)
        state[[SPEED, STEERING, ACCELERATION]] = values[4:7]
        state[YAW] = np.arctan2(values[3], values[2])
        seen = np.empty(interface.OBSERVATION_SIZE, dtype=np.float32)
        interface.encode_observation(values[:2], state, tuple(outlines), self.view.body, values[7:12], seen)
        return seen
