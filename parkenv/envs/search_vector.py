"""Compiled batches of searches: the `vector_entry_point` of `parkenv/Search-v2`."""

from collections.abc import Callable, Sequence
from copy import deepcopy
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.keyed_random import seed_state
from parkenv.engine.batch import (
    BeliefObserver,
    LocalObserver,
    Observer,
    Steps,
    arrive_all,
    copy_fields,
    first_wrong,
)
from parkenv.engine.local_observation import NEAR_SLOTS
from parkenv.engine.records import N_ACTIONS, SEARCH, STEP_FIELDS
from parkenv.engine.searches import START_OPTIONS, ScenarioRecords, choose_start
from parkenv.engine.spaces import BELIEF_PARTS, OBSERVATIONS, FlatLayout
from parkenv.engine.state import SearchState
from parkenv.errors import InputError, require, require_number, require_one_of, require_whole, reset_options
from parkenv.scenarios.build import ScenarioSources, make_scenarios, require_changes
from parkenv.show.tables import plural
from parkenv.world.cost_terms import METRICS, REWARD_TERMS
from parkenv.world.lot import ACTIONS, PARK
from parkenv.world.occupancy.process import raise_error

if TYPE_CHECKING:
    from parkenv.show.frames.search import SearchRenderer

MAX_ENVS = 1_000_000  # maximum number of environments
# Gymnasium's names of the masks that say which searches have a metric.
_WHICH = tuple(f"_{name}" for name in (*REWARD_TERMS, *METRICS, "scenario_index"))
# Types and places of the metrics and the step's terms in a SEARCH record.
_PLACES = [dict(SEARCH.fields or {})[name][:2] for name in (*METRICS, *STEP_FIELDS)]
_OFFSETS = np.array([offset for _, offset in _PLACES])
_TYPES = list({dtype for dtype, _ in _PLACES})
_METRIC_TYPES = [(name, _TYPES.index(dtype)) for name, (dtype, _) in zip(METRICS, _PLACES, strict=False)]


class ParkSearchVectorEnv(VectorEnv[dict[str, NDArray[Any]], IntArray, NDArray[Any]]):
    """A batch of `parkenv/Search-v2` environments in one compiled step.

    ## Description
    World, decisions, rewards, ends and observations are those of `parkenv/Search-v2`: search i of a batch reset with
    `seed=s` equals the single environment reset with `seed=s + i`, bit for bit, in this and all later episodes.

    ## Action space
    `MultiDiscrete([5, ...])`: up, down, left, right, park.

    ## Observation space
    - `observation="full"`: the `Dict` of `parkenv/Search-v2`, with a row for each search.
    - `observation="occupancy"`: the same without `belief` and `step_observed`, which saves copying them.
    - `observation="local"`: a `Dict` of `local` and `action_mask`; see `parkenv.engine.local_observation`. Its size and
      cost are the same on every lot.

    ## Rewards
    As in `parkenv/Search-v2`, float64. `reward_terms` holds the parts of the last step's.

    ## Starting state
    As in `parkenv/Search-v2`. `reset(seed=s)` gives search i the seed s + i; a sequence gives one seed to each.
    Without a seed, every search continues with the next world of its seed. The options `scenario`, `entry` and
    `arrival` hold for every search that is reset.

    ## Several scenarios
    Each search draws the scenario of each of its episodes, also at automatic resets, as `parkenv/Search-v2` does with
    its seed. `scenario_index` are the indices into `scenarios`; `info["scenario_index"]` has them after `reset`, and
    those of the searches that have ended. All searches share one set of tables; `table_bytes` and `memory_bytes` say
    how large they are. `n_scenarios` limits the draw to the first scenarios, from the next episodes on.

    ## Episode end
    As in `parkenv/Search-v2`; truncated after `max_episode_steps`. `autoreset_mode` then applies:

    - NEXT_STEP: the next step ignores the action and begins a new search, with reward 0;
    - SAME_STEP: a new search begins at once; `info["final_obs"]` and `info["final_info"]` hold the last observations
      and infos;
    - DISABLED: the caller resets searches with `reset(options={"reset_mask": ...})`.

    After `reset` and when a search ends, `info` has the values of the single environment; the masks `_drive_s` and so
    on say for which searches.

    ## Arguments
    - `num_envs`: number of environments.
    - `scenario`: as in `parkenv/Search-v2`: a scenario, its name, a file, a folder of files, or a sequence of these.
    - `observation`: full, occupancy or local; or a function of `ScenarioRecords` and `num_envs` that
      returns a `parkenv.engine.batch.Observer`.
    - `k`: number of slots that `local` describes, 5 if None.
    - `flat`, `reward_scale`: as in `parkenv/Search-v2`.
    - `max_episode_steps`: 2000 from `make_vec`; -1 or None for no limit.
    - `autoreset_mode`: NEXT_STEP, SAME_STEP or DISABLED of `gymnasium.vector.AutoresetMode`, or its value.
    - `copy`: False returns arrays that the next step overwrites, which saves copying them.
    - `render_mode`: `rgb_array`: `render()` returns a tuple with a frame of each search, (480, 640, 3) uint8.
    - further keywords replace fields of the scenarios, e.g. `failure_s=90.0`.

    ```python
    >>> import gymnasium as gym
    >>> import parkenv
    >>> envs = gym.make_vec("parkenv/Search-v2", 3, vectorization_mode="vector_entry_point", scenario="mini")
    >>> observations, infos = envs.reset(seed=0)
    >>> observations["p_occupied"].shape
    (3, 10)
    >>> observations, rewards, terminations, truncations, infos = envs.step(envs.action_space.sample())
    >>> rewards.shape
    (3,)

    ```

    Raises:
        InputError: an argument out of its range; the message names it.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium declares it so
        "render_modes": ["rgb_array"],
        "render_fps": 8,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        scenario: ScenarioSources = "campus",
        observation: str | Callable[[ScenarioRecords, int], Observer] = "full",
        k: int | None = None,
        max_episode_steps: int | None = 2000,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        copy: bool = True,
        render_mode: str | None = None,
        flat: bool = False,
        reward_scale: float = 1.0,
        **changes: Any,
    ) -> None:
        require_whole("num_envs", num_envs, least=1, most=MAX_ENVS)
        if max_episode_steps == -1:  # Gymnasium's word for no limit
            max_episode_steps = None
        if max_episode_steps is not None:
            require_whole("max_episode_steps", max_episode_steps, least=1, most=2**31 - 1)
        require_one_of("render_mode", render_mode, (None, "rgb_array"))
        mode = _mode_of(autoreset_mode)
        require_changes((type(self), ParkSearchVectorEnv), changes)
        require(k is None or observation == "local", f"k is {k!r}, want None unless observation is local")
        require_number("reward_scale", reward_scale, above=0.0)
        observer = _observer(observation, k) if isinstance(observation, str) else observation
        self.scenarios = tuple(make_scenarios(scenario, **changes))
        self.num_envs = n = int(num_envs)
        self.max_episode_steps = max_episode_steps
        self.metadata = self.metadata | {"autoreset_mode": mode}
        self._tables = ScenarioRecords(self.scenarios)
        self.observer = observer(self._tables, n)
        self.single_action_space = spaces.Discrete(N_ACTIONS)
        self._flat = FlatLayout(self.observer.space) if flat else None
        self.single_observation_space = self.observer.space if self._flat is None else self._flat.space
        self.reward_scale = float(reward_scale)
        self.action_space = batch_space(self.single_action_space, n)
        self.observation_space = batch_space(self.single_observation_space, n)
        self._limit = max_episode_steps or np.iinfo(np.int64).max
        self._mode, self._copy = mode, copy
        self._begun = False
        self.render_mode = render_mode
        self._renderers: dict[str, SearchRenderer] = {}
        self._nobody = np.zeros(n, dtype=np.bool_)
        self._done = self._nobody
        self._find_arrays()
        self._states = [SearchState(self._searches, i) for i in range(n if render_mode else 0)]

    def _find_arrays(self) -> None:
        self._searches, self._seen = self.observer.searches, self.observer.seen
        over = np.zeros((2, self.num_envs), np.bool_)
        self._steps = Steps(np.zeros(self.num_envs), over[0], over[1], self._seen["action_mask"])

    __copy__ = deepcopy

    def __getstate__(self) -> dict[str, Any]:
        rebuilt = "_searches", "_seen", "_steps"
        return {name: value for name, value in vars(self).items() if name not in rebuilt}

    def __setstate__(self, content: dict[str, Any]) -> None:
        vars(self).update(content)
        self._find_arrays()

    @property
    def reward_terms(self) -> dict[str, FloatArray]:
        records = self._searches.records
        fields = zip(REWARD_TERMS, STEP_FIELDS, strict=True)
        return {name: records[field] * -self.reward_scale for name, field in fields}

    @property
    def scenario_index(self) -> IntArray:
        if len(self.scenarios) == 1:
            return np.zeros(self.num_envs, np.int64)  # without reading all records
        return self._searches.records["scenario_index"].copy()

    @property
    def n_scenarios(self) -> int:
        """Number of scenarios, the first ones, from which those of the next episodes are drawn; settable."""
        return int(self._searches.records["n_scenarios"][0])

    @n_scenarios.setter
    def n_scenarios(self, n: int) -> None:
        require_whole("n_scenarios", n, least=1, most=len(self.scenarios))
        self._searches.records["n_scenarios"] = n

    @property
    def table_bytes(self) -> int:
        return self._tables.n_bytes + self.observer.table_bytes

    @property
    def memory_bytes(self) -> int:
        return self.table_bytes + self.observer.n_bytes

    def __repr__(self) -> str:
        places = plural(len(self.scenarios), "scenario")
        return f"{type(self).__name__}({self.num_envs} searches, {places}, {self.memory_bytes / 1e6:.1f} MB)"

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | Sequence[dict[str, Any]] | None = None,
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Start a search in every environment, or in those of `options["reset_mask"]`, (n_envs,) bool.

        Args:
            seed: seed of the first environment, counting up for the others; or a sequence of one per environment, where
                None continues with the next world of the environment's seed; or None to continue all of them.
            options: `reset_mask`, and those of `parkenv/Search-v2` for all searches that are reset; or a sequence of
                the latter, one for each search.

        Raises:
            InputError: an unknown option, or a number of seeds that differs from the number of environments.
        """
        starts, which = _starts_of(options, self.num_envs)
        require(self._begun or which.all(), "reset_mask leaves out environments that have no episode yet")
        seeds = _seeds_of(seed, self.num_envs)
        if not isinstance(seed, Sequence | np.ndarray):
            super().reset(seed=None if seed is None else int(seed))
        if not self._begun and None in seeds:
            # These never got a seed. If `np_random` was set by hand, its seed is unknown.
            _ = self.np_random
            known = self.np_random_seed
            first = int(self.np_random.integers(1 << 62)) if known is None or known < 0 else known
            seeds = [first + i if given is None else given for i, given in enumerate(seeds)]
        records = self._searches.records
        before = records.copy() if any(starts) else records
        try:
            for i in np.flatnonzero(which):
                given = seeds[i]
                if given is not None:
                    records[i]["seed_state"], records[i]["episode"] = seed_state(given), -1
                if starts[i]:
                    choose_start(self._searches, int(i), int(records[i]["episode"]) + 1, starts[i])
        except InputError:
            records[:] = before  # so that no later reset uses what was valid of these options
            raise
        self._begun = True
        self._arrive(which)
        self._step(np.zeros(self.num_envs, dtype=np.int64), which, ~which)
        self._done = self._done & ~which
        return self._observations(), self._info(which.copy())

    def close_extras(self, **kwargs: Any) -> None:
        del kwargs
        self._begun = False

    def step(
        self, actions: IntArray
    ) -> tuple[dict[str, NDArray[Any]], FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        if not self._begun:
            raise gym.error.ResetNeeded("the environments have no episode yet: call reset() first")
        actions = _checked(actions, self.num_envs)
        fresh = self._nobody
        if self._mode is AutoresetMode.NEXT_STEP:
            fresh = self._done
            if fresh.any():
                self._arrive(fresh)
        elif self._mode is AutoresetMode.DISABLED and self._done.any():
            raise gym.error.ResetNeeded(f"search {int(np.argmax(self._done))} is over: reset it")
        self._step(actions, fresh, self._nobody)
        steps = self._steps
        self._done = done = steps.terminated | steps.truncated
        info: dict[str, Any] = {}
        if done.any():
            info = self._info(done.copy())
            if self._mode is AutoresetMode.SAME_STEP:
                info = {"final_info": info, "_final_info": done.copy()}
                info["final_obs"], info["_final_obs"] = self._final_observations(done), done.copy()
        results = steps.rewards, steps.terminated, steps.truncated
        if self._copy or self._mode is AutoresetMode.SAME_STEP:
            results = steps.rewards.copy(), steps.terminated.copy(), steps.truncated.copy()
        if self.reward_scale != 1.0:
            results = results[0] * self.reward_scale, *results[1:]
        if self._mode is AutoresetMode.SAME_STEP and done.any():
            self._arrive(done)
            self._step(actions, done, ~done)
            self._done = self._nobody
        return self._observations(), *results, info

    def _step(self, actions: IntArray, fresh: BoolArray, idle: BoolArray) -> None:
        self.observer.step(actions, fresh, idle, self._limit, self._steps)
        if self._searches.needs_python:
            raise_error()
        for state in self._states:
            state.extend_path()

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        if self.render_mode is None:
            gym.logger.warn("render() does nothing without render_mode='rgb_array'")
            return None
        if not self._begun:
            raise gym.error.ResetNeeded("the environments have no episode yet: call reset() first")
        from parkenv.show.frames.search import SearchRenderer

        for scenario in {state.scenario.name: state.scenario for state in self._states}.values():
            if scenario.name not in self._renderers:
                self._renderers[scenario.name] = SearchRenderer(scenario)
        return tuple(self._renderers[state.scenario.name].frame(state) for state in self._states)

    def _arrive(self, which: BoolArray) -> None:
        searches = self._searches
        arrive_all(self.observer.address, which)
        for i in np.flatnonzero(which[: len(self._states)]):
            self._states[i].path = []
        if searches.needs_python:
            for i in np.flatnonzero(which):
                searches.complete_arrival(int(i))

    def _info(self, done: BoolArray) -> dict[str, Any]:
        info = _metrics(self.observer.address, done, self.reward_scale)
        info["scenario_index"] = self.scenario_index
        return info | dict.fromkeys(_WHICH, done)

    def _observations(self) -> Any:
        observations = self.observer.observations() if self._copy else dict(self._seen)
        return observations if self._flat is None else self._flat(observations)

    def _final_observations(self, done: BoolArray) -> NDArray[np.object_]:
        final = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(done):
            final[i] = (self._flat or dict)({name: a[i].copy() for name, a in self._seen.items()})
        return final


def _mode_of(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        known = ", ".join(m.value for m in AutoresetMode)
        raise InputError(f"autoreset_mode is {mode!r}, want one of {known}") from None


def _starts_of(options: Any, n: int) -> tuple[list[dict[str, Any]], BoolArray]:
    """Return where and when each of n searches begins, as options of `reset` say, and which of them do, (n,) bool."""
    given = None
    if isinstance(options, Sequence):
        starts = [reset_options(own, START_OPTIONS) for own in options]
        require(len(starts) == n, f"options are {len(starts)}, want {n}, or one for all")
    else:
        start = reset_options(options, (*START_OPTIONS, "reset_mask"))
        given = start.pop("reset_mask", None)
        starts = [start] * n
    which = np.ones(n, dtype=np.bool_) if given is None else np.asarray(given)
    require(
        which.shape == (n,) and which.dtype == np.bool_,
        f"reset_mask has shape {which.shape} and type {which.dtype}, want ({n},) bool",
    )
    return starts, which


def _seeds_of(seed: int | Sequence[int | None] | None, n: int) -> list[int | None]:
    if seed is None:
        return [None] * n
    if not isinstance(seed, Sequence | np.ndarray):
        require_whole("seed", seed)
        return [int(seed) + i for i in range(n)]
    require(len(seed) == n, f"seed holds {len(seed)} numbers, want {n}, one for each environment")
    return list(seed)


def _checked(actions: Any, n: int) -> IntArray:
    actions = np.asarray(actions)
    if actions.shape != (n,) or actions.dtype.kind not in "iu":
        raise InputError(
            f"actions have shape {actions.shape} and type {actions.dtype}, want ({n},) whole numbers"
        )
    checked: IntArray = actions.astype(np.int64, copy=False)
    if (wrong := first_wrong(checked)) >= 0:
        raise InputError(
            f"actions[{wrong}] is {checked[wrong]}, want a number from 0 to {PARK} ({', '.join(ACTIONS)})"
        )
    return checked


def _metrics(address: int, done: BoolArray, scale: float) -> dict[str, Any]:
    """Return metrics and parts of the rewards of the searches that are done, in the memory of all."""
    words = np.zeros((len(_OFFSETS), len(done)), np.int64)
    copy_fields(address, done, _OFFSETS, words)
    # A type of fewer bytes stands at the beginning of its eight.
    views = [words.view(dtype)[:, :: 8 // dtype.itemsize] for dtype in _TYPES]
    metrics: dict[str, Any] = {name: views[dtype][i] for i, (name, dtype) in enumerate(_METRIC_TYPES)}
    costs = words[len(METRICS) :].view(np.float64)
    return metrics | dict(zip(REWARD_TERMS, np.multiply(costs, -scale, out=costs), strict=True))


def _observer(observation: str, k: int | None) -> Callable[[ScenarioRecords, int], Observer]:
    if observation == "full":
        return BeliefObserver
    if observation == "occupancy":
        return partial(BeliefObserver, without=BELIEF_PARTS)
    if observation == "local":
        return partial(LocalObserver, k=NEAR_SLOTS if k is None else k)
    raise InputError(f"observation is {observation!r}, want one of {', '.join(OBSERVATIONS)}")
