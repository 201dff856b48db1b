"""The ids of `parkenv.envs.flat_ids` with a log, for learners that do not say how their episodes end.

`logged_ids:logged/campus-v2` is `parkenv.envs.flat_ids:parkenv-flat/campus-v2`, and appends the total time of each
episode, s, as a line to the file that the environment variable `EPISODES` names.
"""

import os
from pathlib import Path

import gymnasium as gym

from parkenv.envs.flat_ids import OPTIONS


class Logged(gym.Wrapper):
    """Write the total time of each episode, s, to a file."""

    def step(self, action):
        """Act, and write a line if that ends the episode."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            with Path(os.environ["EPISODES"]).open("a") as file:
                file.write(f"{info['total_s']}\n")
        return observation, reward, terminated, truncated, info


def make(scenario, render_mode=None):
    """Return the logged environment; who drives in circles is stopped after 500 steps."""
    env = gym.make(
        "parkenv/Search-v2", scenario=scenario, render_mode=render_mode, max_episode_steps=500, **OPTIONS
    )
    return Logged(env)


for name in ("campus", "jam", "street", "mini"):
    gym.register(f"logged/{name}-v2", entry_point=make, order_enforce=False, kwargs={"scenario": name})
