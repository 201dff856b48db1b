"""Training configs: settings of each algorithm that performed well."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

REWARD_SCALE = 0.01  # scales returns of about -100 s to about -1
MAX_STEPS = 500  # step limit of training episodes: longer searches only drive in circles
MIN_UPDATES = 12  # a training with fewer has smaller batches


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of one algorithm."""

    n_envs: int  # number of parallel environments
    policy: str  # stable-baselines3's name of the policy class
    settings: Mapping[str, Any]  # arguments of the algorithm's constructor
    # fraction of the learning rate at the end of training; it falls linearly
    final_learning_rate: float = 1.0
    steps: int = 0  # decisions of a training whose specification does not say how many

    def for_steps(self, steps: int, n_envs: int | None = None) -> Self:
        """Return the settings for a training of so many decisions, or for one to go on with of so many environments.

        The settings are for millions. A short training on-policy would update its network once or twice, and learn
        nothing: it has a quarter of the environments and of the batch, until there are `MIN_UPDATES` updates.
        """
        config = self
        while config.n_envs >= 16 and (
            steps < MIN_UPDATES * config.n_envs * config.settings.get("n_steps", 0)
            if n_envs is None
            else config.n_envs > n_envs
        ):
            batch = {"batch_size": config.settings["batch_size"] // 4}
            config = replace(config, n_envs=config.n_envs // 4, settings={**config.settings, **batch})
        return config


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

_WITH_MASKS = ("ppo", "maskable-ppo")
SEARCH_CONFIGS: dict[str, TrainingConfig] = {
    **dict.fromkeys(_WITH_MASKS, TrainingConfig(256, "MultiInputPolicy", _ON_POLICY, 0.05)),
    "recurrent-ppo": TrainingConfig(
        128,
        "MultiInputLstmPolicy",
        {**_ON_POLICY, "policy_kwargs": {"net_arch": [128], "lstm_hidden_size": 64}},
        0.05,
    ),
    "dqn": TrainingConfig(
        64,
        "MultiInputPolicy",
        {
            "learning_rate": 5e-4,
            "buffer_size": 200_000,
            "learning_starts": 10_000,
            "batch_size": 512,
            "train_freq": 1,
            "gradient_steps": 2,
            # With gamma closer to 1, the value of endless circling dominates the learning signal.
            "gamma": 0.995,
            "target_update_interval": 2_000,
            "exploration_fraction": 0.3,
            "exploration_final_eps": 0.02,
            "policy_kwargs": {"net_arch": [128, 128]},
        },
        0.05,
    ),
}
"""Config of each algorithm for search."""

# Shorter rollouts than for single searches: the other cars follow the network only from rollout to rollout.
_IN_FLEET = {**_ON_POLICY, "n_steps": 128, "batch_size": 1024}
FLEET_CONFIGS = dict.fromkeys(_WITH_MASKS, TrainingConfig(32, "MultiInputPolicy", _IN_FLEET, 0.05))
"""Config of each algorithm for a fleet; their networks are compiled for the other cars."""


# Paths are short: two to fifteen moves.
_IN_SCENES = {**_ON_POLICY, "n_steps": 32, "gamma": 0.99}
SCENES_CONFIGS = {"maskable-ppo": TrainingConfig(256, "MultiInputPolicy", _IN_SCENES, 0.05, steps=600_000)}
"""Config of each algorithm for planning in scenes."""


WAY_IN = "way-in"  # start on the planned path into the slot


@dataclass(frozen=True)
class CurriculumLevel:
    """Difficulty of the tasks at one level; see `parkenv.driving.parking_task.ParkingTasks`."""

    starts: str  # `way-out`, `lane`, or `way-in` (on the planned path from the lane into the slot)
    distance: tuple[float, float]  # minimum and maximum, m; for `way-in`, of the remaining path length


CURRICULUM = (
    CurriculumLevel("way-out", (0.3, 1.5)),
    CurriculumLevel("way-out", (1.0, 4.0)),
    CurriculumLevel("way-out", (2.0, 8.0)),
    CurriculumLevel("way-out", (4.0, 14.0)),
    CurriculumLevel(WAY_IN, (2.0, 5.0)),
    CurriculumLevel(WAY_IN, (3.0, 7.0)),
    CurriculumLevel(WAY_IN, (5.0, 9.0)),
    CurriculumLevel(WAY_IN, (6.0, 11.0)),
    CurriculumLevel(WAY_IN, (8.0, 14.0)),
    CurriculumLevel("lane", (4.0, 14.0)),
)
"""Levels from a start just outside the slot to the full task of `parkenv/Drive-v1`.

A random drive out of a parallel slot ends while still inside it, so `way-out` starts teach pose correction in the slot.
The part between slot and lane is learned along the planned path, backwards from its end.
"""


@dataclass(frozen=True, kw_only=True)
class DriveTrainingConfig(TrainingConfig):
    """Settings of one algorithm for driving into slots."""

    reward: str  # `sparse`, with hindsight experience replay, or `dense`
    reward_scale: float  # factor from seconds to rewards
    contact_cost: float  # cost of a contact in training, s
    curriculum: tuple[CurriculumLevel, ...] = CURRICULUM  # levels, from the easiest to the full task


_OFF_POLICY: dict[str, Any] = {
    "learning_rate": 1e-3,
    "buffer_size": 300_000,
    "learning_starts": 3_000,
    "batch_size": 256,
    "train_freq": 1,
    "gradient_steps": 4,
    "gamma": 0.98,
    "tau": 0.005,
    # With the default of 1, entropy outweighs the reward of parking for thousands of updates.
    "ent_coef": "auto_0.02",
    "replay_buffer_kwargs": {"n_sampled_goal": 4, "goal_selection_strategy": "future"},
    "policy_kwargs": {"net_arch": [128, 128]},
}
_HINDSIGHT = DriveTrainingConfig(
    16,
    "MultiInputPolicy",
    _OFF_POLICY,
    0.1,
    reward="sparse",
    reward_scale=0.2,
    contact_cost=30.0,
    steps=300_000,
)

# A contact must cost more than standing still forever, which costs 0.4 s / (1 - gamma) with sparse rewards and about
# twice that with dense ones. If it costs much less (60 s), untrained policies end episodes with a contact. If it costs
# much more (100 s), learning the narrow path into a parallel slot takes two to three times as long.
DRIVE_CONFIGS: dict[str, DriveTrainingConfig] = {
    "ppo": DriveTrainingConfig(
        256,
        "MultiInputPolicy",
        {
            "learning_rate": 1e-3,
            "n_steps": 64,
            "batch_size": 1024,
            "n_epochs": 6,
            "gamma": 0.99,
            "gae_lambda": 0.95,
            # An entropy bonus slows the decay of exploration.
            "ent_coef": 0.004,
            "policy_kwargs": {"net_arch": [128, 128], "log_std_init": -0.5},
        },
        0.1,
        reward="dense",
        reward_scale=0.05,
        contact_cost=75.0,
        steps=10_000_000,
    ),
    "sac": _HINDSIGHT,
    "tqc": _HINDSIGHT,
}
"""Config of each algorithm for driving."""
