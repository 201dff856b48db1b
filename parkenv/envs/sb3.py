"""The compiled batch of searches, and the world of many cars, as stable-baselines3's `VecEnv`."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.memory import uint8s
from parkenv.engine.events import act_at, advance_at, release_at
from parkenv.engine.fleet import MAX_STEPS, DriverKind, Fleet
from parkenv.engine.kernel import step_cost_s
from parkenv.engine.local_observation import local_space
from parkenv.engine.network import Layer, NetworkPolicy, observe_locally
from parkenv.engine.records import (
    CAR,
    N_ACTIONS,
    NO_CAR,
    SEARCHING,
    TRUNCATED,
    car_at,
    fleet_at,
    scenario_at,
    search_at,
)
from parkenv.envs.search_vector import ParkSearchVectorEnv
from parkenv.errors import InputError
from parkenv.scenarios.build import ScenarioSource, ScenarioSources, make_scenario
from parkenv.world.cost_terms import METRICS
from parkenv.world.demand import Demand
from parkenv.world.lot import PARK
from parkenv.world.occupancy.kernel import kernel


class SharedVecEnv(VecEnv):  # type: ignore[misc]
    """A batch of environments as stable-baselines3's `VecEnv`.

    Attributes and methods belong to the whole batch. `info` reports returns and lengths of episodes as `Monitor` does,
    so no wrapper is needed.

    Attributes:
        actions: actions for the next `step_wait`.
    """

    actions: NDArray[Any]

    def __init__(
        self, num_envs: int, observation_space: spaces.Space[Any], action_space: spaces.Space[Any]
    ) -> None:
        super().__init__(num_envs, observation_space, action_space)
        self._returns, self._lengths = np.zeros(num_envs), np.zeros(num_envs, dtype=np.int64)

    def _start_all(self) -> None:
        """Start counting the episodes of all environments."""
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        self._returns[:], self._lengths[:] = 0.0, 0

    def _count(self, rewards: NDArray[np.floating]) -> None:
        """Add a step's rewards, (n_envs,), to the episode returns."""
        self._returns += rewards
        self._lengths += 1

    def _end_episodes(
        self,
        done: NDArray[np.bool_],
        truncated: NDArray[np.bool_],
        final: Callable[[int], tuple[dict[str, Any], dict[str, Any]]],
    ) -> list[dict[str, Any]]:
        """Return the step's `info` of all environments, and start counting new episodes where one has ended.

        Args:
            done: (n_envs,), whether the episode has ended.
            truncated: (n_envs,), whether a step limit ended it.
            final: function of an environment's index; returns the last observation and further entries of `info`.
        """
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(done).tolist():
            observation, metrics = final(i)
            infos[i] = {
                "terminal_observation": observation,
                "TimeLimit.truncated": bool(truncated[i]),
                "episode": {"r": float(self._returns[i]), "l": int(self._lengths[i])},
                **metrics,
            }
        self._returns[done], self._lengths[done] = 0.0, 0
        return infos

    def step_async(self, actions: NDArray[Any]) -> None:
        """Set the actions of the next `step_wait`."""
        self.actions = np.asarray(actions)

    def close(self) -> None:
        """Do nothing: there are no resources to release."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the batch for each environment; the render mode is None."""
        value = None if attr_name == "render_mode" else getattr(self, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Raise an error: environments of a batch have no attributes of their own.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(f"environments of a batch share everything; {attr_name} cannot be set")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the batch; returns its result for each environment."""
        value = getattr(self, method_name)(*method_args, **method_kwargs)
        return [value for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Return True for `Monitor`: the batch has its function built in."""
        from stable_baselines3.common.monitor import Monitor

        return [issubclass(wrapper_class, Monitor) for _ in self._get_indices(indices)]


class MaskedVecEnv(SharedVecEnv):
    """A batch whose environments have masks of their actions, for sb3-contrib."""

    @abstractmethod
    def action_masks(self) -> NDArray[np.bool_]:
        """Return the action masks, (n_envs, n_actions) bool."""

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Return a row of `action_masks` per environment, which sb3-contrib calls.

        Raises:
            NotImplementedError: for any other method.
        """
        if method_name != "action_masks" or method_args or method_kwargs:
            raise NotImplementedError(f"environments of a batch have no method {method_name} of their own")
        masks = self.action_masks()
        return [masks[i] for i in self._get_indices(indices)]


# ---- searches


class SearchVecEnv(MaskedVecEnv):
    """`ParkSearchVectorEnv` for stable-baselines3 and sb3-contrib.

    When a search ends, its `info` has `terminal_observation`, `TimeLimit.truncated`, `episode` (return in seconds and
    length, as from `Monitor`) and the metrics of `parkenv/Search-v2`. `action_masks` is available to sb3-contrib.

    Args:
        num_envs: number of searches.
        scenario: a scenario, its name, a file, a folder of files, or a sequence of these; if there are several, one is
            drawn for each episode, and `info["place"]` names it at the end.
        reward_scale: factor of the rewards in seconds; returns near one are easiest to learn.
        k: number of slots in the `local` observation, 5 if None; or of scans in `scan`, 4 if None.
        observation: `local`; for a single lot also `full`, or `scan`, as from
            `parkenv.envs.scan_observation.ScanObservation`.
        max_episode_steps: steps after which a search is truncated.

    Raises:
        InputError: an argument out of its range; the message names it.

    Examples:
        >>> venv = SearchVecEnv(4, "mini")
        >>> venv.seed(0)
        [0, 1, 2, 3]
        >>> venv.reset()["local"].shape
        (4, 86)
    """

    def __init__(
        self,
        num_envs: int,
        scenario: ScenarioSources = "campus",
        reward_scale: float = 1.0,
        k: int | None = None,
        observation: str = "local",
        max_episode_steps: int = 2000,
    ) -> None:
        if not (np.isfinite(reward_scale) and reward_scale > 0.0):
            raise InputError(f"reward_scale is {reward_scale}, want a number above 0")
        self.batch = ParkSearchVectorEnv(
            num_envs, scenario, observation, k, max_episode_steps, AutoresetMode.SAME_STEP
        )
        super().__init__(num_envs, self.batch.single_observation_space, self.batch.single_action_space)
        self.reward_scale = reward_scale
        self._masks: NDArray[np.int8] = np.zeros((num_envs, 0), dtype=np.int8)

    def reset(self) -> dict[str, NDArray[Any]]:
        """Start all searches, in the worlds of `seed` or in the next ones."""
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds
        observations, _ = self.batch.reset(seed=seeds)
        self._reset_seeds()
        self._reset_options()
        self._start_all()
        self._masks = observations["action_mask"]
        return observations

    def step_wait(
        self,
    ) -> tuple[dict[str, NDArray[Any]], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all searches; see the class for `info`."""
        observations, rewards, terminated, truncated, info = self.batch.step(self.actions)
        self._masks = observations["action_mask"]
        self._count(rewards)
        done = terminated | truncated

        def final(i: int) -> tuple[dict[str, Any], dict[str, Any]]:
            metrics = info["final_info"]
            return info["final_obs"][i], {name: metrics[name][i].item() for name in (*METRICS, "place")}

        infos = self._end_episodes(done, truncated & ~terminated, final)
        return observations, (rewards * self.reward_scale).astype(np.float32), done, infos

    def get_state(self) -> dict[str, Any]:
        """Return a copy of the running searches as plain arrays, for `set_state`."""
        return {
            "searches": [a.view(np.uint8) if a.dtype.names else a for a in self.batch.get_state()],
            "masks": self._masks,
            "returns": self._returns,
            "lengths": self._lengths,
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a state that `get_state` returned for the same scenarios."""
        self.reset()
        self.batch.set_state(state["searches"])
        self._masks, self._returns, self._lengths = state["masks"], state["returns"], state["lengths"]

    def action_masks(self) -> NDArray[np.bool_]:
        """Return the action masks, (n_envs, 5) bool."""
        return self._masks.astype(np.bool_)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the adapter, else of the batch, for each environment."""
        if attr_name == "render_mode" or hasattr(self, attr_name):
            return super().get_attr(attr_name, indices)
        value = getattr(self.batch, attr_name)
        return [value for _ in self._get_indices(indices)]


# ---- many cars

LEARNERS = 0
"""The kind of drivers that learn."""
_DECIDED, _UNDER_WAY, _OVER, _OBSERVED = range(4)
"""Stages of a world during a step: its car has decided, is under way, has ended its search, or has observed."""
_CAR_BYTES = CAR.itemsize


class FleetVecEnv(MaskedVecEnv):
    """Worlds of many cars for stable-baselines3 and sb3-contrib, in which one network drives all cars that learn.

    An environment of the batch is a world: `parkenv.engine.fleet.Fleet`, day after day. Its decisions are those of one
    car, from its arrival to the end of its search, then those of the next car to arrive. The other learning cars of the
    world are driven by the same network in compiled code, and draw their actions as the learning car does. So decisions
    are in their true order in continuous time, an episode is the search of one car, and algorithms need no change.
    `ShareNetwork` is a callback that hands the current weights to the other cars before each rollout; until then, they
    choose among the possible actions alike.

    Rewards are minus seconds times `reward_scale`. An episode is terminated when the car parks, gives up or balks, and
    truncated after `max_steps` decisions. Its last `info` is as that of `SearchVecEnv`.

    At `reset`, worlds begin at a car in the middle of a day, drawn from the seed, so that the batch holds all times of
    the day at once; the network drives the cars before it, too. Later days begin with their first car.

    Args:
        num_envs: number of worlds.
        scenario: a scenario, as of `parkenv.make_scenario`.
        demand: when cars arrive, how long they stay and search.
        drivers: the kinds of drivers; the first one learns, and has no policy; the others have compiled ones.
        reward_scale: factor of the rewards in seconds.
        k: number of slots in the `local` observation.
        max_steps: limit of a car's decisions.
        options: further options of `Fleet`: `background`, `delay_s`, `leave_full_lot`, `manoeuvre_s`, ...

    Attributes:
        network: the compiled driver of the other learning cars.
        fleets: the worlds.

    Raises:
        InputError: an argument out of its range; the message names it.

    Examples:
        >>> from parkenv.world.demand import Demand, PoissonArrivals
        >>> venv = FleetVecEnv(4, "mini", Demand(PoissonArrivals(30, 8 * 3600, 9 * 3600)))
        >>> venv.seed(0)
        [0, 1, 2, 3]
        >>> venv.reset()["local"].shape
        (4, 86)
    """

    def __init__(
        self,
        num_envs: int,
        scenario: ScenarioSource,
        demand: Demand,
        drivers: Sequence[DriverKind] = (DriverKind(),),
        reward_scale: float = 1.0,
        k: int = 5,
        max_steps: int = MAX_STEPS,
        **options: Any,
    ) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, (int, np.integer)) or num_envs < 1:
            raise InputError(f"num_envs is {num_envs!r}, want a whole number of at least 1")
        if not (np.isfinite(reward_scale) and reward_scale > 0.0):
            raise InputError(f"reward_scale is {reward_scale}, want a number above 0")
        kinds = tuple(drivers)
        if not kinds or kinds[LEARNERS].policy is not None or not kinds[LEARNERS].weight > 0.0:
            raise InputError("drivers[0] has a policy, or weight 0; want the kind that learns")
        for i, kind in enumerate(kinds[1:], 1):
            if kind.policy is None:
                raise InputError(
                    f"drivers[{i}] has no policy, want a compiled one beside the cars that learn"
                )
        space = local_space(k)
        super().__init__(num_envs, space, spaces.Discrete(N_ACTIONS))
        shape = space["local"].shape
        assert shape is not None
        uniform = np.zeros((N_ACTIONS, N_ACTIONS + shape[0]), np.float32), np.zeros(N_ACTIONS, np.float32)
        self.network = NetworkPolicy([uniform], k, sampled=True)
        its = make_scenario(scenario)
        kinds = (replace(kinds[LEARNERS], policy=self.network), *kinds[1:])
        self.fleets = [
            Fleet(its, demand, drivers=kinds, max_steps=max_steps, **options) for _ in range(num_envs)
        ]
        self.reward_scale = reward_scale
        self._policy: Any = None
        n = num_envs
        self._world_seeds, self._days = np.zeros(n, np.int64), np.full(n, -1, np.int64)
        self._addresses = np.array([fleet.address for fleet in self.fleets], np.int64)
        self._stages, self._status = np.full(n, _OVER), np.zeros(n, np.int64)
        self._cars, self._first = np.full(n, NO_CAR, np.int64), np.zeros(n, np.int64)
        self._ended = np.zeros(n, CAR)
        self._rewards, self._done = np.zeros(n), np.zeros(n, np.bool_)
        self._local, self._masks = (
            np.zeros((2, n, shape[0]), np.float32),
            np.zeros((2, n, N_ACTIONS), np.int8),
        )

    def follow(self, policy: Any) -> None:
        """Let the other learning cars drive by a policy of stable-baselines3 or sb3-contrib.

        Its current weights are copied now, and whenever worlds begin by `reset` or `set_state`.

        Raises:
            InputError: a policy that is no multilayer perceptron on the `local` observation.
        """
        self._policy = policy
        layers, activation, masked = layers_of(policy)
        self.network.set_layers(layers, activation=activation, masked=masked)

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Set the seeds of the worlds from the next `reset` on: `seed`, and one more for each environment."""
        seeds = list(super().seed(seed))
        self._world_seeds[:], self._days[:] = seeds, -1
        return seeds

    def reset(self) -> dict[str, NDArray[Any]]:
        """Begin the next day of every world, in its middle."""
        if (self._days < 0).all() and not self._world_seeds.any() and self._seeds[0] is None:
            self.seed(int(np.random.SeedSequence().generate_state(1)[0]))
        self._reset_seeds()
        self._reset_options()
        self._days += 1
        return self._begin_days()

    def _begin_days(self) -> dict[str, NDArray[Any]]:
        if self._policy is not None:
            self.follow(self._policy)
        for i in range(self.num_envs):
            self._begin_day(i)
            draws = np.random.default_rng([self._world_seeds[i], self._days[i]])
            learning = np.flatnonzero(self.fleets[i].cars["kind"] == LEARNERS)
            self._first[i] = learning[draws.integers(len(learning))] if len(learning) else 0
        self._start_all()
        self._advance(np.zeros(self.num_envs, np.int64))
        return self._observations()

    def _begin_day(self, i: int) -> None:
        self.fleets[i].reset(int(self._world_seeds[i]), int(self._days[i]))
        self._stages[i], self._first[i] = _OVER, 0

    def step_wait(
        self,
    ) -> tuple[dict[str, NDArray[Any]], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Carry out the cars' decisions; see the class for `info`."""
        actions = self.actions.astype(np.int64).reshape(self.num_envs)
        if ((actions < 0) | (actions > PARK)).any():
            raise InputError(f"actions are {actions}, want numbers from 0 to {PARK}")
        self._stages[:] = _DECIDED
        self._advance(actions)
        self._count(self._rewards)
        done = self._done.copy()
        infos = self._end_episodes(done, done & (self._ended["state"] == TRUNCATED), self._end_of)
        return self._observations(), (self._rewards * self.reward_scale).astype(np.float32), done, infos

    def _advance(self, actions: IntArray) -> None:
        """Run every world until its car observes."""
        self._done[:] = False
        while True:
            advance_worlds(
                self._addresses, actions, self._stages, self._status, self._cars, self._first, self._rewards,
                self._done, self._local, self._masks, self._ended.view(np.uint8).reshape(self.num_envs, _CAR_BYTES),
            )  # fmt: skip
            waiting = np.flatnonzero(self._stages != _OBSERVED).tolist()
            if not waiting:
                return
            for i in waiting:
                if self._stages[i] == _OVER:
                    self._days[i] += 1
                    self._begin_day(i)
                else:
                    self.fleets[i].help(int(self._status[i]))

    def _observations(self) -> dict[str, NDArray[Any]]:
        return {"action_mask": self._masks[0].copy(), "local": self._local[0].copy()}

    def _end_of(self, i: int) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the last observation, and the metrics, of the car whose search has ended."""
        car = self._ended[i : i + 1]
        metrics = {name: car[name].item() for name in METRICS if name != "parked"}
        metrics["parked"] = bool(car["slot"][0] != NO_CAR)
        return {"action_mask": self._masks[1, i].copy(), "local": self._local[1, i].copy()}, metrics

    def get_state(self) -> dict[str, Any]:
        """Return the seeds and days of the worlds, for `set_state`, if they have just begun by `reset`."""
        return {"seeds": self._world_seeds.copy(), "days": self._days.copy()}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Begin the days that a state from `get_state` names; the others follow the policy as it is now."""
        self._world_seeds[:], self._days[:] = state["seeds"], state["days"]
        self._begin_days()

    def action_masks(self) -> BoolArray:
        """Return the action masks, (n_envs, 5) bool."""
        masks: BoolArray = self._masks[0].astype(np.bool_)
        return masks


class ShareNetwork(BaseCallback):  # type: ignore[misc]
    """Callback for `learn`: before each rollout, hand the weights of the policy to the other cars of `FleetVecEnv`."""

    def _on_rollout_start(self) -> None:
        self.training_env.follow(self.model.policy)

    def _on_step(self) -> bool:
        return True


def network_policy(policy: Any, k: int, *, sampled: bool = False, name: str = "network") -> NetworkPolicy:
    """Return a policy of stable-baselines3 or sb3-contrib as a compiled driver of a fleet.

    Args:
        policy: of PPO, MaskablePPO or DQN on the `local` observation.
        k: number of slots in the observation.
        sampled: whether to draw actions from the policy, instead of taking the most probable one.
        name: for tables.

    Raises:
        InputError: a policy that is no multilayer perceptron.
    """
    layers, activation, masked = layers_of(policy)
    return NetworkPolicy(layers, k, activation=activation, masked=masked, sampled=sampled, name=name)


def layers_of(policy: Any) -> tuple[list[Layer], str, bool]:
    """Return the layers of a policy network, their activation, and whether actions are masked.

    Raises:
        InputError: a policy that is no multilayer perceptron with one of the activations of `NetworkPolicy`.
    """
    from torch import nn

    if hasattr(policy, "q_net"):
        parts = list(policy.q_net.q_net)
    elif hasattr(policy, "mlp_extractor") and not hasattr(policy, "lstm_actor"):
        parts = [*policy.mlp_extractor.policy_net, policy.action_net]
    else:
        parts = []
    linear = [part for part in parts if isinstance(part, nn.Linear)]
    others = {type(part).__name__.lower() for part in parts if not isinstance(part, nn.Linear)}
    if not linear or len(others) > 1 or not others <= {"tanh", "relu"}:
        raise InputError(
            f"policy is a {type(policy).__name__} with {', '.join(sorted(others)) or 'no layers'}, want a multilayer "
            "perceptron of PPO, MaskablePPO or DQN with tanh or relu"
        )
    layers = [(part.weight.detach().cpu().numpy(), part.bias.detach().cpu().numpy()) for part in linear]
    return layers, others.pop() if others else "tanh", type(policy).__name__.startswith("Maskable")


@kernel
def advance_worlds(
    fleets: IntArray,
    actions: IntArray,
    stages: IntArray,
    status: IntArray,
    cars: IntArray,
    first: IntArray,
    rewards: FloatArray,
    done: BoolArray,
    local: NDArray[np.float32],
    masks: NDArray[np.int8],
    ended: NDArray[np.uint8],
) -> None:
    """Run each world until its learning car observes, or Python must help: then its stage is not `_OBSERVED`.

    Args:
        fleets: (n,) addresses of FLEET records.
        actions: (n,) decisions, of the worlds in the stage `_DECIDED`.
        stages: (n,) stages, updated.
        status: (n,) last results of `advance_at`.
        cars: (n,) the learning car of each world.
        first: (n,) first car of each world that may be one.
        rewards: (n,) float64, minus the time of the last step, s.
        done: (n,) whether a search has ended in this step.
        local: (2, n, width) observations: now, and at the end of a search that has ended.
        masks: (2, n, 5) action masks likewise.
        ended: (n, bytes of a CAR) the car whose search has ended.
    """
    for e in range(len(fleets)):
        if stages[e] == _OBSERVED:
            continue
        fleet = fleet_at(fleets[e], 0)
        if stages[e] == _DECIDED:
            act_at(fleets[e], actions[e])
            stages[e] = _UNDER_WAY
        while True:
            if stages[e] == _OVER:
                cars[e] = _next_learner(fleet, first[e])
                if cars[e] == NO_CAR:
                    break
                stages[e] = _UNDER_WAY
            status[e] = advance_at(fleets[e], np.inf)
            if status[e] < 0:
                break
            car = car_at(fleet.cars, cars[e])
            search = search_at(car.search, 0)
            over = car.state != SEARCHING
            observe_locally(fleets[e], cars[e], local[int(over), e])
            _write_mask(search, masks[int(over), e])
            if search.n_steps > 0:
                rewards[e] = -step_cost_s(search)
            if not over:
                stages[e] = _OBSERVED
                break
            done[e] = True
            record = uint8s(fleet.cars + cars[e] * _CAR_BYTES)
            for i in range(_CAR_BYTES):
                ended[e, i] = record[i]
            release_at(fleets[e])
            stages[e] = _OVER


@kernel
def _next_learner(fleet: Any, first: int) -> int:
    """Return the next car to arrive of those that learn, not before `first`; `NO_CAR` if none is left."""
    for number in range(max(fleet.next_car, first), fleet.n_cars):
        car = car_at(fleet.cars, number)
        if car.kind == LEARNERS:
            car.policy = 0
            return int(number)
    return NO_CAR


@kernel
def _write_mask(search: Any, mask: NDArray[np.int8]) -> None:
    masks = uint8s(scenario_at(search.scenario, 0).action_masks)
    for action in range(N_ACTIONS):
        mask[action] = masks[search.vertex * N_ACTIONS + action]
