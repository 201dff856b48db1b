"""How a learner of others does in worlds that had no say in its training: the same worlds for all of them."""

import json
import time
from importlib.metadata import version

import gymnasium as gym

import parkenv.envs.flat_ids

WORLDS = range(1_000_000, 1_000_300)
"""Seeds of the worlds."""
OPTIONS = parkenv.envs.flat_ids.OPTIONS | {"max_episode_steps": 500}
"""Of `gymnasium.make("parkenv/Search-v2")`: what most learners train on."""


def make(scenario, **options):
    """Make the environment of a learner; a search that drives in circles is stopped after 500 steps."""
    return gym.make(f"parkenv-flat/{scenario}-v2", **OPTIONS | options)


def totals(act, env):
    """Return the total time, s, of a search in each world."""
    found = []
    for seed in WORLDS:
        observation, _ = env.reset(seed=seed)
        over = False
        while not over:
            observation, _, terminated, truncated, info = env.step(act(observation))
            over = terminated or truncated
        found.append(info["total_s"])
    return found


def tell(library, decisions, act, scenario, release=None, **options):
    """Test what a library has learned, actions drawn as in training, and print a line that `run.py` reads.

    Args:
        library: its name as a package.
        decisions: of the training, which this process did before and nothing else.
        act: draws the action for an observation.
        scenario: a packaged car park, or `all` of them.
        release: its version, if it is no package.
        options: changes of `OPTIONS`.
    """
    seconds = time.process_time()
    found = {
        "library": library,
        "version": release or version(library),
        "decisions": decisions,
        "cpu_s": seconds,
        "totals": totals(act, make(scenario, **options)),
    }
    print(json.dumps(found))
