"""Planners speak stable-baselines3: evaluate one with its tools, and train a PPO in the same world."""

import gymnasium as gym
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.evaluation import evaluate_policy as evaluate_masked
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import parkenv
from planners import make_agent

scenario = parkenv.make_scenario("mini")
venv = make_vec_env(lambda: gym.make("parkenv/Search-v1", scenario=scenario), n_envs=4, seed=0)

mean, spread = evaluate_policy(make_agent("mdp", scenario), venv, n_eval_episodes=100)
print(f"mdp: {-mean:.1f} s on average, standard deviation {spread:.1f} s")

model = MaskablePPO("MultiInputPolicy", venv, n_steps=256, seed=0).learn(8192)
mean, spread = evaluate_masked(model, venv, n_eval_episodes=100, deterministic=False)
print(f"PPO after 8192 steps: {-mean:.1f} s, standard deviation {spread:.1f} s (only a start)")
