"""How each algorithm is trained: the settings that were found to do well, in one place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

REWARD_SCALE = 0.01
"""Returns of some -100 s become about -1."""
MAX_STEPS = 500
"""Decisions after which a search is given up in training: who is not parked by then drives in circles."""


@dataclass(frozen=True)
class Recipe:
    """Settings of one algorithm.

    Args:
        n_envs: searches at once.
        policy: stable-baselines3's word for the kind of network.
        settings: of the algorithm's constructor, by its own names.
        final_learning_rate: share of the learning rate that is left in the end; it falls in a straight line.
    """

    n_envs: int
    policy: str
    settings: Mapping[str, Any]
    final_learning_rate: float = 1.0


_ON_POLICY: dict[str, Any] = {
    "learning_rate": 1e-3,
    "n_steps": 64,
    "batch_size": 2048,
    "n_epochs": 6,
    "gamma": 0.999,
    "gae_lambda": 0.95,
    "ent_coef": 0.01,
    "policy_kwargs": {"net_arch": [128, 128]},
}

RECIPES: dict[str, Recipe] = {
    "ppo": Recipe(256, "MultiInputPolicy", _ON_POLICY, 0.05),
    "maskable-ppo": Recipe(256, "MultiInputPolicy", _ON_POLICY, 0.05),
    "recurrent-ppo": Recipe(
        128,
        "MultiInputLstmPolicy",
        {**_ON_POLICY, "policy_kwargs": {"net_arch": [128], "lstm_hidden_size": 64}},
        0.05,
    ),
    "dqn": Recipe(
        64,
        "MultiInputPolicy",
        {
            "learning_rate": 5e-4,
            "buffer_size": 200_000,
            "learning_starts": 10_000,
            "batch_size": 512,
            "train_freq": 1,
            "gradient_steps": 2,
            "gamma": 0.999,
            "target_update_interval": 2_000,
            "exploration_fraction": 0.3,
            "exploration_final_eps": 0.02,
            "policy_kwargs": {"net_arch": [128, 128]},
        },
        0.1,
    ),
}
"""Of each algorithm that `parkenv train` knows."""
