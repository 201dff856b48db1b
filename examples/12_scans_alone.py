"""Learn from raw laser scans: PPO on the last scans and poses, without forecast, belief or perception.

`python examples/12_scans_alone.py` shows in seconds that it runs. Scenario, decisions and seed can be given:
`python examples/12_scans_alone.py mini 100000 0`.
"""

import sys
from collections import deque

import gymnasium as gym
import numpy as np
from sb3_contrib import MaskablePPO
from stable_baselines3.common.vec_env import DummyVecEnv

import parkenv
from parkenv.evaluation.experiments.statistics import mean_interval
from parkenv.evaluation.simulate import simulate
from planners import make_agent

SCENARIO, DECISIONS, SEED = [*sys.argv[1:], *("mini", "512", "0")[len(sys.argv) - 1 :]]
WORLDS = 200 if int(DECISIONS) > 10_000 else 4
BEAMS, STACKED = 15, 4  # beams whose shortest range is observed; scans that the policy observes


class Scans(gym.ObservationWrapper):
    """The last scans, in sectors of 3.75 degrees, each with its pose; and how long the search has taken."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.seen: deque[np.ndarray] = deque(maxlen=STACKED)
        size = STACKED * (1081 // BEAMS + 4) + 1
        self.observation_space = gym.spaces.Box(-10.0, 10.0, (size,), np.float32)

    def reset(self, **options):
        """Forget the last search."""
        self.seen.clear()
        return super().reset(**options)

    def observation(self, observation):
        """Return the last scans and poses, the newest first; zeros for those that are still to come."""
        self.mask = observation["action_mask"].astype(bool)
        for i in range(int(observation["count"])):
            x, y, yaw = observation["pose"][i]
            nearest = observation["scan.laser"][i, : 1081 // BEAMS * BEAMS].reshape(-1, BEAMS).min(axis=1)
            self.seen.appendleft(np.r_[1.0 - nearest / 30.0, x / 50.0, y / 50.0, np.cos(yaw), np.sin(yaw)])
        known, stack = np.concatenate(self.seen), np.zeros(self.observation_space.shape, np.float32)
        stack[: len(known)], stack[-1] = known, observation["time"][1] / 300.0
        return np.clip(stack, -10.0, 10.0)

    def action_masks(self):
        """Return the actions that the graph has here, for MaskablePPO."""
        return self.mask


def search(reward_scale: float = 1.0) -> gym.Env:
    """Return a search whose car has a laser and nothing else."""
    env = gym.make(
        "parkenv/SearchSensors-v2", scenario=SCENARIO, observation="scan", captures=1, max_episode_steps=300
    )
    return Scans(gym.wrappers.TransformReward(env, lambda reward: reward_scale * reward))


envs = DummyVecEnv([lambda: search(0.01)] * 8)
model = MaskablePPO(
    "MlpPolicy", envs, n_steps=64, batch_size=256, gamma=0.999, ent_coef=0.01, seed=int(SEED), device="cpu"
)
model.learn(int(DECISIONS))


class Policy:
    """The trained model as an agent: it needs the action mask beside the observation."""

    def predict(self, observation, state=None, _=None, deterministic=True):
        """Return an action."""
        action, _ = model.predict(observation, action_masks=env.action_masks(), deterministic=deterministic)
        return action, state


def total_times(env, agent):
    """Return the total times, s, in the same worlds for every agent; a search cut short is charged for giving up."""
    return [simulate(env, agent, 1_000_000 + world).info["total_s"] for world in range(WORLDS)]


env = search()
rows = {f"scans, {int(DECISIONS):,} decisions": total_times(env, Policy())}
for name in ("mdp", "first-free", "random"):
    planned = gym.make("parkenv/Search-v2", scenario=SCENARIO, max_episode_steps=300)
    agent = make_agent(name, parkenv.make_scenario(SCENARIO))
    rows[name] = total_times(planned, agent)
for name, totals in rows.items():
    mean, low, high = mean_interval(totals)
    print(f"{name:26} {mean:7.1f} s [{low:.1f}, {high:.1f}]")
