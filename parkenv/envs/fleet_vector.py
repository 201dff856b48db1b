"""A batch of worlds of many cars, in each of which one car at a time is decided for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.memory import uint8s
from parkenv.engine.events import act_at, advance_at, release_at
from parkenv.engine.fleet import MAX_STEPS, DriverKind, Fleet
from parkenv.engine.kernel import step_cost_s
from parkenv.engine.local_observation import local_space
from parkenv.engine.network import Layer, NetworkPolicy, observe_locally
from parkenv.engine.policy import is_allowed
from parkenv.engine.records import (
    CAR,
    N_ACTIONS,
    NO_CAR,
    SEARCHING,
    TRUNCATED,
    car_at,
    fleet_at,
    search_at,
)
from parkenv.errors import InputError, reset_options
from parkenv.scenarios.build import ScenarioSource, make_scenario
from parkenv.world.cost_terms import METRICS
from parkenv.world.demand import Demand, TownDemand
from parkenv.world.lot import PARK
from parkenv.world.occupancy.kernel import kernel

LEARNERS = 0
"""The kind of drivers that learn."""
_DECIDED, _UNDER_WAY, _OVER, _OBSERVED = range(4)
"""Stages of a world during a step: its car has decided, is under way, has ended its search, or has observed."""
_CAR_BYTES = CAR.itemsize


class FleetVectorEnv(VectorEnv[dict[str, NDArray[Any]], IntArray, NDArray[Any]]):
    """Worlds of many cars as a batch of searches, in which one network drives all cars that learn.

    An environment of the batch is a world: `parkenv.engine.fleet.Fleet`, day after day. Its decisions are those of one
    car, from its arrival to the end of its search, then those of the next car to arrive. The other learning cars of the
    world are driven by the same network in compiled code (`follow`), and draw their actions, too. So decisions are in
    their true order in continuous time, an episode is the search of one car, and algorithms need no change.

    Observations and actions are those of `parkenv.envs.search_vector.ParkSearchVectorEnv` with `observation="local"`,
    rewards minus seconds. An episode is terminated when the car parks, gives up or balks, and truncated after
    `max_steps` decisions. The next one begins in the same step; `info["final_obs"]` and `info["final_info"]` hold the
    last observations and the metrics.

    `reset(seed=s)` gives world i the seed s + i, a sequence gives one to each. Worlds then begin at a car in the middle
    of a day, drawn from the seed, so that the batch holds all times of the day at once; `network` drives the cars
    before it, too. Later days begin with their first car; without a seed, `reset` begins the next day.

    Args:
        num_envs: number of worlds.
        scenario: a scenario, see `parkenv.make_scenario`.
        demand: when cars arrive, how long they stay and search.
        drivers: the kinds of drivers; the first one learns, and has no policy; the others have compiled ones.
        k: number of slots in the `local` observation.
        max_steps: limit of a car's decisions.
        options: further options of `Fleet`: `background`, `delay_s`, `leave_full_lot`, `manoeuvre_s`, ...

    Attributes:
        network: the compiled driver of the other learning cars; before `follow`, it chooses uniformly among all
            actions.
        fleets: the worlds.

    Raises:
        InputError: an argument out of its range; the message names it.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium declares it so
        "render_modes": [],
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: int,
        scenario: ScenarioSource,
        demand: Demand | TownDemand,
        drivers: Sequence[DriverKind] = (DriverKind(),),
        k: int = 5,
        max_steps: int = MAX_STEPS,
        **options: Any,
    ) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, (int, np.integer)) or num_envs < 1:
            raise InputError(f"num_envs is {num_envs!r}, want a whole number of at least 1")
        kinds = tuple(drivers)
        if not kinds or kinds[LEARNERS].policy is not None or not kinds[LEARNERS].weight > 0.0:
            raise InputError("drivers[0] has a policy, or weight 0; want the kind that learns")
        for i, kind in enumerate(kinds[1:], 1):
            if kind.policy is None:
                raise InputError(
                    f"drivers[{i}] has no policy, want a compiled one beside the cars that learn"
                )
        self.num_envs = n = int(num_envs)
        self.single_observation_space = space = local_space(k)
        self.single_action_space = spaces.Discrete(N_ACTIONS)
        self.observation_space, self.action_space = (
            batch_space(one, n) for one in (space, self.single_action_space)
        )
        shape = space["local"].shape
        assert shape is not None
        uniform = np.zeros((N_ACTIONS, N_ACTIONS + shape[0]), np.float32), np.zeros(N_ACTIONS, np.float32)
        self.network = NetworkPolicy([uniform], k, sampled=True)
        its = make_scenario(scenario)
        kinds = (replace(kinds[LEARNERS], policy=self.network), *kinds[1:])
        self.fleets = [Fleet(its, demand, drivers=kinds, max_steps=max_steps, **options) for _ in range(n)]
        self._policy: Any = None
        self._seeds, self._days = np.zeros(n, np.int64), np.full(n, -1, np.int64)
        self._addresses = np.array([fleet.address for fleet in self.fleets], np.int64)
        self._stages, self._status = np.full(n, _OVER), np.zeros(n, np.int64)
        self._cars, self._first = np.full(n, NO_CAR, np.int64), np.zeros(n, np.int64)
        self._ended = np.zeros(n, CAR)
        self._rewards, self._done = np.zeros(n), np.zeros(n, np.bool_)
        # Now, and at the end of a search that has ended.
        self._local = np.zeros((2, n, shape[0]), np.float32)
        self._masks = np.zeros((2, n, N_ACTIONS), np.int8)

    def follow(self, policy: Any) -> None:
        """Let the other learning cars drive by a policy of stable-baselines3 or sb3-contrib.

        Its current weights are copied now, and whenever worlds begin by `reset` or `set_state`.

        Raises:
            InputError: a policy that is no multilayer perceptron on the `local` observation.
        """
        self._policy = policy
        layers, activation, masked = layers_of(policy)
        self.network.set_layers(layers, activation=activation, masked=masked)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Begin a day of every world, in its middle; see the class. There are no options."""
        reset_options(options, ())
        if seed is None or isinstance(seed, (int, np.integer)):
            super().reset(seed=None if seed is None else int(seed))
        if seed is None and (self._days < 0).all():
            seed = int(self.np_random.integers(1 << 31))
        if isinstance(seed, (int, np.integer)):
            seed = [int(seed) + i for i in range(self.num_envs)]
        if seed is not None:
            self._seeds[:], self._days[:] = np.array(seed, np.int64), -1
        self._days += 1
        return self._begin_days(), {}

    def _begin_days(self) -> dict[str, NDArray[Any]]:
        if self._policy is not None:
            self.follow(self._policy)
        for i in range(self.num_envs):
            self._begin_day(i)
            draws = np.random.default_rng([self._seeds[i], self._days[i]])
            learning = np.flatnonzero(self.fleets[i].cars["kind"] == LEARNERS)
            self._first[i] = learning[draws.integers(len(learning))] if len(learning) else 0
        self._advance(np.zeros(self.num_envs, np.int64))
        return self._observations()

    def _begin_day(self, i: int) -> None:
        self.fleets[i].reset(int(self._seeds[i]), int(self._days[i]))
        self._stages[i], self._first[i] = _OVER, 0

    def step(
        self, actions: IntArray
    ) -> tuple[dict[str, NDArray[Any]], FloatArray, BoolArray, BoolArray, dict[str, Any]]:
        """Carry out the cars' decisions, (n_envs,) int; see the class."""
        actions = np.asarray(actions).astype(np.int64).reshape(self.num_envs)
        if ((actions < 0) | (actions > PARK)).any():
            raise InputError(f"actions are {actions}, want numbers from 0 to {PARK}")
        self._stages[:] = _DECIDED
        self._advance(actions)
        done, truncated = self._done.copy(), self._done & (self._ended["state"] == TRUNCATED)
        info: dict[str, Any] = {}
        if done.any():
            metrics: dict[str, Any] = {name: self._ended[name].copy() for name in METRICS if name != "parked"}
            metrics["parked"] = self._ended["slot"] != NO_CAR
            final = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(done):
                final[i] = {"action_mask": self._masks[1, i].copy(), "local": self._local[1, i].copy()}
            info = {"final_info": metrics | {f"_{name}": done for name in metrics}, "final_obs": final}
            info |= {"_final_info": done, "_final_obs": done}
        return self._observations(), self._rewards.copy(), done & ~truncated, truncated, info

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

    def get_state(self) -> tuple[IntArray, IntArray]:
        """Return the seeds and days of the worlds, for `set_state`, if they have just begun by `reset`."""
        return self._seeds.copy(), self._days.copy()

    def set_state(self, state: Sequence[IntArray]) -> None:
        """Begin the days that a state from `get_state` names; the others follow the network as it is now."""
        self._seeds[:], self._days[:] = state
        self._begin_days()


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
    for action in range(N_ACTIONS):
        mask[action] = is_allowed(search, action)
