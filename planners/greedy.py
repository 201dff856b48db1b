"""The strategies that people use: no map of how often slots are taken, just eyes and habits.

They tell from the belief what they have seen: a slot below its forecast was seen free, above it taken,
at its forecast not at all. "Free-looking" means not seen taken.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from parkenv.errors import InputError
from parkenv.world.lot import PARK
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation, SearchAgent
from planners.routes import DriveRoutes


@dataclass
class Eyes:
    """What a strategy remembers.

    Attributes:
        forecast: (n_slots,) float32, the belief before anything was seen.
        target: the slot that it is driving to, or -1.
    """

    forecast: NDArray[np.float32]
    target: int = -1


class TargetAgent(SearchAgent[Eyes]):
    """Drives to one slot after the other, parks where its target is free, and drops it once seen taken."""

    def __init__(self, problem: SearchProblem) -> None:
        super().__init__(problem)
        self.routes = DriveRoutes(problem)

    def begin(self, observation: Observation) -> Eyes:
        """Remember the first observation, which is the forecast, so that later sightings stand out."""
        return Eyes(forecast=np.array(observation["p_occupied"]))

    def decide(self, observation: Observation, memory: Eyes) -> int:
        """Keep to the target while it is free-looking, else choose another; park on arrival."""
        vertex = int(observation["vertex"])
        p = observation["p_occupied"]
        candidates = p <= memory.forecast
        seen_free = p < memory.forecast
        previous = memory.target
        if previous < 0 or not candidates[previous] or self.changes_mind(seen_free, previous):
            memory.target = self.choose(candidates, seen_free, vertex, previous)
            if memory.target < 0:
                # Everything has been seen taken: what was seen longest ago may be free by now.
                memory.target = int(np.where(self.within_reach(vertex), p, np.inf).argmin())
        if memory.target == vertex:
            return PARK
        return self.routes.move_toward(vertex, memory.target)

    @abstractmethod
    def choose(
        self,
        candidates: NDArray[np.bool_],
        seen_free: NDArray[np.bool_],
        vertex: int,
        previous: int,
    ) -> int:
        """The slot to drive to, or -1 where no candidate is within reach.

        Args:
            candidates: (n_slots,) free-looking.
            seen_free: (n_slots,) seen free.
            vertex: where the car is.
            previous: the slot that it was driving to, or -1 at the start.
        """

    def within_reach(self, vertex: int) -> NDArray[np.bool_]:
        """Which slots, (n_slots,), a way leads to."""
        return np.asarray(np.isfinite(self.routes.seconds_from(vertex)[: self.problem.lot.n_slots]))

    def shortest_walks(self, candidates: NDArray[np.bool_], vertex: int) -> NDArray[np.bool_]:
        """The candidates within reach, (n_slots,), that have the shortest walk; none where none is within reach."""
        walk_s = np.where(candidates, self.problem.walk_s, np.inf)
        best = np.asarray(candidates & (walk_s == walk_s.min()))
        if not len(self.routes.nearest(vertex, best)[0]):
            walk_s[~self.within_reach(vertex)] = np.inf
            best = np.asarray(np.isfinite(walk_s) & (walk_s == walk_s.min()))
        return best

    def changes_mind(self, seen_free: NDArray[np.bool_], target: int) -> bool:
        """Whether what is seen makes the agent leave a target that still looks free."""
        del seen_free, target
        return False


class GreedyGoalAgent(TargetAgent):
    """`greedy-goal`: heads for the free-looking slot nearest to the goal, then for the next one."""

    name: ClassVar[str] = "greedy-goal"

    def choose(
        self,
        candidates: NDArray[np.bool_],
        seen_free: NDArray[np.bool_],
        vertex: int,
        previous: int,
    ) -> int:
        """The shortest walk; among equals the shortest drive."""
        del seen_free, previous
        slots, _ = self.routes.nearest(vertex, self.shortest_walks(candidates, vertex))
        return int(slots[0]) if len(slots) else -1


class GreedyDriveAgent(TargetAgent):
    """`greedy-drive`: heads for the nearest free-looking slot, however far it is from the goal."""

    name: ClassVar[str] = "greedy-drive"

    def choose(
        self,
        candidates: NDArray[np.bool_],
        seen_free: NDArray[np.bool_],
        vertex: int,
        previous: int,
    ) -> int:
        """The shortest drive; among equals the shortest walk."""
        del seen_free, previous
        slots, _ = self.routes.nearest(vertex, candidates)
        return int(slots[self.problem.walk_s[slots].argmin()]) if len(slots) else -1


class FirstFreeAgent(TargetAgent):
    """`first-free`: drives toward the goal and takes the first free slot once it is near enough.

    If it gets to where the slot nearest to the goal is and has found nothing, it looks on from there:
    always at the nearest slot not yet seen, and takes whatever is free.

    Args:
        problem: lot, goal, speeds and costs.
        within_m: walk from which on a free slot is good enough, m; the lot's median walk where None.
    """

    name: ClassVar[str] = "first-free"

    def __init__(self, problem: SearchProblem, within_m: float | None = None) -> None:
        super().__init__(problem)
        walk_m = problem.walk_s * problem.v_walk
        if within_m is not None and not within_m >= walk_m.min():
            raise InputError(
                f"within_m is {within_m}, want at least {walk_m.min():.1f}, the shortest walk of the lot"
            )
        self._near = walk_m <= (np.median(walk_m) if within_m is None else within_m)

    def choose(
        self,
        candidates: NDArray[np.bool_],
        seen_free: NDArray[np.bool_],
        vertex: int,
        previous: int,
    ) -> int:
        """A free slot in sight that is near enough; at first the one at the goal; then the next ones."""
        good = candidates & seen_free & self._near
        if good.any():
            slots, _ = self.routes.nearest(vertex, good)
            if len(slots):
                return int(slots[0])
        if previous < 0:
            candidates = self.shortest_walks(candidates, vertex)
        slots, _ = self.routes.nearest(vertex, candidates)
        return int(slots[0]) if len(slots) else -1

    def changes_mind(self, seen_free: NDArray[np.bool_], target: int) -> bool:
        """At the first near slot seen free it stops driving on."""
        return bool((seen_free & self._near).any()) and not seen_free[target]


class RandomAgent(SearchAgent[np.random.Generator]):
    """`random`: any action that the graph has here, all equally likely.

    Args:
        problem: lot, goal, speeds and costs.
        seed: together with the moment of arrival it fixes the whole episode.
    """

    name: ClassVar[str] = "random"

    def __init__(self, problem: SearchProblem, seed: int = 0) -> None:
        super().__init__(problem)
        self.seed = seed

    def begin(self, observation: Observation) -> np.random.Generator:
        """A generator that depends on the seed and the moment of arrival alone."""
        moment = int(np.float32(observation["time"][0]).view(np.uint32))
        return np.random.default_rng([self.seed, moment, int(observation["vertex"])])

    def decide(self, observation: Observation, memory: np.random.Generator) -> int:
        """One of the actions that the mask allows."""
        return int(memory.choice(np.flatnonzero(observation["action_mask"])))
