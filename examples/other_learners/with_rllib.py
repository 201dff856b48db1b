"""PPO of RLlib: `python with_rllib.py SCENARIO DECISIONS`."""

import sys

import torch
from held_out import OPTIONS, tell
from ray.rllib.algorithms.ppo import PPOConfig
from torch.distributions import Categorical

SCENARIO, DECISIONS = sys.argv[1], int(sys.argv[2])

config = (
    PPOConfig()
    .environment("parkenv/Search-v2", env_config={"scenario": SCENARIO, **OPTIONS})
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
    done = int(result["num_env_steps_sampled_lifetime"])
    print(f"{done:9,} decisions {-100.0 * result['env_runners']['episode_return_mean']:7.1f} s", flush=True)
module = algorithm.get_module()


@torch.no_grad()
def act(observation):
    """Draw an action."""
    found = module.forward_exploration({"obs": torch.as_tensor(observation)[None]})
    return int(Categorical(logits=found["action_dist_inputs"]).sample())


tell("ray", done, act, SCENARIO)
algorithm.stop()
