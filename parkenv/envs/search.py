"""`parkenv/Search-v0`: decide at every stop where to drive, or to park."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from parkenv.belief import SlotBelief
from parkenv.errors import InputError
from parkenv.keyed_random import ENTRY_STREAM, SIGHTING_STREAM, VIEW_STREAM, keyed_uniform, world_key
from parkenv.lot import ACTIONS, PARK
from parkenv.occupancy import Arrival, World
from parkenv.scenario import Scenario
from parkenv.sighting import SightRates

if TYPE_CHECKING:
    from parkenv.envs.rendering import SearchRenderer

_TRIED = np.ones(1, dtype=np.bool_), np.ones(1), np.zeros(1)  # it is taken, and that is certain

LATEST = 1e8
"""Bound, s, of the observed times: Gymnasium wants one, and three years are more than any search takes."""
REWARD_TERMS = ("drive", "failed", "walk", "gave_up")


@dataclass
class SearchState:
    """Everything that changes during an episode; `SearchEnv.get_state` hands out a copy."""

    key: np.uint64
    arrival: Arrival
    world: World
    belief: SlotBelief
    vertex: int
    time: float
    passed: set[int]
    path: list[int]
    drive_s: float = 0.0
    failed_s: float = 0.0
    walk_s: float = 0.0
    gave_up_s: float = 0.0
    driven_m: float = 0.0
    walked_m: float = 0.0
    failed_parks: int = 0
    parked: bool = False
    over: bool = False

    def metrics(self) -> dict[str, Any]:
        """The episode so far, in the words of the result tables."""
        return {
            "drive_s": self.drive_s,
            "failed_s": self.failed_s,
            "walk_s": self.walk_s,
            "gave_up_s": self.gave_up_s,
            "total_s": self.drive_s + self.failed_s + self.walk_s + self.gave_up_s,
            "driven_m": self.driven_m,
            "walked_m": self.walked_m,
            "failed_parks": self.failed_parks,
            "slots_passed": len(self.passed),
            "parked": self.parked,
        }


class SearchEnv(gym.Env[dict[str, Any], np.int64]):
    """Find a free slot and walk from it to the goal, in as little time as possible.

    ## Description
    A car comes into a parking lot. It knows the lot and how often each slot tends to be taken, sees the
    slots near it as it drives past them, and decides at every stop where to go on, or to try to park
    there. Slots fill and empty while it drives. After Bogoslavskyi's thesis (Freiburg 2014), §3.4.

    ## Action space
    `Discrete(5)`

    | Num | Action | Effect |
    |-----|--------|--------|
    | 0-3 | up, down, left, right | drive along that edge of the graph; where there is none, wait `wait_s` |
    | 4 | park | park and walk to the goal if the slot here is free; lose `failure_s` if it is taken |

    Where there is no slot, parking is waiting, too.

    ## Observation space
    A `Dict`:

    | Key | Space | Meaning |
    |-----|-------|---------|
    | `vertex` | `Discrete(n_vertices)` | where the car is; vertex i < n_slots lies before slot i |
    | `time` | `Box(0, 1e8, (2,), float32)` | s since Monday 00:00; s since the search began |
    | `p_occupied` | `Box(0, 1, (n_slots,), float32)` | belief that each slot is taken |
    | `action_mask` | `Box(0, 1, (5,), int8)` | which actions the graph has here |

    The belief in a slot is the forecast until the slot is seen, then what was seen, relaxing to the forecast.

    ## Rewards
    Minus the seconds that the step took; parking adds minus the seconds of the walk, so the return is
    minus the total time to the goal. `info["reward_terms"]` holds the terms `drive` (moving or waiting),
    `failed` (tries at taken slots), `walk` and `gave_up`; they add up to the reward.

    ## Starting state
    At the scenario's entry, at a time drawn from its arrival window. The first observation is the forecast
    alone; slots are seen from the first step on, from wherever a step ends.
    With `reset(seed=s)` arrival, entry and every slot's comings and goings are the same whatever the agent
    does; later `reset()` calls go through further worlds of the same seed.

    ## Episode end
    - Terminated: parked; or the lot is *proven full*, that is every slot has been seen in this search and
      looked taken at its last look. Then the driver goes elsewhere, which costs `give_up_s`.
    - Truncated: after the step limit of the spec, 2000 (`max_episode_steps` of `gymnasium.make`).

    At the end `info` holds drive_s, failed_s, walk_s, gave_up_s, total_s, driven_m, walked_m, failed_parks,
    slots_passed (slots whose vertex was driven to) and parked. A wrapper's time limit is not part of
    `get_state`: it goes on counting.

    ## Arguments
    - `scenario`: a `Scenario`, or the name of a packaged one: campus, jam, street, mini.
    - `render_mode`: `rgb_array` (480, 640, 3), `human` (needs the extra `human`), or `ansi`.
    - further keywords replace fields of the scenario, e.g. `failure_s=90.0`; unknown ones are refused.

    ```python
    >>> import gymnasium as gym
    >>> import parkenv
    >>> env = gym.make("parkenv/Search-v0", scenario="mini", failure_s=5.0)
    >>> observation, info = env.reset(seed=0)
    >>> observation["p_occupied"].shape, env.action_space.n
    ((10,), np.int64(5))
    >>> observation, reward, terminated, truncated, info = env.step(3)
    >>> bool(np.isclose(reward, sum(info["reward_terms"].values())))
    True

    ```

    ## Version history
    - v0: first version.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium declares it so
        "render_modes": ["human", "rgb_array", "ansi"],
        "render_fps": 8,
    }
    observation_space: spaces.Dict

    def __init__(
        self, scenario: str | Scenario = "campus", render_mode: str | None = None, **changes: Any
    ) -> None:
        if isinstance(scenario, str):
            scenario = Scenario.named(scenario)
        elif not isinstance(scenario, Scenario):
            raise InputError(f"scenario is a {type(scenario).__name__}, want a Scenario or the name of one")
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise InputError(f"render_mode is {render_mode!r}, want one of {self.metadata['render_modes']}")
        self.scenario = scenario.replace(**changes)
        self.render_mode = render_mode
        lot = self.scenario.lot
        self.action_space = spaces.Discrete(len(ACTIONS))
        self.observation_space = spaces.Dict(
            {
                "vertex": spaces.Discrete(lot.n_vertices),
                "time": spaces.Box(0.0, LATEST, (2,), np.float32),
                "p_occupied": spaces.Box(0.0, 1.0, (lot.n_slots,), np.float32),
                "action_mask": spaces.Box(0, 1, (len(ACTIONS),), np.int8),
            }
        )
        self._masks = self.scenario.action_masks
        self._view_starts, self._view_slots = self.scenario.slots_in_view
        self._rates = self.scenario.sight_rates
        self._state: SearchState | None = None
        self._episode = 0
        self._renderer: SearchRenderer | None = None

    @property
    def state(self) -> SearchState:
        """The episode under way, hidden truth included. Not for agents.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._state is None:
            raise gym.error.ResetNeeded("the environment has no episode yet: call reset() first")
        return self._state

    def get_state(self) -> tuple[int, SearchState]:
        """A copy of the episode, which `set_state` brings back."""
        return self._episode, copy.deepcopy(self.state)

    def set_state(self, state: tuple[int, SearchState]) -> None:
        """Go on from a state that `get_state` of an environment with the same scenario returned."""
        episode, episode_state = state
        if len(episode_state.belief.p_occupied) != self.scenario.lot.n_slots:
            raise InputError(
                f"state is of a lot with {len(episode_state.belief.p_occupied)} slots, this one has "
                f"{self.scenario.lot.n_slots}"
            )
        self._episode, self._state = episode, copy.deepcopy(episode_state)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start a search; see the class for what a seed fixes. There are no options."""
        super().reset(seed=seed)
        if options:
            raise InputError(f"reset takes no options, got {', '.join(options)}")
        self._episode = 0 if seed is not None else self._episode + 1
        _ = self.np_random  # draws a seed where none was ever given
        key = world_key(self.np_random_seed, self._episode)
        scenario = self.scenario
        arrival = scenario.occupancy.draw_arrival(scenario.arrival, key)
        entries = scenario.lot.entry_vertices
        entry = scenario.entry
        if entry is None:
            entry = int(keyed_uniform(key, ENTRY_STREAM, 0, 0) * len(entries))
        vertex = int(entries[entry])
        self._state = SearchState(
            key=key,
            arrival=arrival,
            world=scenario.occupancy.world(key, arrival),
            belief=SlotBelief(scenario.forecast(arrival), arrival.time),
            vertex=vertex,
            time=arrival.time,
            passed=set(),
            path=[vertex],
        )
        if self.render_mode == "human":
            self.render()
        return self._observation(self._state), {}

    def step(self, action: np.int64 | int) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Drive along an edge, or try to park; see the class."""
        state, lot = self.state, self.scenario.lot
        if state.over:
            raise gym.error.ResetNeeded("the search is over: call reset()")
        chosen = _action_number(action)
        drive = failed = walk = gave_up = 0.0
        if not self._masks[state.vertex, chosen]:
            drive = self.scenario.wait_s
        elif chosen < PARK:
            drive = float(self.scenario.move_s[state.vertex, chosen])
            state.driven_m += float(lot.edge_length[state.vertex, chosen])
            state.vertex = int(lot.neighbors[state.vertex, chosen])
            state.path.append(state.vertex)
        elif state.world.occupied(np.array([state.vertex]), state.time)[0]:
            failed = self.scenario.failure_s
            state.failed_parks += 1
            state.belief.update(np.array([state.vertex]), *_TRIED)
        else:
            state.parked = True
            state.walked_m = float(lot.walk_m(self.scenario.goal)[state.vertex])
            walk = float(self.scenario.walk_s[state.vertex])
        state.time += drive + failed
        if not state.parked:
            self._look(state)
            if state.belief.proven_full:
                gave_up = self.scenario.give_up_s
        state.drive_s += drive
        state.failed_s += failed
        state.walk_s += walk
        state.gave_up_s += gave_up
        terminated = state.over = state.parked or state.belief.proven_full
        info: dict[str, Any] = {
            "reward_terms": dict(zip(REWARD_TERMS, (-drive, -failed, -walk, -gave_up), strict=True))
        }
        # A time limit ends the episode from outside, so the metrics are there at every step.
        info |= state.metrics()
        if self.render_mode == "human":
            self.render()
        return self._observation(state), -(drive + failed + walk + gave_up), terminated, False, info

    def action_masks(self) -> NDArray[np.bool_]:
        """(5,) bool, which actions the graph has here; the name that sb3-contrib looks for."""
        mask: NDArray[np.bool_] = self._masks[self.state.vertex].astype(np.bool_)
        return mask

    def render(self) -> Any:
        """A frame, a text, or the window brought up to date, as `render_mode` says."""
        if self.render_mode is None:
            gym.logger.warn(
                'render() does nothing without a render_mode, e.g. gym.make(..., render_mode="rgb_array")'
            )
            return None
        if self._renderer is None:
            from parkenv.envs.rendering import SearchRenderer

            self._renderer = SearchRenderer(self.scenario)
        state = self.state
        if self.render_mode == "ansi":
            return self._renderer.text(state)
        frame = self._frame(state)
        if self.render_mode == "human":
            self._renderer.show(frame, self.metadata["render_fps"])
            return None
        return frame

    def _frame(self, state: SearchState) -> NDArray[np.uint8]:
        """The lot from above."""
        assert self._renderer is not None
        everything = np.arange(self.scenario.lot.n_slots)
        return self._renderer.frame(state, state.world.occupied(everything, state.time))

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _look(self, state: SearchState) -> None:
        """See the slots in view of the car, as well as the sighting model lets it."""
        vertex, sighting = state.vertex, self.scenario.sighting
        if vertex < self.scenario.lot.n_slots:
            state.passed.add(vertex)
        rows = slice(self._view_starts[vertex], self._view_starts[vertex + 1])
        slots, rates = self._view_slots[rows], self._rates.of(rows)
        state.belief.relax(state.time)
        if not len(slots):
            return
        looks_taken = state.world.occupied(slots, state.time)
        if not sighting.perfect:
            # What hides a slot goes on hiding it: one chance a search, which a nearer look may beat.
            seen = _chances(state, VIEW_STREAM, slots, 0) < rates.seen
            slots, looks_taken, rates = slots[seen], looks_taken[seen], SightRates(*(r[seen] for r in rates))
            rate = np.where(looks_taken, rates.hit, rates.false_alarm)
            looks_taken = _chances(state, SIGHTING_STREAM, slots, int(state.time * 1000.0)) < rate
        state.belief.update(slots, looks_taken, rates.hit, rates.false_alarm)

    def _observation(self, state: SearchState) -> dict[str, Any]:
        return {
            "vertex": np.int64(state.vertex),
            "time": np.array([state.time, state.time - state.arrival.time], dtype=np.float32),
            "p_occupied": state.belief.p_occupied.astype(np.float32),
            "action_mask": self._masks[state.vertex].copy(),
        }


def _chances(state: SearchState, stream: int, slots: NDArray[np.int64], when: int) -> NDArray[np.float64]:
    """A uniform number for each slot, keyed by a time, ms: whoever looks at a slot then makes the same error."""
    return np.array([keyed_uniform(state.key, stream, int(s), when) for s in slots])


def _action_number(action: Any) -> int:
    """The action as an int; arrays of one element will do, as models return them."""
    number = np.asarray(action)
    if number.size != 1 or not np.issubdtype(number.dtype, np.integer) or not 0 <= number.item() <= PARK:
        raise InputError(f"action is {action!r}, want a whole number from 0 to {PARK} ({', '.join(ACTIONS)})")
    return int(number.item())
