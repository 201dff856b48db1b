"""The spaces of a search: its observations and actions."""

from __future__ import annotations

from collections.abc import Sequence
from operator import index
from typing import Any

import numpy as np
from gymnasium import spaces

from parkenv.engine.records import NEVER_OBSERVED, most_observed_in
from parkenv.errors import InputError
from parkenv.world.lot import ACTIONS, PARK
from parkenv.world.occupancy.day_error import MAX_LOGITS
from parkenv.world.scenario import SearchProblem

LATEST = 1e8  # bound, s, of the observed times: Gymnasium requires one, and no search takes three years
MAX_DECAY_RATE = 1e6  # bound, 1/s, of `decay_rate`


def space_of(scenarios: Sequence[SearchProblem], most_observed: int | None = None) -> spaces.Dict:
    """The observation space that fits the lots of all scenarios; see `Searches` for `most_observed`."""
    lots = [one.lot for one in scenarios]
    n_slots, n_vertices = max(lot.n_slots for lot in lots), max(lot.n_vertices for lot in lots)
    k = most_observed_in(scenarios) if most_observed is None else most_observed
    return search_space(n_slots, n_vertices, k)


def search_space(n_slots: int, n_vertices: int, most_observed: int) -> spaces.Dict:
    """The observation space for a lot of the given size; see `parkenv.envs.search.SearchEnv`."""
    belief = _box_of_parts([(0.0, 1.0), (0.0, MAX_DECAY_RATE), (0.0, 1.0), (NEVER_OBSERVED, LATEST)], n_slots)
    observed = _box_of_parts([(-1.0, n_slots - 1.0), *[(0.0, 1.0)] * 3], most_observed)
    return spaces.Dict(
        {
            "vertex": spaces.Discrete(n_vertices),
            "time": spaces.Box(0.0, LATEST, (2,), np.float32),
            "p_occupied": spaces.Box(0.0, 1.0, (n_slots,), np.float32),
            "belief": belief,
            "step_observed": observed,
            "day_error": spaces.Box(0.0, MAX_LOGITS, (2,), np.float32),
            "action_mask": spaces.Box(0, 1, (len(ACTIONS),), np.int8),
        }
    )


def _box_of_parts(bounds: Sequence[tuple[float, float]], length: int) -> spaces.Box:
    """Return the space of consecutive parts of equal length, with the bounds of each."""
    low, high = np.repeat(np.array(bounds, np.float32), length, axis=0).T
    return spaces.Box(low, high, dtype=np.float32)


def action_number(action: Any) -> int:
    """Return the number of an action, which may be an array of one as models return it.

    Raises:
        InputError: none of the five actions.
    """
    try:
        number = index(action)
    except TypeError:
        array = np.asarray(action)
        number = int(array.item()) if array.size == 1 and np.issubdtype(array.dtype, np.integer) else -1
    if not 0 <= number <= PARK:
        raise InputError(f"action is {action!r}, want a whole number from 0 to {PARK} ({', '.join(ACTIONS)})")
    return number
