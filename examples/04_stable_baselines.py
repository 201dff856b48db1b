"""Train with sb3-contrib in ten lines, draw the curve, and compare the policy with planners in the same worlds.

It takes about a minute of one core (on a free one), and prints a line after each of six rounds.

Three things make it learn: the compact observation, `local`; the action mask; rewards near one (`reward_scale`).
"""

import torch
from sb3_contrib import MaskablePPO
from stable_baselines3.common.evaluation import evaluate_policy

import parkenv
from parkenv.envs.sb3 import SearchVecEnv
from parkenv.studies.statistics import mean_interval
from planners.model_file import save_model

SCENARIO, WORLDS, ENVS = "campus", 250, 50


def total_times(name: str) -> list[float]:
    """Total times of an agent, s, in the same worlds for every agent: those that follow from the seed."""
    envs = SearchVecEnv(ENVS, SCENARIO, observation="local" if ":" in name else "full", max_episode_steps=500)
    envs.seed(3_000_000)
    agent = parkenv.make_agent(name, parkenv.make_scenario(SCENARIO))
    returns, _ = evaluate_policy(agent, envs, WORLDS, return_episode_rewards=True, warn=False)
    return [-value for value in returns]


torch.set_num_threads(1)  # the network is small: more threads only wait for one another
envs = SearchVecEnv(64, SCENARIO, reward_scale=0.01)
model = MaskablePPO(
    "MultiInputPolicy", envs, 1e-3, n_steps=64, batch_size=1024, gamma=0.999, seed=0, device="cpu"
)
print("six rounds of 50,000 decisions on one thread; each prints a line", flush=True)
for _ in range(6):
    model.learn(50_000, reset_num_timesteps=False)
    save_model(model, "campus.safetensors", scenarios=[SCENARIO])  # for parkenv compare and report
    mean, low, high = mean_interval(total_times("maskable-ppo:campus.safetensors"))
    print(f"{model.num_timesteps:7,} decisions {mean:6.1f} s [{low:.1f}, {high:.1f}] {'#' * round(mean / 4)}")
for name in ("mdp", "first-free", "greedy-drive"):
    mean, low, high = mean_interval(total_times(name))
    print(f"{name:17} {mean:6.1f} s [{low:.1f}, {high:.1f}] {'#' * round(mean / 4)}")
