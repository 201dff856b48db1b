"""Learning from raw sensors: a policy that observes its last laser scans and poses, and no map, forecast or belief.

`python examples/12_scans_alone.py` shows in seconds that it runs. Scenario, decisions and seed can be given:
`python examples/12_scans_alone.py mini 200000 0`.
"""

import sys

import gymnasium as gym
import torch
from sb3_contrib import MaskablePPO
from stable_baselines3.common.env_util import make_vec_env

import parkenv
from parkenv.envs.scan_observation import ScanObservation
from parkenv.studies.simulate import make_search, simulate
from parkenv.studies.statistics import mean_interval

SCENARIO, DECISIONS, SEED = [*sys.argv[1:], *("mini", "512", "0")[len(sys.argv) - 1 :]]
WORLDS = 200 if int(DECISIONS) > 10_000 else 2
torch.set_num_threads(1)


def make_scans():
    """Make searches that observe the shortest range in each of 72 sectors of their last four scans."""
    options = {"observation": "scan", "captures": 1, "max_episode_steps": 500}
    return ScanObservation(gym.make("parkenv/SearchSensors-v2", scenario=SCENARIO, **options))


def scaled():
    """Make searches whose rewards are near one."""
    return gym.wrappers.TransformReward(make_scans(), lambda reward: 0.01 * reward)


model = MaskablePPO(
    "MultiInputPolicy", make_vec_env(scaled, 16, seed=int(SEED)), 1e-3, n_steps=64 if WORLDS > 2 else 16,
    batch_size=1024, n_epochs=4, gamma=0.999, ent_coef=0.01, seed=int(SEED), device="cpu",
)  # fmt: skip
model.learn(int(DECISIONS))


class Masked:
    """The model as an agent: it chooses among the actions that the graph has."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        """Choose an action."""
        return model.predict(observation, state, episode_start, deterministic, observation["action_mask"])


scenario = parkenv.make_scenario(SCENARIO)
searches = {f"scans, {model.num_timesteps:,} decisions": (make_scans(), Masked())}
for name in ("mdp", "first-free", "random"):
    agent = parkenv.make_agent(name, scenario)
    searches[name] = make_search(scenario, agent, max_episode_steps=500), agent
for title, (env, agent) in searches.items():
    # Equal seeds give equal worlds; the policy gets scans there, planners beliefs. Who does not park is charged.
    totals = [simulate(env, agent, 1_000_000 + world).info["total_s"] for world in range(WORLDS)]
    mean, low, high = mean_interval(totals)
    print(f"{title:26} {mean:7.1f} s [{low:.1f}, {high:.1f}]")
