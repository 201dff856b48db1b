"""Learning from raw sensors: a policy that observes its last laser scans and poses, and no map, forecast or belief.

`python examples/12_scans_alone.py` shows in seconds that it runs. Scenario, decisions and seed can be given:
`python examples/12_scans_alone.py mini 200000 0`.
"""

import math
import sys
from collections import deque

import gymnasium as gym
import numpy as np
import torch
from sb3_contrib import MaskablePPO
from stable_baselines3.common.env_util import make_vec_env

import parkenv
from parkenv.studies.simulate import make_search, simulate
from parkenv.studies.statistics import mean_interval

SCENARIO, DECISIONS, SEED = [*sys.argv[1:], *("mini", "512", "0")[len(sys.argv) - 1 :]]
SCANS, SECTORS, WAVELENGTHS_M = 4, 72, (8.0, 16.0, 32.0, 64.0, 128.0, 512.0)
WORLDS = 200 if int(DECISIONS) > 10_000 else 2
torch.set_num_threads(1)


class ScanObservation(gym.ObservationWrapper):
    """Observe the last scans of `parkenv/SearchSensors-v2`, and where they were measured, as one vector from -1 to 1.

    A time of s seconds is s / (s + 60), a length of d metres 1 / (1 + d / 5): 1 at the laser, about 0 far away.

    | Index | Meaning |
    |---|---|
    | 0 | time since the search began |
    | 1 to 3 | the goal seen from the car: cosine and sine of its bearing, and its distance |
    | 4, 5 | cosine and sine of the car's heading in the lot |
    | 6 to 29 | sine and cosine of x and y for each of `WAVELENGTHS_M` |
    | 30 + 77i | for scan i, the newest first: 1, or 0 if there is none yet |
    | 31 + 77i, 32 + 77i | where it was measured, as seen from the car now: ahead and to the left, in units of 30 m |
    | 33 + 77i, 34 + 77i | cosine and sine of the heading there, relative to the heading now |
    | 35 + 77i to 106 + 77i | the shortest range in each of 72 equal sectors, from the right to the left |
    """

    def __init__(self, env):
        super().__init__(env)
        scenario = env.unwrapped.scenario
        self._goal, self._scans = np.array(scenario.lot.goals[scenario.goal]), deque(maxlen=SCANS)
        size = 6 + 4 * len(WAVELENGTHS_M) + SCANS * (5 + SECTORS)
        vector = gym.spaces.Box(-1.0, 1.0, (size,), np.float32)
        self.observation_space = gym.spaces.Dict(
            {"scan": vector, "action_mask": env.observation_space["action_mask"]}
        )

    def reset(self, **options):
        """Begin a search, without the scans of the one before."""
        self._scans.clear()
        return super().reset(**options)

    def observation(self, observation):
        """Add the newest scans, and describe all of them as seen from the car."""
        for i in range(int(observation["count"])):
            pose, scan = observation["pose"][i], observation["scan_laser"][i]
            nearest = np.minimum.reduceat(scan, np.arange(SECTORS) * len(scan) // SECTORS)
            self._scans.appendleft((pose.astype(float), 1.0 / (1.0 + nearest / 5.0)))
        here, yaw = self._scans[0][0][:2], self._scans[0][0][2]
        elapsed, away = float(observation["time"][1]), self._goal - here
        bearing = math.atan2(away[1], away[0]) - yaw
        angles = 2.0 * math.pi * here / np.array(WAVELENGTHS_M)[:, None]
        ahead = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
        parts = [
            [
                elapsed / (elapsed + 60.0),
                math.cos(bearing),
                math.sin(bearing),
                1.0 / (1.0 + math.hypot(*away) / 5.0),
            ],
            [math.cos(yaw), math.sin(yaw)],
            np.stack([np.sin(angles), np.cos(angles)], axis=-1).ravel(),
        ]
        for pose, closeness in self._scans:
            turn, back = pose[2] - yaw, ahead @ (pose[:2] - here) / 30.0
            parts += [[1.0], np.clip(back, -1.0, 1.0), [math.cos(turn), math.sin(turn)], closeness]
        vector = np.zeros(self.observation_space["scan"].shape, np.float32)
        given = np.concatenate(parts)
        vector[: len(given)] = given
        return {"scan": vector, "action_mask": observation["action_mask"]}


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
