"""Heuristic baselines: how people search, from their observations and without a forecast.

A slot is a candidate unless it was recently observed taken. Heuristics that consider the goal rank slots by arrival
cost (`SearchProblem.arrival_cost_s`): the walk, and the price where slots have one.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import OBSERVED_FREE, OBSERVED_TAKEN, SlotBelief
from parkenv.errors import InputError
from parkenv.world.lot import PARK
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation, PlanPreview, SearchAgent
from planners.routes import DriveRoutes

Slots = NDArray[np.bool_]  # A set of slots, (n_slots,) bool


@dataclass
class GreedyState:
    """Memory of a heuristic."""

    target: int = -1  # the slot to drive to, or -1


class TargetAgent(SearchAgent[GreedyState]):
    """Drives to one slot after another, parks if the target is free, and drops it once it is observed taken."""

    def __init__(self, problem: SearchProblem) -> None:
        super().__init__(problem)
        self.routes = DriveRoutes(self.problem)

    def begin(self, observation: Observation, belief: SlotBelief) -> GreedyState:
        """Start without a target."""
        del observation, belief
        return GreedyState()

    def decide(self, observation: Observation, belief: SlotBelief, memory: GreedyState) -> int:
        """Keep the target while it is a candidate, else choose another one; park on arrival."""
        vertex = int(observation["vertex"])
        previous = memory.target
        taken = previous >= 0 and belief.state[previous] == OBSERVED_TAKEN and not _decayed(belief)[previous]
        if previous < 0 or taken or self.drops_target(belief, previous):
            candidates = ~belief.observed_taken | _decayed(belief)
            memory.target = self.choose(candidates, belief.observed_free, vertex, previous)
            if memory.target < 0:
                # Every slot was observed taken: the one observed longest ago is the most likely to be free.
                p_occupied = np.where(self.reachable(vertex), belief.p_occupied, np.inf)
                memory.target = int(p_occupied.argmin())
        if memory.target == vertex:
            return PARK
        return self.routes.move_toward(vertex, memory.target)

    def plan_preview(self, observation: Observation, action: int, memory: GreedyState) -> PlanPreview:
        """Return the shortest route to the target."""
        del action
        return PlanPreview(self.routes.path(int(observation["vertex"]), memory.target))

    @abstractmethod
    def choose(self, candidates: Slots, observed_free: Slots, vertex: int, previous: int) -> int:
        """Return the slot to drive to, or -1 if no candidate is reachable.

        Args:
            candidates: slots not recently observed taken.
            observed_free: slots that were observed free.
            vertex: where the car is.
            previous: the previous target, or -1 at the start.
        """

    def reachable(self, vertex: int) -> Slots:
        """Return the slots, (n_slots,) bool, that are reachable from a vertex."""
        return np.asarray(np.isfinite(self.routes.seconds_from(vertex)[: self.problem.lot.n_slots]))

    def cheapest(self, candidates: Slots, vertex: int) -> Slots:
        """Return the reachable candidates, (n_slots,) bool, with the lowest arrival cost; all False if none."""
        cost_s = np.where(candidates, self.problem.arrival_cost_s, np.inf)
        best = np.asarray(candidates & (cost_s == cost_s.min()))
        if not len(self.routes.nearest(vertex, best)[0]):
            cost_s[~self.reachable(vertex)] = np.inf
            best = np.asarray(np.isfinite(cost_s) & (cost_s == cost_s.min()))
        return best

    def drops_target(self, belief: SlotBelief, target: int) -> bool:
        """Return whether to choose another target even though this one was not observed taken."""
        del belief, target
        return False


def _decayed(belief: SlotBelief) -> Slots:
    """Return the slots, (n_slots,) bool, whose last observation has decayed to the forecast."""
    return np.asarray((belief.p_occupied == belief.forecast) & (belief.p_observed != belief.forecast))


class GreedyGoalAgent(TargetAgent):
    """`greedy-goal`: drives to the candidate nearest to the goal, then to the next one.

    Nearest means the lowest arrival cost: where slots have a price, a cheaper one may come before a nearer one.
    """

    name: ClassVar[str] = "greedy-goal"

    def choose(self, candidates: Slots, observed_free: Slots, vertex: int, previous: int) -> int:
        """Return the slot with the lowest arrival cost; among equals the one with the shortest drive."""
        del observed_free, previous
        slots, _ = self.routes.nearest(vertex, self.cheapest(candidates, vertex))
        return int(slots[0]) if len(slots) else -1


class GreedyDriveAgent(TargetAgent):
    """`greedy-drive`: drives to the nearest candidate, however far it is from the goal."""

    name: ClassVar[str] = "greedy-drive"

    def choose(self, candidates: Slots, observed_free: Slots, vertex: int, previous: int) -> int:
        """Return the slot with the shortest drive; among equals the one with the lowest arrival cost."""
        del observed_free, previous
        slots, _ = self.routes.nearest(vertex, candidates)
        return int(slots[self.problem.arrival_cost_s[slots].argmin()]) if len(slots) else -1


class FirstFreeAgent(TargetAgent):
    """`first-free`: drives towards the goal and takes the first free slot that is near enough.

    If it has found none when it reaches the slot nearest to the goal, it drives on to the nearest unobserved slot, and
    so on, and takes any free slot.

    Args:
        problem: the problem.
        within_m: maximum distance from the goal, m, at which a free slot is good enough; None: the lot's median. A
            slot's price counts as the distance that one walks in as many seconds.
    """

    name: ClassVar[str] = "first-free"

    def __init__(self, problem: SearchProblem, within_m: float | None = None) -> None:
        super().__init__(problem)
        arrival_m = self.problem.arrival_cost_s * self.problem.v_walk
        if within_m is not None and not within_m >= arrival_m.min():
            raise InputError(
                f"within_m is {within_m}, want at least {arrival_m.min():.1f}, the shortest walk of the lot"
            )
        self._near = arrival_m <= (np.median(arrival_m) if within_m is None else within_m)

    def choose(self, candidates: Slots, observed_free: Slots, vertex: int, previous: int) -> int:
        """Return a near enough slot observed free; else first the slot at the goal, then the nearest candidate."""
        good = candidates & observed_free & self._near
        if good.any():
            slots, _ = self.routes.nearest(vertex, good)
            if len(slots):
                return int(slots[0])
        if previous < 0:
            candidates = self.cheapest(candidates, vertex)
        slots, _ = self.routes.nearest(vertex, candidates)
        return int(slots[0]) if len(slots) else -1

    def drops_target(self, belief: SlotBelief, target: int) -> bool:
        """Return whether a near enough slot was observed free while driving to another one."""
        return belief.state[target] != OBSERVED_FREE and bool((belief.observed_free & self._near).any())


class RandomAgent(SearchAgent[np.random.Generator]):
    """`random`: chooses any available action, all with equal probability.

    The `seed`, the time of arrival and the entry determine the actions.
    """

    name: ClassVar[str] = "random"

    def __init__(self, problem: SearchProblem, seed: int = 0) -> None:
        super().__init__(problem)
        self.seed = seed

    def begin(self, observation: Observation, belief: SlotBelief) -> np.random.Generator:
        """Return a generator that depends only on the seed and the time of arrival."""
        del belief
        moment = int(np.float32(observation["time"][0]).view(np.uint32))
        return np.random.default_rng([self.seed, moment, int(observation["vertex"])])

    def decide(self, observation: Observation, belief: SlotBelief, memory: np.random.Generator) -> int:
        """Choose one of the actions that the mask allows."""
        del belief
        return int(memory.choice(np.flatnonzero(observation["action_mask"])))
