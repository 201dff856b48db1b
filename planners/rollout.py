"""`rollout`: looks ahead in worlds drawn from its belief, in which another agent goes on after the first action.

It is what a planner on `parkenv.model` looks like: it asks the model alone.
"""

import math
import time
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from parkenv.belief.slot_belief import SlotBelief
from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.engine.model import Belief, Model
from parkenv.errors import require_number, require_one_of, require_whole
from parkenv.world.lot import PARK
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation, SearchAgent
from planners.heuristics.policies import POLICIES

_BATCH = 32  # worlds between two looks at the clock
_SURE = 2.0  # standard errors by which an action must be better than that of the base
_SURELY_TAKEN = 0.999  # P(taken) from which on an attempt to park is left out


@dataclass
class ModelSearch:
    """Memory of an episode: the belief, the last action, and the random numbers of its worlds."""

    belief: Belief
    rng: np.random.Generator
    action: int | None = None


class ModelAgent(SearchAgent[ModelSearch]):
    """Base class of planners on `parkenv.model`: it keeps the belief up to date, a subclass chooses by it.

    Args:
        problem: the problem.
        seed: of the worlds that are drawn; they also depend on the time and the place of arrival.
        any_day: see `parkenv.engine.model.Model`.
    """

    def __init__(self, problem: SearchProblem, seed: int = 0, any_day: bool = False) -> None:
        super().__init__(problem)
        self.seed, self.model = seed, Model(self.problem, any_day)

    def begin(self, observation: Observation, belief: SlotBelief) -> ModelSearch:
        """Start with the forecast, and random numbers that depend on the seed and the time of arrival alone."""
        moment = int(np.float32(observation["time"][0]).view(np.uint32))
        rng = np.random.default_rng([self.seed, moment, int(observation["vertex"])])
        return ModelSearch(self.model.initial_belief(observation), rng)

    def decide(self, observation: Observation, belief: SlotBelief, memory: ModelSearch) -> int:
        before, action = memory.belief, memory.action
        if action is not None:
            # Among many cars one may have to wait, and then stands where its action did not lead.
            if self.problem.edges["target"][before.vertex, action] == observation["vertex"]:
                memory.belief = self.model.update(before, action, observation)
            else:
                memory.belief = self.model.initial_belief(observation)
        here = int(observation["vertex"])
        actions = np.flatnonzero(observation["action_mask"])
        if here < self.problem.lot.n_slots and memory.belief.slots.p_occupied[here] > _SURELY_TAKEN:
            actions = actions[actions != PARK]
        memory.action = self.choose(actions, memory) if len(actions) else self.wait(here)
        return memory.action

    @abstractmethod
    def choose(self, actions: IntArray, memory: ModelSearch) -> int:
        """Return one of the actions, (n,) int64; of `memory`, `action` is the one before."""


class RolloutAgent(ModelAgent):
    """`rollout`: takes the first action that costs least on average, if its base drives on from there.

    All actions are tried in the same worlds, drawn from the belief; after each of several rounds, the worse half of
    them is dropped (sequential halving, Karnin et al. 2013). What the base would do itself is kept unless another
    action is better by two standard errors. The same seed gives the same actions, unless time is limited.

    Args:
        problem: the problem.
        simulations: number of simulated searches for a decision.
        budget_ms: time for a decision, ms, instead of their number.
        base: a heuristic, one of `planners.heuristics.policies`, which drives on to the end of the search.
        seed: of the worlds.
        any_day: whether the worlds may be of days unlike their forecast, see `parkenv.engine.model.Model`.
    """

    name: ClassVar[str] = "rollout"

    def __init__(
        self,
        problem: SearchProblem,
        simulations: int = 256,
        budget_ms: float | None = None,
        base: str = "greedy-total",
        seed: int = 0,
        any_day: bool = False,
    ) -> None:
        super().__init__(problem, seed, any_day)
        require_whole("simulations", simulations, least=1)
        require_one_of("base", base, POLICIES)
        if budget_ms is not None:
            require_number("budget_ms", budget_ms, above=0.0)
        self.simulations, self.budget_ms = simulations, budget_ms
        self._base = POLICIES[base]

    def choose(self, actions: IntArray, memory: ModelSearch) -> int:
        base = int(self.model.sample(memory.belief, memory.rng).choose(self._base)[0])
        if base >= 0:  # else it gives up
            actions = np.union1d(actions, base)  # it may wait
        rounds = max(math.ceil(math.log2(len(actions))), 1)
        cost_s = np.empty((len(actions), 0))  # by action and world
        for _ in range(rounds):
            for n in self._batches(len(actions), rounds):
                cost_s = np.hstack([cost_s, self._costs_s(actions, memory, n)])
            better = np.argsort(cost_s.mean(axis=1), kind="stable")[: (len(actions) + 1) // 2]
            left = np.union1d(better, np.flatnonzero(actions == base))
            actions, cost_s = actions[left], cost_s[left]
        best = int(cost_s.mean(axis=1).argmin())
        for saved_s in cost_s[actions == base] - cost_s[best]:
            # Chance would let it drive to and fro.
            if saved_s.mean() <= _SURE * saved_s.std() / math.sqrt(saved_s.size):
                return base
        return int(actions[best])

    def _batches(self, n_actions: int, rounds: int) -> Iterator[int]:
        """Yield numbers of worlds until a round has used its share of the simulations, or of the time."""
        if self.budget_ms is None:
            yield max(self.simulations // (rounds * n_actions), 1)
            return
        end = time.perf_counter() + self.budget_ms / 1e3 / rounds
        yield _BATCH
        while time.perf_counter() < end:
            yield _BATCH

    def _costs_s(self, actions: IntArray, memory: ModelSearch, n: int) -> FloatArray:
        """Return the cost of each action in n worlds, the same for all actions, (n_actions, n) s."""
        worlds = self.model.sample(memory.belief, memory.rng, n, copies=len(actions))
        first_s = worlds.step(np.repeat(actions, n))[0]
        return np.asarray(first_s + worlds.run(self._base)).reshape(len(actions), n)
