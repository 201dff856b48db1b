"""Ids for learners that take an id and no options: a packaged car park, one vector as observation, small rewards.

Importing this module registers `parkenv-flat/NAME-v2` for campus, jam, street, mini and kerbs, and `all`, in which each
search is in one of them. Gymnasium imports it where an id names it, so a learner's own command needs only that id:

>>> import gymnasium as gym
>>> env = gym.make("parkenv.envs.flat_ids:parkenv-flat/mini-v2")
>>> env.observation_space.shape
(86,)
"""

from dataclasses import replace

import gymnasium as gym

# Of `gymnasium.make("parkenv/Search-v2", ...)`, besides the scenario.
OPTIONS = {"observation": "local", "flat": True, "reward_scale": 0.01}

LOTS = ["campus", "jam", "street", "mini", "kerbs"]
for _name, _scenario in [*zip(LOTS, LOTS, strict=True), ("all", LOTS)]:
    _id, _kwargs = f"parkenv-flat/{_name}-v2", {"scenario": _scenario, **OPTIONS}
    gym.registry.setdefault(_id, replace(gym.spec("parkenv/Search-v2"), id=_id, kwargs=_kwargs))
