"""Behaviour cloning: a policy begins with a planner's decisions, learns on, and searches in the planner's worlds.

It takes about a minute, and saves `cloned.safetensors` for `parkenv compare`. 2,000 searches, 3,000 updates and two
million decisions make policies that are as good as the planner, and agree better than without cloning.
"""

import gymnasium as gym
import numpy as np
import torch
from sb3_contrib import MaskablePPO

import parkenv
from parkenv.envs.local_observation import LocalObservation
from parkenv.envs.sb3 import SearchVecEnv
from parkenv.studies.simulate import make_search, simulate
from parkenv.studies.statistics import mean_interval
from planners.model_file import save_model

SCENARIO, PLANNER, FILE = "campus", "mdp-tuned", "cloned.safetensors"
SEARCHES, UPDATES, DECISIONS, WORLDS = 100, 500, 50_000, 50
SCALE = 0.01  # rewards near one

torch.set_num_threads(1)
scenario = parkenv.make_scenario(SCENARIO)
planner = parkenv.make_agent(PLANNER, scenario)
# Equal seeds give equal worlds: the planner decides in the first, the policy will observe the second.
world = gym.make("parkenv/Search-v2", scenario=scenario, max_episode_steps=500)
surroundings = LocalObservation(gym.make("parkenv/Search-v2", scenario=scenario))


def demonstrated(seed):
    """Return what the policy would observe in a search, the planner's actions, and the returns from there on."""
    (observation, _), (local, _) = world.reset(seed=seed), surroundings.reset(seed=seed)
    observed, actions, rewards, memory, over = [], [], [], None, False
    while not over:
        action, memory = planner.predict(observation, memory)
        observation, reward, terminated, truncated, _ = world.step(action)
        observed.append(local)
        actions.append(int(action))
        rewards.append(SCALE * reward)
        local, *_ = surroundings.step(action)
        over = terminated or truncated
    return observed, actions, np.cumsum(rewards[::-1])[::-1]


searches = [demonstrated(5_000_000 + number) for number in range(SEARCHES)]
observed, actions, returns = (np.concatenate(parts) for parts in zip(*searches, strict=True))
inputs = {name: torch.tensor(np.stack([one[name] for one in observed])) for name in ("local", "action_mask")}
actions, returns = torch.tensor(actions), torch.tensor(returns, dtype=torch.float32)
print(f"{len(actions):,} decisions of {PLANNER} in {SEARCHES} searches", flush=True)

model = MaskablePPO(
    "MultiInputPolicy", SearchVecEnv(64, scenario, reward_scale=SCALE), 1e-3, n_steps=64, batch_size=1024, gamma=0.999,
    seed=0, device="cpu",
)  # fmt: skip
optimizer = torch.optim.Adam(model.policy.parameters(), 1e-3)
for _ in range(UPDATES):
    batch = torch.randint(len(actions), (512,))
    some = {name: values[batch] for name, values in inputs.items()}
    values, log_prob, _ = model.policy.evaluate_actions(some, actions[batch])
    loss = 0.5 * torch.nn.functional.mse_loss(values.flatten(), returns[batch]) - log_prob.mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


def show(title, name):
    """Print the mean total time of an agent, s, in the same worlds for every agent."""
    agent = parkenv.make_agent(name, scenario)
    env = make_search(scenario, agent, max_episode_steps=500)
    totals = [simulate(env, agent, 3_000_000 + number).info["total_s"] for number in range(WORLDS)]
    mean, low, high = mean_interval(totals)
    print(f"{title:24} {mean:6.1f} s [{low:.1f}, {high:.1f}]", flush=True)


show(PLANNER, PLANNER)
for decisions in (0, DECISIONS):
    model.learn(decisions, reset_num_timesteps=False)
    save_model(model, FILE, scenarios=[SCENARIO])
    show(f"cloned, {model.num_timesteps:,} decisions", f"maskable-ppo:{FILE}")
