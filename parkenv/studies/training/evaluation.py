"""Evaluations of trained models: episodes in a batch, and their total times."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.studies.simulate import charge_truncation
from parkenv.studies.statistics import mean_interval
from parkenv.studies.training.configs import MAX_STEPS
from parkenv.studies.training.curve_file import Row
from parkenv.world.scenario import Scenario
from planners.model_file import slots_observed

Times = tuple[NDArray[np.float64], NDArray[np.bool_]]
"""Total time of each episode, s, and whether its car parked."""


def times_row(times: NDArray[np.float64], parked: NDArray[np.bool_]) -> Row:
    """Return the total times of episodes as columns of `parkenv compare`."""
    mean, low, high = mean_interval(times)
    return {
        "episodes": len(times),
        "parked_fraction": float(parked.mean()),
        "total_s": mean,
        "total_s_ci95": [low, high],
    }


def episode_times(model: Any, places: Scenario | Sequence[Scenario], seeds: Sequence[int]) -> Times:
    """Run episodes; return their total times, (n,) s, and whether the car parked, (n,) bool.

    An episode that has not ended after `MAX_STEPS` decisions is charged `give_up_s`, as in `parkenv compare`.

    Args:
        model: a stable-baselines3 or sb3-contrib model of the `local` observation.
        places: scenario to search in; or several, of which each seed draws one.
        seeds: one episode each.
    """
    n = len(seeds)
    k = slots_observed(model.observation_space)
    batch = ParkSearchVectorEnv(n, places, "local", k, MAX_STEPS)
    seen, _ = batch.reset(seed=list(seeds))
    give_up_s = np.array([scenario.give_up_s for scenario in batch.scenarios])[batch.place_of]
    times, parked = np.full(n, np.nan), np.zeros(n, dtype=np.bool_)
    state, start = None, np.ones(n, dtype=np.bool_)
    masked = "action_masks" in model.predict.__code__.co_varnames
    while np.isnan(times).any():
        masks = {"action_masks": seen["action_mask"]} if masked else {}
        actions, state = model.predict(seen, state=state, episode_start=start, deterministic=True, **masks)
        seen, _, terminated, truncated, info = batch.step(actions)
        start = terminated | truncated
        first = start & np.isnan(times)
        if first.any():
            charge_truncation(info, give_up_s, truncated & ~terminated)
            times[first] = info["total_s"][first]
            parked[first] = info["parked"][first]
    return times, parked
