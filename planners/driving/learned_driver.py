"""A model that `parkenv train --env drive` made, at the wheel of `parkenv/Drive-v1`."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.driving.vehicle import ACCELERATION, SPEED, STATE_SIZE, STEERING, YAW, VehicleParameters
from parkenv.errors import InputError
from planners.driving.driver_view import HOLD, N_SEEN, VIEW, DriverView, Outlines, command, see
from planners.learned import load_model

Observation = Mapping[str, Any]


@dataclass
class DriverMemory:
    """What the driver remembers of an episode.

    Attributes:
        outlines: what is in the way.
        action: (2,) float32, the decision that holds.
        left: for how many steps more it does.
    """

    outlines: Outlines
    action: NDArray[np.float32] = field(default_factory=lambda: np.zeros(2, dtype=np.float32))
    left: int = 0


class LearnedDriver:
    """A trained model as the driver of a car, on any lot.

    Args:
        algorithm: that made it.
        path: the model file.
        vehicle: the car; the one it was trained with is the default.

    Raises:
        InputError: a file that is no model, of another algorithm, another task or another observation.

    Attributes:
        card: what the file says of itself.
        model: of stable-baselines3 or sb3-contrib; it sees what `planners.driving.driver_view` says.
    """

    def __init__(
        self, algorithm: str, path: str | os.PathLike[str], vehicle: VehicleParameters | None = None
    ) -> None:
        self.name = f"{algorithm}:{path}"
        self.card, self.model = load_model(algorithm, path, "drive", VIEW)
        self.view = DriverView(vehicle or VehicleParameters())

    def predict(
        self,
        observation: Observation,
        state: Sequence[DriverMemory] | DriverMemory | None = None,
        episode_start: NDArray[np.bool_] | Sequence[bool] | None = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Sequence[DriverMemory] | DriverMemory]:
        """stable-baselines3's interface: single observations, or batches of them with a leading axis.

        Args:
            observation: from `parkenv/Drive-v1` with `obstacle_map=True`, or a vector of them.
            state: what the last call returned; None at the start.
            episode_start: for each environment, whether its episode has just begun. With None, it has
                where there is no state.
            deterministic: whether to take the policy's likeliest decision.

        Returns:
            The action, (2,) or (n_envs, 2) float32, and the state to hand back.

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
    ) -> tuple[NDArray[np.float32], list[DriverMemory]]:
        n = len(observation["achieved_goal"])
        memories: list[Any] = [None] * n if state is None else list(state)
        for i in range(n):
            if memories[i] is None or (start is not None and start[i]):
                memories[i] = DriverMemory(Outlines.of_map(observation["cars"][i], observation["lines"][i]))
        due = [i for i in range(n) if memories[i].left == 0]
        if due:
            seen = {key: np.asarray(observation[key])[due] for key in ("achieved_goal", "desired_goal")}
            seen["observation"] = np.stack(
                [self._seen(observation["observation"][i], memories[i].outlines) for i in due]
            )
            decided, _ = self.model.predict(seen, deterministic=deterministic)
            for i, action in zip(due, decided, strict=True):
                memories[i].action, memories[i].left = action, HOLD
        actions = np.empty((n, 2), dtype=np.float32)
        for i, memory in enumerate(memories):
            pedal = command(memory.action, float(observation["observation"][i][4]), self.view.pedals)
            actions[i] = pedal, memory.action[1]
            memory.left -= 1
        return actions, memories

    def _seen(self, own: NDArray[np.float32], outlines: Outlines) -> NDArray[np.float32]:
        """The part of the model's observation that does not depend on goals; `own` is the environment's."""
        values = own.astype(np.float64)
        state = np.zeros(STATE_SIZE)
        state[[SPEED, STEERING, ACCELERATION]] = values[4:7]
        state[YAW] = np.arctan2(values[3], values[2])
        seen = np.empty(N_SEEN, dtype=np.float32)
        see(values[:2], state, tuple(outlines), self.view.body, values[7:12], seen)
        return seen
