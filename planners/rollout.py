"""`rollout`: looks ahead in worlds drawn from its belief, in which another agent goes on after the first action.

It is what a planner on `parkenv.model` looks like: it asks the model alone. The agent that goes on is a compiled
heuristic or `belief`; then this is a planner in closed loop, which values what `belief` would do after each observation
that an action may lead to.
"""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from parkenv.belief.slot_belief import SlotBelief
from parkenv.compiled.arrays import FloatArray, IntArray
from parkenv.engine.model import MAX_STEPS, Belief, Model, Simulations
from parkenv.engine.policy import CompiledPolicy
from parkenv.errors import require_number, require_one_of, require_whole
from parkenv.world.lot import PARK
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation, SearchAgent
from planners.belief.agent import BeliefAgent, BeliefSearch
from planners.heuristics.policies import POLICIES

_BATCH = 32  # worlds between two looks at the clock
_SURE = 2.0  # standard errors by which an action must be better than that of the base
_SURELY_TAKEN = 0.999  # P(taken) from which on an attempt to park is left out
BELIEF = "belief"  # the base that is no heuristic


@dataclass
class ModelSearch:
    """Memory of an episode: the belief, the last action, and the random numbers of its worlds."""

    belief: Belief
    rng: np.random.Generator
    action: int | None = None
    base: BeliefSearch | None = None  # memory of `belief`, where that is the base


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
        del belief
        moment = int(np.float32(observation["time"][0]).view(np.uint32))
        rng = np.random.default_rng([self.seed, moment, int(observation["vertex"])])
        return ModelSearch(self.model.initial_belief(observation), rng)

    def decide(self, observation: Observation, belief: SlotBelief, memory: ModelSearch) -> int:
        """Update the belief, and choose among the actions that the mask allows."""
        del belief
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

    A heuristic drives to the end of the search. `belief` takes a thousand times as long for a decision: it makes
    `ahead` decisions after the first action, and what it then expects counts for the rest.

    Args:
        problem: the problem.
        simulations: number of simulated searches for a decision.
        budget_ms: time for a decision, ms, instead of their number.
        base: a heuristic, one of `planners.heuristics.policies`, or `belief`.
        ahead: decisions of `belief` in a simulated search; 0: to its end.
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
        ahead: int = 1,
        seed: int = 0,
        any_day: bool = False,
    ) -> None:
        super().__init__(problem, seed, any_day)
        require_whole("simulations", simulations, least=1)
        require_one_of("base", base, (*POLICIES, BELIEF))
        require_whole("ahead", ahead)
        if budget_ms is not None:
            require_number("budget_ms", budget_ms, above=0.0)
        self.simulations, self.budget_ms = simulations, budget_ms
        self._base = (
            _Planner(self.model, BeliefAgent(self.problem), ahead)
            if base == BELIEF
            else _Heuristic(self.model, POLICIES[base])
        )

    def begin(self, observation: Observation, belief: SlotBelief) -> ModelSearch:
        memory = super().begin(observation, belief)
        if isinstance(self._base, _Planner):
            memory.base = self._base.planner.begin(observation, belief)
        return memory

    def choose(self, actions: IntArray, memory: ModelSearch) -> int:
        """Return the action with the least mean cost; that of the base, if none is surely better."""
        base = self._base.decide(memory)
        if base >= 0:  # else it gives up
            actions = np.union1d(actions, base)  # it may wait
        rounds = max(math.ceil(math.log2(len(actions))), 1)
        cost_s = np.empty((len(actions), 0))  # by action and world
        for _ in range(rounds):
            for n in self._batches(len(actions), rounds):
                cost_s = np.hstack([cost_s, self._costs_s(actions, base, memory, n)])
            better = np.argsort(cost_s.mean(axis=1), kind="stable")[: (len(actions) + 1) // 2]
            left = np.union1d(better, np.flatnonzero(actions == base))
            actions, cost_s = actions[left], cost_s[left]
        best = int(cost_s.mean(axis=1).argmin())
        for saved_s in cost_s[actions == base] - cost_s[best]:
            # Chance would let it drive to and fro.
            if saved_s.mean() <= _SURE * saved_s.std() / math.sqrt(saved_s.size):
                return base
        if memory.base is not None:
            memory.base.leave_path()
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

    def _costs_s(self, actions: IntArray, base: int, memory: ModelSearch, n: int) -> FloatArray:
        """Return the cost of each action in n worlds, the same for all actions, (n_actions, n) s."""
        worlds = self.model.sample(memory.belief, memory.rng, n, copies=len(actions))
        return self._base.costs_s(worlds, np.repeat(actions, n), base, memory).reshape(len(actions), n)


@dataclass
class _Heuristic:
    """A compiled heuristic as what drives on after the first action."""

    model: Model
    policy: CompiledPolicy

    def decide(self, memory: ModelSearch) -> int:
        return int(self.model.sample(memory.belief, memory.rng).choose(self.policy)[0])

    def costs_s(self, worlds: Simulations, first: IntArray, base: int, memory: ModelSearch) -> FloatArray:
        del base, memory
        return np.asarray(worlds.step(first)[0] + worlds.run(self.policy))


@dataclass
class _Planner:
    """`belief` as what drives on; `base` is the first action that it would take itself."""

    model: Model
    planner: BeliefAgent
    ahead: int

    def decide(self, memory: ModelSearch) -> int:
        assert memory.base is not None
        return self.planner.decide({"vertex": memory.belief.vertex}, memory.belief.slots, memory.base)

    def costs_s(self, worlds: Simulations, first: IntArray, base: int, memory: ModelSearch) -> FloatArray:
        cost_s = (self._cost_s(worlds.one(i), int(a), a == base, memory) for i, a in enumerate(first))
        return np.fromiter(cost_s, np.float64, len(first))

    def _cost_s(self, world: Simulations, action: int, on_path: bool, memory: ModelSearch) -> float:
        """Return the cost of one simulated search, s, that begins with an action."""
        assert memory.base is not None
        belief, search, cost_s = memory.belief, memory.base.copy(), 0.0
        if not on_path:
            search.leave_path()
        for decisions in range(1, MAX_STEPS):
            (step_s,), (over,) = world.step(np.array([action]))
            cost_s += float(step_s)
            if over:
                break
            seen = world.observation()
            belief = self.model.update(belief, action, seen)
            action = self.planner.decide({"vertex": seen.vertex}, belief.slots, search)
            if decisions == self.ahead and math.isfinite(search.expected_s):
                return cost_s + search.expected_s
        return cost_s
