"""Many cars with SuperSuit: the parallel form of the lot as a vector environment of stable-baselines3.

It takes about a quarter of a minute.

SuperSuit wants a fixed number of agents with plain boxes as observations. So each car observes the probability that
each slot is taken, its actions, and where it is; a car that has parked stays on and observes zeros ("black death").
Without the packages of the extra `marl`, the example says so.
"""

from importlib.util import find_spec

import numpy as np
from gymnasium import spaces

from parkenv import lot_v0


def flat(observation, space):
    """Return P(taken) of the slots, the action mask, and the vertex as a one-hot vector."""
    vertex = np.zeros(space["vertex"].n, np.float32)
    vertex[observation["vertex"]] = 1.0
    return np.concatenate([observation["p_occupied"], observation["action_mask"], vertex], dtype=np.float32)


def flat_space(space):
    """Return the space of `flat`."""
    size = space["p_occupied"].shape[0] + space["action_mask"].shape[0] + space["vertex"].n
    return spaces.Box(0.0, 1.0, (int(size),), np.float32)


def main():
    """Train one network for all cars for a few seconds."""
    import supersuit
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.utils import set_random_seed

    env = lot_v0.parallel_env(scenario="mini", cars=4, tick_s=2.0, max_cycles=200)
    env = supersuit.observation_lambda_v0(env, flat, flat_space)
    env = supersuit.reward_lambda_v0(env, lambda seconds: 0.01 * seconds)
    env = supersuit.black_death_v3(env)
    worlds = supersuit.pettingzoo_env_to_vec_env_v1(env)
    worlds = supersuit.concat_vec_envs_v1(worlds, 2, base_class="stable_baselines3")
    print(f"{worlds.num_envs} cars in two worlds, {worlds.observation_space}")
    torch.set_num_threads(1)  # the network is small: more threads only wait for one another
    set_random_seed(0)  # SuperSuit's batch has no seed(), which PPO(seed=0) would call
    model = PPO("MlpPolicy", worlds, n_steps=128, batch_size=256, n_epochs=4, gamma=0.999, device="cpu")
    model.learn(4_096)
    observations, total = worlds.reset(), np.zeros(worlds.num_envs)
    for _ in range(200):
        actions, _ = model.predict(observations)
        observations, rewards, _, _ = worlds.step(actions)
        total += 100.0 * rewards
    print(f"mean reward of a car in 200 ticks: {total.mean():.0f} s")


if find_spec("supersuit") is None:
    print('SuperSuit is not installed: pip install "parkenv[marl]"')
else:
    main()
