"""The spaces of a search: its observations and actions."""

from collections.abc import Mapping, Sequence
from operator import index
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from parkenv.belief.cue_belief import MOST_EVIDENCE
from parkenv.engine.records import NEVER_OBSERVED
from parkenv.engine.searches import most_observed_in
from parkenv.errors import InputError
from parkenv.world.lot import ACTIONS, PARK
from parkenv.world.occupancy.day_error import MAX_LOGITS
from parkenv.world.scenario import SearchProblem
from parkenv.world.week import DAY_S

LATEST = 1e8  # bound, s, of the observed times: Gymnasium requires one, and no search takes three years
# What a search may observe; see `parkenv.envs.search.SearchEnv`.
OBSERVATIONS = ("full", "occupancy", "local")
BELIEF_PARTS = ("belief", "step_observed", "cues")  # what `occupancy` leaves out of `full`
MAX_DECAY_RATE = 1e6  # bound, 1/s, of `decay_rate`
_CUE_PARTS = [(-1.0, 1.0), (0.0, MAX_DECAY_RATE), (-MOST_EVIDENCE, MOST_EVIDENCE)]
_FLAT = ("p_occupied", "day_error", "action_mask")


def space_of(scenarios: Sequence[SearchProblem], most_observed: int | None = None) -> spaces.Dict:
    """The observation space that fits the lots of all scenarios; see `Searches` for `most_observed`."""
    lots = [scenario.lot for scenario in scenarios]
    n_slots, n_vertices = max(lot.n_slots for lot in lots), max(lot.n_vertices for lot in lots)
    k = most_observed_in(scenarios) if most_observed is None else most_observed
    return search_space(n_slots, n_vertices, k, any(scenario.cues is not None for scenario in scenarios))


def search_space(n_slots: int, n_vertices: int, most_observed: int, cues: bool = False) -> spaces.Dict:
    belief = _box_of_parts([(0.0, 1.0), (0.0, MAX_DECAY_RATE), (0.0, 1.0), (NEVER_OBSERVED, LATEST)], n_slots)
    observed = _box_of_parts([(-1.0, n_slots - 1.0), *[(0.0, 1.0)] * 3], most_observed)
    further = {"cues": _box_of_parts(_CUE_PARTS, n_slots)} if cues else {}
    return spaces.Dict(
        {
            "vertex": spaces.Discrete(n_vertices),
            "time": spaces.Box(0.0, LATEST, (2,), np.float32),
            "p_occupied": spaces.Box(0.0, 1.0, (n_slots,), np.float32),
            "belief": belief,
            "step_observed": observed,
            "day_error": spaces.Box(0.0, MAX_LOGITS, (2,), np.float32),
            "action_mask": spaces.Box(0, 1, (len(ACTIONS),), np.int8),
            **further,
        }
    )


class FlatLayout:
    """Turns observations into one vector each, for learners that take no `Dict`.

    A vector is `local`, if the observation has it: it tells which moves there are. Else it has these parts:

    | Part | Size | Meaning |
    |---|---|---|
    | vertex | n_vertices | 1 at the vertex of the car, 0 elsewhere |
    | time | 3 | s / (s + 60) of the s seconds since the search began; sine and cosine of the time of day |
    | `p_occupied` | n_slots | as observed |
    | `day_error` | 2 | as observed |
    | `action_mask` | 5 | as observed |

    Args:
        space: of the observations.

    Attributes:
        space: of the vectors, float32.
    """

    def __init__(self, space: spaces.Dict) -> None:
        self._is_local = "local" in space.spaces
        if self._is_local:
            self.space = space["local"]
            return
        if "p_occupied" not in space.spaces or "belief" in space.spaces:
            raise InputError("flat is True, want an observation other than full, such as local or occupancy")
        vertex: Any = space["vertex"]
        self._vertices = np.eye(int(vertex.n), dtype=np.float32)
        rest = [space[name] for name in _FLAT]
        low = np.concatenate([np.zeros(vertex.n + 1), [-1.0, -1.0], *(box.low for box in rest)])  # type: ignore[attr-defined]
        high = np.concatenate([np.ones(vertex.n + 3), *(box.high for box in rest)])  # type: ignore[attr-defined]
        self.space = spaces.Box(low.astype(np.float32), high.astype(np.float32))

    def __call__(self, observation: Mapping[str, Any]) -> NDArray[np.float32]:
        """Return the vector of an observation, or those of a batch, (n, size) float32."""
        if self._is_local:
            local: NDArray[np.float32] = observation["local"]
            return local
        now, elapsed = np.moveaxis(observation["time"], -1, 0)
        angle = now * (2.0 * np.pi / DAY_S)
        times = np.stack([elapsed / (elapsed + 60.0), np.sin(angle), np.cos(angle)], axis=-1)
        parts = [self._vertices[observation["vertex"]], times, *(observation[name] for name in _FLAT)]
        return np.concatenate(parts, axis=-1, dtype=np.float32)


def _box_of_parts(bounds: Sequence[tuple[float, float]], length: int) -> spaces.Box:
    low, high = np.repeat(np.array(bounds, np.float32), length, axis=0).T
    return spaces.Box(low, high, dtype=np.float32)


def action_number(action: Any) -> int:
    """Return the number of an action, which may be an array of one as models return it."""
    try:
        number = index(action)
    except TypeError:
        array = np.asarray(action)
        number = int(array.item()) if array.size == 1 and np.issubdtype(array.dtype, np.integer) else -1
    if not 0 <= number <= PARK:
        raise InputError(f"action is {action!r}, want a whole number from 0 to {PARK} ({', '.join(ACTIONS)})")
    return number
