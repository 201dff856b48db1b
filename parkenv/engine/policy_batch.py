"""A compiled policy that drives a car in each of many searches, and exploration around what a policy plans."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from parkenv.compiled.arrays import BoolArray, FloatArray, IntArray
from parkenv.compiled.keyed_random import EXPLORATION_STREAM, keyed_uniform
from parkenv.compiled.memory import address_of, call_at
from parkenv.engine.policy import CompiledPolicy, car_of, search_of
from parkenv.engine.records import CAR, FLEET, N_ACTIONS, NO_SLOT, SEARCH, Searches
from parkenv.world.occupancy.kernel import kernel


class PolicyBatch:
    """A car for each of some searches in one scenario, with its memory of the search.

    Args:
        searches: the searches; their `moves` are the cars' from now on.
        policy: what drives the cars.

    Attributes:
        address: address of the FLEET record of the cars.
    """

    def __init__(self, searches: Searches, policy: CompiledPolicy) -> None:
        n, problem = len(searches.records), searches.scenarios.scenarios[0]
        self._cars, self._fleet = np.zeros(n, CAR), np.zeros(1, FLEET)
        self._moves = np.zeros((n, 2 * problem.lot.n_vertices), np.uint8)
        searches.records["moves"] = address_of(self._moves, np.uint8) + np.arange(n) * self._moves.shape[1]
        self._cars["search"] = searches.address + np.arange(n) * SEARCH.itemsize
        self._cars["target"] = NO_SLOT
        self._data = policy.data_for([problem])
        self._at = np.array([0 if self._data is None else self._data.address], np.int64)
        self._fleet["cars"] = address_of(self._cars, CAR)
        self._fleet["policy_data"] = address_of(self._at, np.int64)
        self.address = address_of(self._fleet, FLEET)


@kernel
def explore(
    key: np.uint64,
    step: int,
    masks: NDArray[np.int8],
    planned: int,
    epsilon: float,
    probabilities: FloatArray,
) -> int:
    """Return the planned action, or with probability `epsilon` one that is possible, all with equal probability.

    Args:
        key: key of the world; with the number of the step it determines the draw.
        step: number of the step.
        masks: (5,) int8, the actions that are possible, at least one.
        planned: the planned action.
        epsilon: probability of a random action.
        probabilities: (5,) float64, written: the probability of each action.
    """
    n_possible = 0
    for action in range(N_ACTIONS):
        n_possible += masks[action]
    for action in range(N_ACTIONS):
        probabilities[action] = epsilon * masks[action] / n_possible
    probabilities[planned] += 1.0 - epsilon
    u = keyed_uniform(key, EXPLORATION_STREAM, 0, step)
    if u >= epsilon:
        return planned
    left, drawn = int(u / epsilon * n_possible), planned
    for action in range(N_ACTIONS):
        if masks[action]:
            drawn = action
            if left == 0:
                break
            left -= 1
    return drawn


@kernel
def explore_at(
    fleet: int,
    policy: int,
    which: BoolArray,
    masks: NDArray[np.int8],
    waits: IntArray,
    epsilon: float,
    actions: IntArray,
    probabilities: FloatArray,
) -> None:
    """Write what some cars of a `PolicyBatch` do, and with which probability each action is drawn; see `explore`.

    A car that does something else than planned begins its plan anew. One that would give up does what `waits`,
    (n_vertices,), says, as an agent in `parkenv/Search-v2`.
    """
    for e in range(len(actions)):
        if not which[e]:
            continue
        car = car_of(fleet, e)
        search = search_of(car.search)
        planned = call_at(policy, fleet, e)
        if not 0 <= planned < N_ACTIONS:
            planned = waits[search.vertex]
        actions[e] = explore(search.key, search.n_steps, masks[e], planned, epsilon, probabilities[e])
        if actions[e] != planned:
            car.target, car.n_moves = NO_SLOT, 0
