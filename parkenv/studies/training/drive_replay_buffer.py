"""Hindsight experience replay for drives: reaching a goal ends the episode."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.buffers import DictReplayBufferSamples
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer


class TerminalGoalReplayBuffer(HerReplayBuffer):  # type: ignore[misc]
    """stable-baselines3's hindsight experience replay with terminal goals.

    In the base class, a relabelled episode continues after its goal. A drive ends there because the car has parked.
    Moreover, most relabelled goals cannot be held: the car passes through them at speed.
    """

    @property
    def contacts(self) -> NDArray[np.bool_]:
        """Whether each transition ended in a contact, (size, n_envs): the part of `info` that rewards depend on."""
        return np.array([[bool(info.get("contact")) for info in row] for row in self.infos])

    @contacts.setter
    def contacts(self, values: NDArray[np.bool_]) -> None:
        self.infos = np.array([[{"contact": value} for value in row] for row in values.tolist()])

    def _get_virtual_samples(
        self, batch_indices: NDArray[np.int64], env_indices: NDArray[np.int64], env: Any = None
    ) -> DictReplayBufferSamples:
        samples = super()._get_virtual_samples(batch_indices, env_indices, env)
        # A sparse reward is 0 only where the goal is reached.
        return samples._replace(dones=torch.maximum(samples.dones, (samples.rewards == 0.0).float()))
