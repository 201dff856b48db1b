"""Record searches of an agent: what it observed, what it did with which probability, and what that cost."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.keyed_random import world_key
from parkenv.engine.local_observation import NEAR_SLOTS, FollowedSearch
from parkenv.engine.policy import CompiledPolicy
from parkenv.engine.policy_batch import PolicyBatch, explore, explore_at
from parkenv.engine.records import N_ACTIONS
from parkenv.engine.spaces import BELIEF_PARTS
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.errors import InputError
from parkenv.studies.agent_spec import AgentSpec
from parkenv.studies.simulate import STEP_LIMIT, Observer, Step, simulate
from parkenv.world.scenario import Scenario
from planners.agent import ClairvoyantAgent, make_agent
from planners.heuristics import POLICIES
from planners.names import HUMAN

RANDOM = "random"
SEEN, PROBABILITIES = "observations/", "infos/action_probabilities"
Arrays = Mapping[str, NDArray[Any]]


class RecordedSearch(NamedTuple):
    """A search of n steps.

    Attributes:
        seed: seed of its world.
        agent: label of the agent.
        parked: whether the car parked.
        arrays: by their paths in an episode of Minari: (n, ...) `actions`, `rewards`, `terminations`, `truncations`;
            (n + 1, ...) the observations, and with which probability each action was drawn there, (n + 1, 5) float64,
            zeros at the last one.
    """

    seed: int
    agent: str
    parked: bool
    arrays: Arrays


class SearchRecorder(Observer):
    """Lets an agent search, with random actions in between, and records its searches.

    An agent whose action was replaced begins its plan anew, from the belief that it has by then.

    Args:
        scenario: where it searches.
        spec: the agent; `random` draws every action.
        observation: what is recorded, as in `parkenv/Search-v2`: full, occupancy or local.
        epsilon: probability of a random action in a step, one of those in the mask.

    Raises:
        InputError: there is no such agent, or none whose actions can be replaced.
    """

    def __init__(self, scenario: Scenario, spec: AgentSpec, observation: str, epsilon: float) -> None:
        self._scenario, self._label, self._observation = scenario, spec.label, observation
        self._epsilon = 1.0 if spec.name == RANDOM else epsilon
        self._agent: Any = make_agent(spec.name, scenario, **spec.options)
        if getattr(self._agent, "scans_k", None) is not None or spec.name.startswith(f"{HUMAN}:"):
            raise InputError(f"policy is {spec.label!r}, want one that decides on beliefs, anywhere")
        self._policy: CompiledPolicy | None = None
        if spec.name in POLICIES:
            made = getattr(self._agent, "compiled_policy", None)
            self._policy = POLICIES[spec.name] if made is None else made()

    def searches(self, seeds: Sequence[int], *, compiled: bool = True) -> Iterator[RecordedSearch]:
        """Yield a search for each seed.

        Args:
            seeds: seeds of the worlds.
            compiled: whether compiled code drives the cars of a heuristic; the searches are the same.
        """
        if self._policy is not None and compiled:
            envs = ParkSearchVectorEnv(
                len(seeds), self._scenario, self._observation, max_episode_steps=STEP_LIMIT, copy=False
            )
            if not envs.observer.searches.needs_python:
                return self._in_batch(envs, seeds, self._policy)
        return map(self._search, seeds)

    # ---- compiled

    @cached_property
    def _waits(self) -> NDArray[np.int64]:
        return np.array([self._agent.wait(vertex) for vertex in range(self._scenario.lot.n_vertices)])

    def _in_batch(
        self, envs: ParkSearchVectorEnv, seeds: Sequence[int], policy: CompiledPolicy
    ) -> Iterator[RecordedSearch]:
        """Step all searches until the last one ends; what those that have ended do then is not recorded."""
        n = len(seeds)
        observations, _ = envs.reset(seed=list(seeds))
        cars, rows = PolicyBatch(envs.observer.searches, policy), np.arange(n)
        live, parked, actions, drawn = (
            np.ones(n, np.bool_),
            np.zeros(n),
            np.zeros(n, np.int64),
            np.zeros((n, 5)),
        )
        seen, done = [(rows, {SEEN + name: values.copy() for name, values in observations.items()})], []
        while len(rows):
            explore_at(
                cars.address, policy.address, live, observations["action_mask"], self._waits, self._epsilon,
                actions, drawn,
            )  # fmt: skip
            at = drawn[rows]
            observations, rewards, terminations, truncations, info = envs.step(actions)
            truncations &= ~terminations
            seen.append((rows, {SEEN + name: values[rows] for name, values in observations.items()}))
            step = {
                "actions": actions,
                "rewards": rewards,
                "terminations": terminations,
                "truncations": truncations,
            }
            done.append((rows, {name: values[rows] for name, values in step.items()} | {PROBABILITIES: at}))
            ended = live & (terminations | truncations)
            parked[ended] = info["parked"][ended] if ended.any() else 0
            live &= ~ended
            rows = np.flatnonzero(live)
        each = zip(seeds, parked, _by_search(n, seen), _by_search(n, done), strict=True)
        for seed, is_parked, before, after in each:
            yield self._recorded(seed, bool(is_parked), {**before, **after})

    def _recorded(self, seed: int, parked: bool, arrays: Arrays) -> RecordedSearch:
        infos = np.pad(arrays[PROBABILITIES], ((0, 1), (0, 0)))
        return RecordedSearch(seed, self._label, parked, {**arrays, PROBABILITIES: infos})

    # ---- in Python

    @cached_property
    def _env(self) -> gym.Env[Any, Any]:
        return gym.make("parkenv/Search-v2", disable_env_checker=True, scenario=self._scenario)

    @cached_property
    def _followed(self) -> tuple[FollowedSearch, FollowedSearch]:
        """What computes the local observations of the data set, and those of a trained model."""
        k = getattr(self._agent, "local_k", None) or NEAR_SLOTS
        return FollowedSearch([self._scenario], NEAR_SLOTS), FollowedSearch([self._scenario], k)

    def _search(self, seed: int) -> RecordedSearch:
        self._key = world_key(seed, 0)
        result = simulate(self._env, self, seed, (self,))
        names = ("actions", "rewards", "terminations", "truncations", PROBABILITIES)
        arrays = {
            name: np.array(values) for name, values in zip(names, zip(*self._done, strict=True), strict=True)
        }
        arrays |= {SEEN + name: np.stack([each[name] for each in self._seen]) for name in self._seen[0]}
        return self._recorded(seed, bool(result.info["parked"]), arrays)

    def on_reset(self, env: gym.Env[Any, Any], observation: Any) -> None:
        """Start a search."""
        if isinstance(self._agent, ClairvoyantAgent):
            state = env.unwrapped.state  # type: ignore[attr-defined]
            self._agent.prepare(state.world, state.time)
        self._done: list[tuple[Any, ...]] = []
        self._seen = [self._shown(observation)]

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[int, Any]:
        """Return the agent's action or a random one, and the agent's memory, None where it begins anew."""
        del episode_start, deterministic
        shown = observation
        if getattr(self._agent, "local_k", None) is not None:
            model = self._followed[1]
            shown = model.observe(observation) if self._done else model.begin(observation)
        planned, memory = self._agent.predict(shown, state)
        self._probabilities, masks = np.zeros(N_ACTIONS), observation["action_mask"]
        number, step = int(planned), len(self._done)
        action = explore(self._key, step, masks, number, self._epsilon, self._probabilities)
        return action, memory if action == number else None

    def on_step(self, step: Step) -> None:
        """Record a step."""
        truncated = step.truncated and not step.terminated
        self._done.append((step.action, step.reward, step.terminated, truncated, self._probabilities))
        self._seen.append(self._shown(step.next_observation))

    def _shown(self, observation: Any) -> Any:
        """Return what of an observation is recorded."""
        if self._observation == "local":
            local = self._followed[0]
            return local.observe(observation) if self._done else local.begin(observation)
        left_out = BELIEF_PARTS if self._observation == "occupancy" else ()
        return {name: value for name, value in observation.items() if name not in left_out}


def _by_search(n: int, parts: Sequence[tuple[NDArray[np.int64], Arrays]]) -> list[Arrays]:
    """Return the arrays of each of n searches, in the order of time; a part holds one row of some of them."""
    rows = np.concatenate([rows for rows, _ in parts])
    order, ends = np.argsort(rows, kind="stable"), np.cumsum(np.bincount(rows, minlength=n))[:-1]
    split = {
        name: np.split(np.concatenate([arrays[name] for _, arrays in parts])[order], ends)
        for name in parts[0][1]
    }
    return [{name: its[i] for name, its in split.items()} for i in range(n)]
