"""Parking agent for `parkenv/Drive-v1` with a model trained by `parkenv train --env drive`."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.driving.vehicle import ACCELERATION, SPEED, STATE_SIZE, STEERING, YAW, VehicleParameters
from planners.driving import policy_interface as interface
from planners.driving.map_agent import MapAgent, Observation
from planners.driving.policy_interface import Outlines, PolicyInterface
from planners.model_file import load_model


@dataclass
class LearnedParkingMemory:
    """State of the agent within an episode."""

    outlines: Outlines  # the obstacles
    # (2,) float32, the current decision
    action: NDArray[np.float32] = field(default_factory=lambda: np.zeros(2, dtype=np.float32))
    left: int = 0  # number of steps for which the action still holds


class LearnedParkingAgent(MapAgent):
    """A trained model as a parking agent, on any lot.

    Args:
        algorithm: the algorithm of the model.
        path: the model file.
        vehicle: the car, which has to be that of the training; None for that.

    Raises:
        InputError: the file is not a model, or is one of another algorithm, task, observation or vehicle.

    Attributes:
        card: metadata of the model file.
        model: the policy; its observation is that of `planners.driving.policy_interface`.
    """

    def __init__(
        self, algorithm: str, path: str | os.PathLike[str], vehicle: VehicleParameters | None = None
    ) -> None:
        self.name = f"{algorithm}:{path}"
        self.card, self.model = load_model(algorithm, path, "drive", interface.INTERFACE)
        self.vehicle = VehicleParameters(**(self.card.vehicle or {}))
        if vehicle is not None:
            self.vehicle.require_same(vehicle.numbers, f"model {path}")
        self.view = PolicyInterface(self.vehicle)

    def _decide_all(
        self, observation: Observation, memories: list[Any], start: Any, deterministic: bool
    ) -> tuple[NDArray[np.float32], list[LearnedParkingMemory]]:
        n = len(memories)
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
