"""A compiled batch of searches: the `vector_entry_point` of `parkenv/Search-v2`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, create_empty_array
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.keyed_random import seed_state
from parkenv.compiled.memory import uint8s
from parkenv.engine.kernel import (
    arrive,
    init_prior,
    refresh_belief,
    step_cost_s,
    take_step,
    write_clock,
)
from parkenv.engine.local_observation import Surroundings, local_space, observe_surroundings
from parkenv.engine.records import N_ACTIONS, STEP_FIELDS, ScenarioRecords, Searches, scenario_at, search_at
from parkenv.engine.spaces import space_of
from parkenv.envs.search_prefetch import prefetch_searches
from parkenv.errors import InputError
from parkenv.scenarios.build import ScenarioSources, make_scenarios
from parkenv.world.cost_terms import METRICS, REWARD_TERMS
from parkenv.world.lot import ACTIONS, PARK
from parkenv.world.occupancy.kernel import kernel
from parkenv.world.occupancy.python_functions import raise_error

OBSERVATIONS = ("full", "occupancy", "local")
MAX_ENVS = 1_000_000
"""Maximum number of environments."""
# Gymnasium's names of the masks that say which searches have a metric.
_WHICH = tuple(f"_{name}" for name in ("reward_terms", *METRICS, "place"))
_WHICH_TERMS = tuple(f"_{name}" for name in REWARD_TERMS)


class Steps(NamedTuple):
    """The results of a step, besides observations.

    Attributes:
        rewards: (n,) float64.
        terminated, truncated: (n,) bool.
    """

    rewards: FloatArray
    terminated: BoolArray
    truncated: BoolArray

    @classmethod
    def of(cls, n: int) -> Self:
        """Return the initial results for n searches."""
        return cls(np.zeros(n), np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_))


@kernel
def arrive_all(address: int, which: BoolArray) -> None:
    """Put cars at the entries of their next worlds."""
    for e in range(len(which)):
        if which[e]:
            search = search_at(address, e)
            search.episode += 1
            arrive(search)


@kernel
def step_full(
    address: int,
    actions: IntArray,
    fresh: BoolArray,
    idle: BoolArray,
    limit: int,
    steps: Steps,
    vertex: IntArray,
    time: NDArray[np.float32],
    mask: NDArray[np.int8],
) -> None:
    """Step all searches except idle and fresh ones, and observe."""
    for e in range(len(actions)):
        if idle[e]:
            continue
        search = search_at(address, e)
        if fresh[e]:
            init_prior(search)
        else:
            take_step(search, actions[e])
            refresh_belief(search)
        report_step(search, e, fresh[e], limit, steps, mask)
        write_clock(search)
        vertex[e], time[e, 0], time[e, 1] = search.vertex, search.clock[0], search.clock[1]


@kernel
def step_local(
    address: int,
    around: Surroundings,
    actions: IntArray,
    fresh: BoolArray,
    idle: BoolArray,
    limit: int,
    steps: Steps,
    local: NDArray[np.float32],
    mask: NDArray[np.int8],
) -> None:
    """As `step_full`, with the local observation."""
    for e in range(len(actions)):
        prefetch_searches(address, around, actions, e)
        if idle[e]:
            continue
        search = search_at(address, e)
        if not fresh[e]:
            take_step(search, actions[e])
        report_step(search, e, fresh[e], limit, steps, mask)
        observe_surroundings(search, around, local[e])


@kernel
def first_wrong(actions: IntArray) -> int:
    """Return the index of the first invalid action, or -1."""
    for e in range(len(actions)):
        if not 0 <= actions[e] < N_ACTIONS:
            return e
    return -1


@kernel
def report_step(search: Any, e: int, fresh: bool, limit: int, steps: Steps, mask: NDArray[np.int8]) -> None:
    """Write a search's reward, end of episode and action mask."""
    masks = uint8s(scenario_at(search.scenario, 0).action_masks)
    for action in range(N_ACTIONS):
        mask[e, action] = masks[search.vertex * N_ACTIONS + action]
    if fresh:
        steps.rewards[e] = 0.0
        steps.terminated[e] = steps.truncated[e] = False
        return
    steps.rewards[e] = -step_cost_s(search)
    steps.terminated[e] = search.over
    steps.truncated[e] = search.n_steps >= limit


class ParkSearchVectorEnv(VectorEnv[dict[str, NDArray[Any]], IntArray, NDArray[Any]]):
    """A batch of `parkenv/Search-v2` environments in one compiled step.

    ## Description
    World, decisions, rewards, ends and observations are those of `parkenv/Search-v2`: search i of a batch reset with
    `seed=s` equals the single environment reset with `seed=s + i`, bit for bit, in this and all later episodes.

    ## Action space
    `MultiDiscrete([5, ...])`: up, down, left, right, park.

    ## Observation space
    - `observation="full"`: the `Dict` of `parkenv/Search-v2`, with a row for each search.
    - `observation="occupancy"`: the same without `belief`, which saves copying it.
    - `observation="local"`: a `Dict` of `local` and `action_mask`; see `parkenv.engine.local_observation`. Its size and
      cost are the same on every lot.

    ## Rewards
    As in `parkenv/Search-v2`, float64. `reward_terms` holds the last step's terms.

    ## Starting state
    As in `parkenv/Search-v2`. `reset(seed=s)` gives search i the seed s + i; a sequence gives one seed to each.
    Without a seed, every search continues with the next world of its seed.

    ## Places
    With several scenarios, each search draws the place of each of its episodes, also at automatic resets, as
    `parkenv/Search-v2` does with its seed. `place_of` are the indices into `scenarios`; `info["place"]` names the
    places after `reset`, and those of the searches that have ended. All searches share one set of tables of the places;
    `table_bytes` and `memory_bytes` say how large they are. `n_places` limits the draw to the first scenarios, from the
    next episodes on.

    ## Episode end
    As in `parkenv/Search-v2`; truncated after `max_episode_steps`. `autoreset_mode` then applies:

    - NEXT_STEP: the next step ignores the action and begins a new search, with reward 0;
    - SAME_STEP: a new search begins at once; `info["final_obs"]` and `info["final_info"]` hold the last observations
      and infos;
    - DISABLED: the caller resets searches with `reset(options={"reset_mask": ...})`.

    When a search ends, `info` has its metrics, as in the single environment; the masks `_drive_s` and so on say which
    searches have ended.

    ## Arguments
    - `num_envs`: number of environments.
    - `scenario`: as in `parkenv/Search-v2`: a scenario, its name, a file, a folder of files, or a sequence of these.
    - `observation`: full, occupancy or local.
    - `k`: number of slots that `local` describes.
    - `max_episode_steps`: 2000 from `make_vec`.
    - `autoreset_mode`: NEXT_STEP, SAME_STEP or DISABLED of `gymnasium.vector.AutoresetMode`, or its value.
    - `copy`: False returns arrays that the next step overwrites, which saves copying them.
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
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        scenario: ScenarioSources = "campus",
        observation: str = "full",
        k: int = 5,
        max_episode_steps: int | None = 2000,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        copy: bool = True,
        render_mode: str | None = None,
        **changes: Any,
    ) -> None:
        _require_count("num_envs", num_envs, MAX_ENVS)
        if max_episode_steps is not None:
            _require_count("max_episode_steps", max_episode_steps, 2**31 - 1)
        if observation not in OBSERVATIONS:
            raise InputError(f"observation is {observation!r}, want one of {', '.join(OBSERVATIONS)}")
        if render_mode is not None:
            raise InputError(f"render_mode is {render_mode!r}, want None: a batch draws no pictures")
        try:
            mode = AutoresetMode(autoreset_mode)
        except ValueError:
            known = ", ".join(m.value for m in AutoresetMode)
            raise InputError(f"autoreset_mode is {autoreset_mode!r}, want one of {known}") from None
        self.scenarios = tuple(make_scenarios(scenario, **changes))
        self.num_envs = int(num_envs)
        self.max_episode_steps = max_episode_steps
        self.metadata = self.metadata | {"autoreset_mode": mode}
        self.single_action_space = spaces.Discrete(N_ACTIONS)
        self._full = observation != "local"
        if self._full:
            space = space_of(self.scenarios)
            if observation == "occupancy":
                space = spaces.Dict({name: one for name, one in space.items() if name != "belief"})
            self.single_observation_space = space
            self._surroundings: Surroundings | None = None
        else:
            self._surroundings = Surroundings.of(self.scenarios, k)
            self.single_observation_space = local_space(k)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        n = self.num_envs
        self._tables = ScenarioRecords(self.scenarios)
        self._searches = Searches(self._tables, n, self._full)
        self._names = np.array([one.name for one in self.scenarios])
        empty: Any = create_empty_array(self.single_observation_space, n)
        self._seen: dict[str, NDArray[Any]] = empty
        if self._full:
            self._seen["p_occupied"] = self._searches.p_occupied
            self._seen["day_error"] = self._searches.day_error
        if "belief" in self._seen:
            self._seen["belief"] = self._searches.belief.reshape(n, -1)
        self._steps = Steps.of(n)
        self._limit = max_episode_steps or np.iinfo(np.int64).max
        self._mode, self._copy = mode, copy
        self._begun = False
        self._nobody = np.zeros(n, dtype=np.bool_)
        self._done = self._nobody

    @property
    def reward_terms(self) -> dict[str, FloatArray]:
        """The terms of the last step's rewards, (n_envs,) each."""
        records = self._searches.records
        return {name: -records[field] for name, field in zip(REWARD_TERMS, STEP_FIELDS, strict=True)}

    @property
    def place_of(self) -> IntArray:
        """Index into `scenarios` of the place of each search, (n_envs,)."""
        place: IntArray = self._searches.records["place"].copy()
        return place

    @property
    def n_places(self) -> int:
        """Number of scenarios, the first ones, from which the places of the next episodes are drawn; settable."""
        return int(self._searches.records["n_places"][0])

    @n_places.setter
    def n_places(self, n: int) -> None:
        _require_count("n_places", n, len(self.scenarios))
        self._searches.records["n_places"] = n

    @property
    def bytes_each(self) -> float:
        """Memory of one search, bytes, after observing every slot; without the shared tables of the scenarios."""
        own = (a for name, a in self._seen.items() if name not in ("p_occupied", "belief", "day_error"))
        return (self._searches.n_bytes + sum(a.nbytes for a in (*own, *self._steps))) / self.num_envs

    @property
    def table_bytes(self) -> int:
        """Memory of the tables of all scenarios, bytes, which all searches share."""
        around = self._surroundings
        return self._tables.n_bytes + (0 if around is None else around.n_bytes)

    @property
    def memory_bytes(self) -> int:
        """Memory of the batch, bytes: tables and searches, at most; what is never used takes none."""
        return self.table_bytes + round(self.bytes_each * self.num_envs)

    def __repr__(self) -> str:
        places = f"{len(self.scenarios)} place{'s' * (len(self.scenarios) > 1)}"
        return f"{type(self).__name__}({self.num_envs} searches, {places}, {self.memory_bytes / 1e6:.1f} MB)"

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Start a search in every environment, or in those of `options["reset_mask"]`, (n_envs,) bool.

        Args:
            seed: seed of the first environment, counting up for the others; or a sequence of one per environment, where
                None continues with the next world of the environment's seed; or None to continue all of them.
            options: only `reset_mask`.

        Raises:
            InputError: an unknown option, or a number of seeds that differs from the number of environments.
        """
        which = self._chosen(options)
        if seed is None or isinstance(seed, (int, np.integer)):
            super().reset(seed=None if seed is None else int(seed))
        seeds = [seed] * self.num_envs if seed is None or isinstance(seed, (int, np.integer)) else list(seed)
        if len(seeds) != self.num_envs:
            raise InputError(
                f"seed holds {len(seeds)} numbers, want {self.num_envs}, one for each environment"
            )
        if isinstance(seed, (int, np.integer)):
            seeds = [int(seed) + i for i in range(self.num_envs)]
        elif not self._begun and None in seeds:
            # These never got a seed. If `np_random` was set by hand, its seed is unknown.
            _ = self.np_random
            known = self.np_random_seed
            first = int(self.np_random.integers(1 << 62)) if known is None or known < 0 else known
            seeds = [first + i if one is None else one for i, one in enumerate(seeds)]
        records = self._searches.records
        for i in np.flatnonzero(which):
            one = seeds[i]
            if one is not None:
                records[i]["seed_state"], records[i]["episode"] = seed_state(one), -1
        self._begun = True
        self._arrive(which)
        self._step(np.zeros(self.num_envs, dtype=np.int64), which, ~which)
        self._done = self._done & ~which
        return self._observations(), {"place": self._names[self.place_of], "_place": which}

    def get_state(self) -> tuple[NDArray[Any], ...]:
        """Return a copy of the state of all searches, for `set_state`."""
        return self._searches.save()

    def set_state(self, state: tuple[NDArray[Any], ...]) -> None:
        """Continue from a state that `get_state` returned for the same scenarios; no search in it may be over."""
        self._searches.restore(state)
        self._begun, self._done = True, self._nobody

    def step(
        self, actions: IntArray
    ) -> tuple[dict[str, NDArray[Any]], FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Take an action, (n_envs,) int, in every environment; see the class."""
        if not self._begun:
            raise gym.error.ResetNeeded("the environments have no episode yet: call reset() first")
        actions = np.asarray(actions)
        if actions.shape != (self.num_envs,) or actions.dtype.kind not in "iu":
            raise InputError(
                f"actions have shape {actions.shape} and type {actions.dtype}, want ({self.num_envs},) whole numbers"
            )
        actions = actions.astype(np.int64, copy=False)
        wrong = first_wrong(actions)
        if wrong >= 0:
            raise InputError(
                f"actions[{wrong}] is {actions[wrong]}, want a number from 0 to {PARK} ({', '.join(ACTIONS)})"
            )
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
            info = self._metrics(done.copy())
            if self._mode is AutoresetMode.SAME_STEP:
                info = {"final_info": info, "_final_info": done.copy()}
                info["final_obs"], info["_final_obs"] = self._final_observations(done), done.copy()
        results = steps.rewards, steps.terminated, steps.truncated
        if self._copy or self._mode is AutoresetMode.SAME_STEP:
            results = steps.rewards.copy(), steps.terminated.copy(), steps.truncated.copy()
        if self._mode is AutoresetMode.SAME_STEP and done.any():
            self._arrive(done)
            self._step(actions, done, ~done)
            self._done = self._nobody
        return self._observations(), *results, info

    def _step(self, actions: IntArray, fresh: BoolArray, idle: BoolArray) -> None:
        """Begin fresh searches, skip idle ones, step the others."""
        seen, steps = self._seen, self._steps
        if self._surroundings is None:
            step_full(
                self._searches.address, actions, fresh, idle, self._limit, steps,
                seen["vertex"], seen["time"], seen["action_mask"],
            )  # fmt: skip
        else:
            step_local(
                self._searches.address, self._surroundings, actions, fresh, idle, self._limit, steps,
                seen["local"], seen["action_mask"],
            )  # fmt: skip
        if self._searches.needs_python:
            raise_error()

    def _arrive(self, which: BoolArray) -> None:
        """Put the selected cars at the entries of their next worlds."""
        searches = self._searches
        arrive_all(searches.address, which)
        if not searches.needs_python:
            return
        for i in np.flatnonzero(which):
            searches.complete_arrival(int(i))

    def _observations(self) -> dict[str, NDArray[Any]]:
        return {name: a.copy() for name, a in self._seen.items()} if self._copy else dict(self._seen)

    def _final_observations(self, done: BoolArray) -> NDArray[np.object_]:
        final = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(done):
            final[i] = {name: a[i].copy() for name, a in self._seen.items()}
        return final

    def _metrics(self, done: BoolArray) -> dict[str, Any]:
        """Return the `info` of `SearchEnv`, with masks of the searches that have ended."""
        records = self._searches.records
        metrics: dict[str, Any] = {name: records[name].copy() for name in METRICS}
        metrics |= {
            "reward_terms": self.reward_terms | dict.fromkeys(_WHICH_TERMS, done),
            "place": self._names[self.place_of],
        }
        return metrics | dict.fromkeys(_WHICH, done)

    def _chosen(self, options: dict[str, Any] | None) -> BoolArray:
        """Return the mask of environments to reset."""
        rest = dict(options or {})
        mask = np.asarray(rest.pop("reset_mask", np.ones(self.num_envs, dtype=np.bool_)))
        if rest:
            raise InputError(f"reset takes no option but reset_mask, got {', '.join(rest)}")
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise InputError(
                f"reset_mask has shape {mask.shape} and type {mask.dtype}, want ({self.num_envs},) bool"
            )
        if not self._begun and not mask.all():
            raise InputError("reset_mask leaves out environments that have no episode yet")
        return mask


def _require_count(name: str, value: Any, most: int) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 1 <= value <= most:
        raise InputError(f"{name} is {value!r}, want a whole number from 1 to {most:,}")
