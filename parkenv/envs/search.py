"""`parkenv/Search-v2`: search a parking lot for a free slot."""

from collections.abc import Callable, Mapping, Sequence
from copy import copy, deepcopy
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from parkenv.compiled.jit import entry_point
from parkenv.compiled.keyed_random import seed_state
from parkenv.engine.kernel import (
    begin_search_at,
    init_full_prior_at,
    observe_live_at,
    read_step,
    step_exact_at,
    step_noisy_at,
    step_result_at,
)
from parkenv.engine.local_observation import NEAR_SLOTS, Surroundings, local_space, observe_surroundings_at
from parkenv.engine.searches import START_OPTIONS, ScenarioRecords, Searches, choose_start
from parkenv.engine.spaces import BELIEF_PARTS, OBSERVATIONS, FlatLayout, action_number, space_of
from parkenv.engine.state import SearchState
from parkenv.errors import InputError, require, require_number, require_one_of, reset_options
from parkenv.scenarios.build import ScenarioSources, make_scenarios, require_changes
from parkenv.world.cost_terms import REWARD_TERMS
from parkenv.world.lot import ACTIONS
from parkenv.world.occupancy.process import raise_error
from parkenv.world.scenario import Scenario

if TYPE_CHECKING:
    from parkenv.show.frames.search import SearchRenderer

_REBUILT = {
    "searches", "scenario", "_state", "_address", "_scenario_index", "_step", "_seeded_with", "_begun", "_over"
}  # fmt: skip


NO_RENDER_MODE = 'render() does nothing without a render_mode, e.g. gym.make(..., render_mode="rgb_array")'


class SavedSearch(NamedTuple):
    arrays: tuple[NDArray[Any], ...]
    path: list[int]
    seeding: tuple[Any, ...] = ()  # the environment's generator of random numbers, and its seed


class SearchObserver:
    """What one search observes: `full`, `occupancy` or `local`, as a dictionary or one vector, in the space `space`."""

    def __init__(self, scenarios: Sequence[Scenario], observation: str, k: int | None, *, flat: bool) -> None:
        require_one_of("observation", observation, OBSERVATIONS)
        require(k is None or observation == "local", f"k is {k!r}, want None unless observation is local")
        space, self._around = space_of(scenarios), None
        if observation == "occupancy":
            space = spaces.Dict({name: box for name, box in space.items() if name not in BELIEF_PARTS})
        elif observation == "local":
            k = NEAR_SLOTS if k is None else k
            self._around, space = Surroundings.of(scenarios, k), local_space(k)
        self._flat = FlatLayout(space) if flat else None
        self.space: Any = space if self._flat is None else self._flat.space
        self._is_full = observation == "full" and not flat
        self._vertices = list(np.arange(max(scenario.lot.n_vertices for scenario in scenarios)))

    def __getstate__(self) -> dict[str, Any]:
        attached = "_address", "_copiers", "_copy_cues", "_masks", "_mask"
        return {name: value for name, value in vars(self).items() if name not in attached}

    def attach(self, searches: Searches, scenarios: Sequence[Scenario]) -> None:
        """Observe the first of some searches in these scenarios; `enter` says in which it is."""
        self._address = searches.address
        self._copiers, self._copy_cues = searches.copiers(0), searches.copier_of_cues(0)
        self._masks = [[mask.copy for mask in scenario.action_masks] for scenario in scenarios]

    def enter(self, scenario_index: int) -> None:
        self._mask = self._masks[scenario_index]

    def observe(self, vertex: int) -> Any:
        if not self._is_full:
            smaller = self._smaller(vertex)
            return smaller if self._flat is None else self._flat(smaller)
        time, p_occupied, belief, step_observed, day_error = self._copiers
        observation = {
            "vertex": self._vertices[vertex],
            "time": time(),
            "p_occupied": p_occupied(),
            "belief": belief(),
            "step_observed": step_observed(),
            "day_error": day_error(),
            "action_mask": self._mask[vertex](),
        }
        if self._copy_cues is not None:
            observation["cues"] = self._copy_cues()
        return observation

    def _smaller(self, vertex: int) -> dict[str, Any]:
        mask = self._mask[vertex]()
        if self._around is not None:
            local = np.empty(self._around.n_numbers, np.float32)
            observe_surroundings_at(self._address, self._around, local)
            return {"local": local, "action_mask": mask}
        time, p_occupied, _, _, day_error = self._copiers
        observation = {"vertex": self._vertices[vertex], "time": time(), "p_occupied": p_occupied()}
        return {**observation, "day_error": day_error(), "action_mask": mask}


class SearchEnv(gym.Env[dict[str, Any], np.int64]):
    """Find a free slot and walk from it to the goal, in as little time as possible.

    ## Description
    A car searches a parking lot for a free slot. The agent knows the lot and an occupancy forecast for each slot, and
    observes nearby slots while driving past. At every vertex of the drive graph it chooses a move or attempts to park.
    Meanwhile slots fill and empty. After Bogoslavskyi's thesis (Freiburg 2014), §3.4.

    ## Action space
    `Discrete(5)`

    | Num | Action | Effect |
    |-----|--------|--------|
    | 0-3 | up, down, left, right | drive along that edge of the graph; wait `wait_s` if there is none |
    | 4 | park | park and walk to the goal if the slot here is free; lose `failure_s` (failed attempt) if it is taken |

    At a vertex without a slot, `park` waits `wait_s`, too.

    ## Observation space
    A `Dict`:

    | Key | Space | Meaning |
    |-----|-------|---------|
    | `vertex` | `Discrete(n_vertices)` | position of the car; vertex i < n_slots is the stop position of slot i |
    | `time` | `Box(0, 1e8, (2,), float32)` | s since Monday 00:00; s since the search began |
    | `p_occupied` | `Box(0, 1, (n_slots,), float32)` | current P(taken) of each slot |
    | `belief` | `Box((4 * n_slots,), float32)` | the belief state behind `p_occupied`, four parts as below |
    | `step_observed` | `Box((4 * k,), float32)` | what the last step observed, four parts as below |
    | `day_error` | `Box(0, 5, (2,), float32)` | how far whole days differ from the forecast, logits, as below |
    | `action_mask` | `Box(0, 1, (5,), int8)` | the valid actions at this vertex |
    | `cues` | `Box((3 * n_slots,), float32)` | only with `scenario.cues`: what shows that cars leave |

    `belief` has four parts of n_slots numbers each; unpack them with
    `forecast, decay_rate, p_observed, observed_at = observation["belief"].reshape(4, -1)`:

    | Part | Name | Bounds | Meaning |
    |------|------|--------|---------|
    | 0 | `forecast` | 0, 1 | P(taken) forecast for the arrival; constant in an episode |
    | 1 | `decay_rate` | 0, 1e6 | 1/s, rate of decay to the forecast; constant in an episode |
    | 2 | `p_observed` | 0, 1 | P(taken) right after the last observation of the slot; the forecast before the first |
    | 3 | `observed_at` | -1, 1e8 | time of that observation, s since the search began; -1 before the first |

    `step_observed` has four parts of k numbers each, k being the most that a step observes; unpack them as `belief`.
    Part 0 holds the slots that the last step observed, in order, and -1 past the last of them. A parking attempt comes
    first, and observes without error; a slot may be observed again when the step ends.

    | Part | Name | Bounds | Meaning |
    |------|------|--------|---------|
    | 0 | `slot` | -1, n_slots - 1 | the slot; -1: none |
    | 1 | `taken` | 0, 1 | 1: observed taken; 0: observed free |
    | 2 | `hit_rate` | 0, 1 | P(observed taken if it is taken) |
    | 3 | `false_alarm_rate` | 0, 1 | P(observed taken if it is free) |

    `day_error` holds two standard deviations over days, in logits, `(level, slope)`; constant in an episode.
    A day has a level L ~ N(0, level²) and a slope S ~ N(0, slope²), which are not observed. It multiplies
    the odds that slot i is taken by `exp(L + S * nearness_i)` (times a constant, such that the forecast is the mean
    over days); nearness falls from 1 at the slot nearest to the goal to -1 at the farthest, by rank.

    An observation updates the belief in a slot by Bayes' rule; then the belief decays to the forecast:
    `p_occupied = forecast + (p_observed - forecast) * exp(-decay_rate * (time[1] - observed_at))`.

    `cues` has three parts: P(about to leave), beyond the usual, after a slot was observed taken; the rate, 1/s, at
    which such a car leaves; and what the last step observed, log P(it | about to leave) / P(it | not). See
    `parkenv.belief.cue_belief`.

    ## Rewards
    Minus the duration of the step, s. Parking also subtracts the walk to the goal and the slot's parking cost
    (`ParkingLot.slot_parking_cost_s`, 0 by default), so the return is minus the total time to the goal.
    `info` holds its parts, which add up: `reward_drive` (moving or waiting), `reward_failed` (failed attempts),
    `reward_walk`, `reward_parking` (the slot's cost) and `reward_gave_up`.

    ## Starting state
    The car is at the scenario's entry, at a time drawn from its arrival window. The first observation holds only the
    forecast; from then on the car observes slots from the vertex where each step ends.
    `reset(seed=s)` fixes arrival, entry and the state of every slot at every time, whatever the agent does; later
    `reset()` calls continue with further worlds of the same seed.

    `reset(options={"entry": 1, "arrival": "Tue 08:30", "scenario": "street"})`, or some of them, choose where and when
    this episode begins: the entry by its index; the arrival as a time of the week, s since Monday 00:00 or a text, on a
    weekday of the scenario's; the scenario by name or index, where there are several. The rest is drawn.

    ## Episode end
    - Terminated: parked; or the lot is *proven full*: every slot was observed in this search, and taken when last
      observed. Then the search ends with the give-up penalty `give_up_s`, the time to park elsewhere.
    - Truncated: after the step limit of the spec, 2000 (`max_episode_steps` of `gymnasium.make`).

    `info` holds numbers under the same keys after reset and step: the episode's metrics so far, drive_s, failed_s,
    walk_s, parking_cost_s, gave_up_s, total_s, driven_m, walked_m, failed_parks, slots_passed (slots whose vertex the
    car stopped at) and parked; scenario_index; and the parts of the reward.

    ## Several scenarios
    With several scenarios, each episode is in one of them, drawn from the seed and the number of the episode: the same
    seed gives the same ones, whatever the agent does. `env.unwrapped.scenario` is the scenario of the episode,
    `info["scenario_index"]` its index in `env.unwrapped.scenarios`. The observation space fits the largest lot: in
    smaller ones, slots past the last are taken (1) and never observed. `observation="local"` has the same size on
    every lot.

    ## Keys
    With `gymnasium.utils.play.play(env, wait_on_player=True, noop=4)` (extra `human`): w, s, a, d drive; space parks.

    ## Arguments
    - `scenario`: a name, such as `campus`, a scenario file (.toml), a lot (.geojson; with days as in busy
      real car parks), a folder of these, a `Scenario`, or a sequence of these; see `parkenv.make_scenarios`.
    - `render_mode`: `rgb_array` (480, 640, 3), `human` (needs the extra `human`), or `ansi`. A frame shows which
      slots are truly taken, hidden from the agent, and as colours the agent's belief.
    - `observation`: `full`, as above; `occupancy`, the same without `belief` and `step_observed`; or `local`, a `Dict`
      of `local` and `action_mask` that describes the car's surroundings, see `parkenv.engine.local_observation`.
    - `k`: number of slots that `local` describes, 5 if None.
    - `flat`: whether the observation is one vector, see `parkenv.engine.spaces.FlatLayout`; not with `full`.
    - `reward_scale`: factor of the rewards and their parts; times and metrics in `info` remain in seconds.
    - further keywords replace fields of the scenario, e.g. `failure_s=90.0`; unknown ones raise a TypeError.

    ```python
    >>> import gymnasium as gym
    >>> import numpy as np
    >>> import parkenv
    >>> env = gym.make("parkenv/Search-v2", scenario="mini", failure_s=5.0)
    >>> observation, info = env.reset(seed=0)
    >>> observation, reward, terminated, truncated, info = env.step(3)
    >>> bool(np.isclose(reward, sum(info[name] for name in info if name.startswith("reward_"))))
    True

    ```

    ## Version history
    - v2: observations gain `day_error` and `step_observed`; days of packaged scenarios differ from their forecast.
    - v1: observations gain `belief`.
    - v0: first version.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium declares it so
        "render_modes": ["human", "rgb_array", "ansi"],
        "render_fps": 8,
    }
    observation_space: spaces.Dict
    scenario: Scenario

    def __init__(
        self,
        scenario: ScenarioSources = "campus",
        render_mode: str | None = None,
        observation: str = "full",
        k: int | None = None,
        flat: bool = False,
        reward_scale: float = 1.0,
        **changes: Any,
    ) -> None:
        require_one_of("render_mode", render_mode, (None, *self.metadata["render_modes"]))
        require_changes((type(self),), changes)
        require_number("reward_scale", reward_scale, above=0.0)
        self.scenarios = tuple(make_scenarios(scenario, **changes))
        self.render_mode = render_mode
        self.action_space = spaces.Discrete(len(ACTIONS))
        self._observer = SearchObserver(self.scenarios, observation, k, flat=flat)
        self.observation_space = self._observer.space
        self.reward_scale = float(reward_scale)
        self._renderer: SearchRenderer | None = None
        self._make_search()

    def _make_search(self) -> None:
        self.searches = Searches(ScenarioRecords(self.scenarios), 1, full_belief=True)
        self._address = self.searches.address
        self._state = SearchState(self.searches)
        self._observer.attach(self.searches, self.scenarios)
        self._scenario_index = -1
        self._enter_scenario()
        self._seeded_with: int | None = None
        self._begun, self._over = False, True

    def _enter_scenario(self) -> None:
        index = int(self.searches.records["scenario_index"][0])
        if index != self._scenario_index:
            self._scenario_index, self.scenario = index, self.scenarios[index]
            self._is_exact = self.scenario.observes_exactly
            self._observer.enter(index)
            self._close_window()

    @property
    def state(self) -> SearchState:
        if not self._begun:
            raise gym.error.ResetNeeded("the environment has no episode yet: call reset() first")
        return self._state

    def get_state(self) -> SavedSearch:
        seeding = deepcopy((self._np_random, self._np_random_seed, self._seeded_with))
        return SavedSearch(self.searches.save(), list(self.state.path), seeding)

    def set_state(self, state: SavedSearch) -> None:
        """Continue from a state returned by `get_state` of an environment with the same scenario.

        The world is part of it: what follows is the true future once more. Plan with `parkenv.model`, not with this.
        """
        self.searches.restore(state.arrays)
        if state.seeding:
            self._np_random, self._np_random_seed, self._seeded_with = deepcopy(state.seeding)
        self._state.path = list(state.path)
        self._enter_scenario()
        self._step = self._stepper()
        self._begun, self._over = True, self._state.over

    def __getstate__(self) -> dict[str, Any]:
        rest = {k: v for k, v in self.__dict__.items() if k not in _REBUILT}
        return rest | {"saved": self.get_state() if self._begun else None}

    def __setstate__(self, content: dict[str, Any]) -> None:
        saved = content.pop("saved")
        self.__dict__.update(content)
        self._observer = copy(self._observer)
        self._make_search()
        if saved is not None:
            self.set_state(saved)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        starts = reset_options(options, START_OPTIONS)
        super().reset(seed=seed)
        if self.np_random_seed < 0:
            # `np_random` was set by hand: its seed is not known.
            super().reset(seed=int(self.np_random.integers(1 << 62)))
        record = self.searches.records[0]
        record["episode"] = 0 if seed is not None else record["episode"] + 1
        if seed is not None or self._seeded_with != self.np_random_seed:
            self._seeded_with = self.np_random_seed
            record["seed_state"] = seed_state(self.np_random_seed)
        if starts:
            _choose_start(self.searches, int(record["episode"]), starts)
        _arrive(self.searches, self._address)
        self._enter_scenario()
        if self.scenario.live_slots.size:
            observe_live_at(self._address)
        self._step = self._stepper()
        self._begun, self._over = True, False
        self._state.path = [self._state.vertex]
        if self.render_mode == "human":
            self.render()
        info = read_step(self._scenario_index, step_result_at(self._address))[3]
        return self._observation(self._state.vertex), info

    def step(self, action: np.int64 | int) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        if self._over:
            raise gym.error.ResetNeeded("the search has not begun, is over, or was closed: call reset()")
        number = action_number(action)
        # A wrapper's time limit may end the episode at any step, so every step has the metrics.
        reward, over, vertex, info = read_step(self._scenario_index, self._step(self._address, number))
        if self.searches.needs_python:
            raise_error()
        path = self._state.path
        if vertex != path[-1]:
            path.append(vertex)
        self._over = over
        if self.reward_scale != 1.0:
            reward *= self.reward_scale
            info |= {name: info[name] * self.reward_scale for name in REWARD_TERMS}
        if self.render_mode == "human":
            self.render()
        return self._observation(vertex), reward, over, False, info

    def _stepper(self) -> Callable[[int, int], tuple[Any, ...]]:
        return _compiled_step(self._is_exact)

    def action_masks(self) -> NDArray[np.bool_]:
        """Return the mask of valid actions at this vertex, (5,) bool; sb3-contrib expects this name."""
        return self.scenario.action_masks[self.state.vertex].astype(np.bool_)  # type: ignore[no-any-return]

    def render(self) -> Any:
        if self.render_mode is None:
            gym.logger.warn(NO_RENDER_MODE)
            return None
        if self._renderer is None:
            from parkenv.show.frames.search import SearchRenderer

            self._renderer = SearchRenderer(self.scenario)
        state = self.state
        if self.render_mode == "ansi":
            return self._renderer.text(state)
        frame = self._frame(state)
        if self.render_mode == "human":
            self._renderer.window.show(frame, self.metadata["render_fps"])
            return None
        return frame

    def _frame(self, state: SearchState) -> NDArray[np.uint8]:
        assert self._renderer is not None
        return self._renderer.frame(state)

    def get_keys_to_action(self) -> dict[tuple[int, ...], int]:
        return {(ord(key),): action for action, key in enumerate("wsad ")}

    def close(self) -> None:
        self._over = True
        self._close_window()

    def _close_window(self) -> None:
        if self._renderer is not None:
            self._renderer.window.close()
            self._renderer = None

    def _observation(self, vertex: int) -> Any:
        return self._observer.observe(vertex)


def _arrive(searches: Searches, address: int) -> None:
    begin_search_at(address)
    if searches.needs_python:
        searches.complete_arrival(0)
        init_full_prior_at(address)


def _choose_start(searches: Searches, episode: int, starts: Mapping[str, Any]) -> None:
    before = searches.records[0].copy()
    try:
        choose_start(searches, 0, episode, starts)
    except InputError:
        searches.records[0] = before  # so that no later reset uses what was valid of these options
        raise


@cache
def _compiled_step(exact: bool) -> Callable[[int, int], tuple[Any, ...]]:
    return entry_point(step_exact_at if exact else step_noisy_at, 0, 0)  # type: ignore[no-any-return]
