"""PPO of Tianshou's high-level interface: `python with_tianshou.py SCENARIO DECISIONS`."""

import sys

import torch
from held_out import OPTIONS, tell
from tianshou.highlevel.config import OnPolicyTrainingConfig
from tianshou.highlevel.env import EnvFactoryRegistered, VectorEnvType
from tianshou.highlevel.experiment import ExperimentConfig, PPOExperimentBuilder
from tianshou.highlevel.params.algorithm_params import PPOParams

SCENARIO, DECISIONS = sys.argv[1], int(sys.argv[2])
STEPS = 2048

torch.set_num_threads(1)
environments = EnvFactoryRegistered(
    task="parkenv/Search-v2", venv_type=VectorEnvType.DUMMY, scenario=SCENARIO, **OPTIONS
)
config = OnPolicyTrainingConfig(
    max_epochs=max(DECISIONS // (10 * STEPS), 1), epoch_num_steps=10 * STEPS, num_training_envs=32, num_test_envs=10,
    test_step_num_episodes=100, buffer_size=2 * STEPS, collection_step_num_env_steps=STEPS, batch_size=512,
    update_step_num_repetitions=4,
)  # fmt: skip
experiment = (
    PPOExperimentBuilder(
        environments, ExperimentConfig(seed=0, watch=False, persistence_enabled=False, device="cpu"), config
    )
    .with_ppo_params(
        PPOParams(
            lr=1e-3,
            gamma=0.999,
            gae_lambda=0.95,
            ent_coef=0.01,
            max_grad_norm=0.5,
        )
    )
    .with_actor_factory_default((64, 64))
    .with_critic_factory_default((64, 64))
    .build()
)
result = experiment.run()
policy = result.world.algorithm.policy

tell("tianshou", result.trainer_result.train_step, policy.compute_action, SCENARIO)
