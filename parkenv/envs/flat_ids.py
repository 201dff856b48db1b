"""Ids for learners that take an id and no options: a packaged car park, one vector as observation, small rewards.

Importing this module registers `parkenv-flat/NAME-v2` for campus, jam, street and mini. Gymnasium imports it where an
id names it, so a learner's own command needs no more than that id:

>>> import gymnasium as gym
>>> env = gym.make("parkenv.envs.flat_ids:parkenv-flat/mini-v2")
>>> env.observation_space.shape
(86,)
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym

OPTIONS: dict[str, Any] = {"observation": "local", "flat": True, "reward_scale": 0.01}
"""Of `gymnasium.make("parkenv/Search-v2", ...)`, besides the scenario."""

_search = gym.spec("parkenv/Search-v2")
for _name in ("campus", "jam", "street", "mini"):
    if f"parkenv-flat/{_name}-v2" not in gym.registry:
        gym.register(
            id=f"parkenv-flat/{_name}-v2",
            entry_point=_search.entry_point,
            vector_entry_point=_search.vector_entry_point,
            max_episode_steps=_search.max_episode_steps,
            order_enforce=_search.order_enforce,
            kwargs={"scenario": _name, **OPTIONS},
        )
