"""PPO of RLlib: `python with_rllib.py SCENARIO DECISIONS`."""

import sys

from ray.rllib.algorithms.ppo import PPOConfig

import parkenv  # noqa: F401 - registers the environments

SCENARIO, DECISIONS = sys.argv[1], int(sys.argv[2])
OPTIONS = {"scenario": SCENARIO, "observation": "local", "flat": True, "reward_scale": 0.01}

config = (
    PPOConfig()
    .environment("parkenv/Search-v2", env_config=OPTIONS | {"max_episode_steps": 500})
    .env_runners(num_env_runners=0, num_envs_per_env_runner=32)
    .training(
        train_batch_size=2048,
        minibatch_size=512,
        num_epochs=4,
        lr=1e-3,
        gamma=0.999,
        lambda_=0.95,
        entropy_coeff=0.01,
    )
    .debugging(seed=0)
)
algorithm = config.build_algo()
done = 0
while done < DECISIONS:
    result = algorithm.train()
    done = result["num_env_steps_sampled_lifetime"]
    seconds = -100.0 * result["env_runners"]["episode_return_mean"]
    print(f"{int(done):9,} decisions {seconds:7.1f} s", flush=True)
algorithm.stop()
