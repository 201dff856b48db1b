"""Goals of hindsight for drives: a slot is the end of a drive, and so is what is taken for one afterwards."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.buffers import DictReplayBufferSamples
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer


class EndingGoals(HerReplayBuffer):  # type: ignore[misc]
    """stable-baselines3's hindsight experience replay, in which to reach a goal ends the episode.

    There, a relabelled episode goes on after its goal. A drive does not: who stands in the slot has parked. And most
    goals of hindsight cannot be kept, as the car passes through them at speed.
    """

    def _get_virtual_samples(
        self, batch_indices: NDArray[np.int64], env_indices: NDArray[np.int64], env: Any = None
    ) -> DictReplayBufferSamples:
        samples = super()._get_virtual_samples(batch_indices, env_indices, env)
        # Of sparse rewards, only that of a goal that is reached is 0.
        return samples._replace(dones=torch.maximum(samples.dones, (samples.rewards == 0.0).float()))
