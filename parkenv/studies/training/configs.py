"""Training configs: settings of each algorithm that performed well."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

REWARD_SCALE = 0.01  # scales returns of about -100 s to about -1
MAX_STEPS = 500  # step limit of training episodes: longer searches only drive in circles
MIN_UPDATES = 12  # a training with fewer has smaller batches


@dataclass(frozen=True)
class TrainingConfig:
    n_envs: int  # number of parallel environments
    policy: str  # stable-baselines3's name of the policy class
    settings: Mapping[str, Any]  # arguments of the algorithm's constructor
    # fraction of the learning rate at the end of training; it falls linearly
    final_learning_rate: float = 1.0

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

SEARCH_CONFIGS: dict[str, TrainingConfig] = {
    **dict.fromkeys(("ppo", "maskable-ppo"), TrainingConfig(256, "MultiInputPolicy", _ON_POLICY, 0.05)),
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
