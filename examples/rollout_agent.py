"""A planner on `parkenv.model`: tries its actions in worlds of its belief, where a heuristic drives on after them.

    parkenv compare --scenario mini --agents "greedy-total,examples.rollout_agent:Rollout" --episodes 20

takes about ten seconds. `ModelAgent` keeps the belief up to date for any planner on the model.
"""

import math
import time
from dataclasses import dataclass

import numpy as np

import parkenv
from parkenv.engine.model import Belief
from parkenv.world.lot import PARK
from planners.agent import SearchAgent
from planners.heuristics.policies import POLICIES


@dataclass
class ModelSearch:
    """Memory of an episode: the belief, the last action, and the random numbers of its worlds."""

    belief: Belief
    rng: np.random.Generator
    action: int | None = None


class ModelAgent(SearchAgent):
    """Keeps the belief of `parkenv.model`; a subclass chooses by it one of the actions, (n,) int64."""

    def __init__(self, problem, seed=0):
        super().__init__(problem)
        self.seed, self.model = seed, parkenv.model(self.problem)

    def begin(self, observation, belief):
        moment = int(np.float32(observation["time"][0]).view(np.uint32))
        rng = np.random.default_rng([self.seed, moment, int(observation["vertex"])])
        return ModelSearch(self.model.initial_belief(observation), rng)

    def decide(self, observation, belief, memory):
        here = int(observation["vertex"])
        if memory.action is not None:
            memory.belief = self.model.update(memory.belief, memory.action, observation)
        actions = np.flatnonzero(observation["action_mask"])
        if here < self.problem.lot.n_slots and memory.belief.slots.p_occupied[here] > 0.999:
            actions = actions[actions != PARK]  # surely taken
        memory.action = self.choose(actions, memory) if len(actions) else self.wait(here)
        return memory.action


class Rollout(ModelAgent):
    """Takes the action that costs least on average in `simulations` searches, or as many as `budget_ms` allows.

    All actions are tried in the same worlds. The heuristic's own action is kept unless another one is better by two
    standard errors: chance would let the car drive to and fro.
    """

    name = "rollout"

    def __init__(self, problem, simulations=256, budget_ms=None, base="greedy-total", seed=0):
        super().__init__(problem, seed)
        self.simulations, self.budget_ms, self.base = simulations, budget_ms, POLICIES[base]

    def choose(self, actions, memory):
        usual = int(self.model.sample(memory.belief, memory.rng).choose(self.base)[0])
        actions = np.union1d(actions, usual) if usual >= 0 else actions  # it may wait, or give up
        n = max((32 if self.budget_ms else self.simulations) // len(actions), 1)
        cost_s, end = np.empty((len(actions), 0)), time.perf_counter() + (self.budget_ms or 0.0) / 1e3
        while cost_s.size == 0 or time.perf_counter() < end:
            worlds = self.model.sample(memory.belief, memory.rng, n, copies=len(actions))
            first_s, _ = worlds.step(np.repeat(actions, n))
            cost_s = np.hstack([cost_s, (first_s + worlds.run(self.base)).reshape(len(actions), n)])
        best = int(cost_s.mean(axis=1).argmin())
        saved_s = cost_s[actions == usual] - cost_s[best]
        keeps = saved_s.size and saved_s.mean() <= 2.0 * saved_s.std() / math.sqrt(saved_s.size)
        return usual if keeps else int(actions[best])
