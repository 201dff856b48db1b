"""Heuristic baselines: how people search, from their observations and without a forecast."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import OBSERVED_TAKEN, UNOBSERVED, SlotBelief
from parkenv.engine.policy import CompiledPolicy, PolicyData
from parkenv.errors import require
from parkenv.world.lot import PARK
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation, SearchAgent
from planners.heuristics.policies import POLICIES, target_policy
from planners.heuristics.rules import (
    FIRST_FREE,
    GREEDY_DRIVE,
    GREEDY_GOAL,
    GREEDY_TOTAL,
    NO_SLOT,
    choose_route,
    heuristic_tables,
    keeps_target,
)
from planners.heuristics.streets import choose_place, street_tables, takes_slot


@dataclass
class GreedyState:
    """Memory of a heuristic: the slot to drive to, or `NO_SLOT`, and the moves to it, the last one first."""

    moves: NDArray[np.uint8]
    target: int = NO_SLOT
    n_moves: int = 0
    # until when `usual` expects to search, walk and pay, s since the beginning
    expected_s: float = 0.0


class TargetAgent(SearchAgent[GreedyState]):
    """Drives to one slot after another, parks if the target is free, and drops it once it is observed taken.

    Its decisions are those of `planners.heuristics.rules`, as are those of its compiled policy.
    """

    heuristic: ClassVar[int]
    within_m: float | None = None

    @cached_property
    def _tables(self) -> PolicyData:
        return heuristic_tables(self.heuristic, [self.problem], self.within_m)

    def __getstate__(self) -> dict[str, Any]:
        """Copies and pickles make tables of their own: these hold addresses."""
        return {name: value for name, value in vars(self).items() if name != "_tables"}

    def begin(self, observation: Observation, belief: SlotBelief) -> GreedyState:
        return GreedyState(np.zeros(2 * self.problem.lot.n_vertices, np.uint8))

    def decide(self, observation: Observation, belief: SlotBelief, memory: GreedyState) -> int:
        states, vertex, target = belief.recent_state, int(observation["vertex"]), memory.target
        if not keeps_target(self.heuristic, target, states[target] if target != NO_SLOT else UNOBSERVED):
            tables = self._tables
            tables.arrays["states"][:], tables.arrays["p_occupied"][:] = states, belief.p_occupied
            memory.target, memory.n_moves = choose_route(
                tables.address, 0, 0, vertex, target, memory.moves, memory.n_moves
            )
        return self._next_action(vertex, memory)

    def _next_action(self, vertex: int, memory: GreedyState) -> int:
        if memory.target == NO_SLOT:
            return self.wait(vertex)
        if memory.n_moves == 0:
            return PARK
        memory.n_moves -= 1
        return int(memory.moves[memory.n_moves])

    def plan_preview(self, observation: Observation, action: int, memory: GreedyState) -> tuple[int, ...]:
        path = [int(observation["vertex"])]
        moves = [] if action == PARK else [action, *memory.moves[: memory.n_moves][::-1]]
        for move in moves:
            path.append(int(self.problem.lot.neighbors[path[-1], move]))
        return tuple(path[1:])

    def compiled_policy(self) -> CompiledPolicy:
        """Return the policy that decides as this agent for the cars of a fleet, without Python."""
        return target_policy(self.name, self.heuristic, self.within_m)


class GreedyGoalAgent(TargetAgent):
    """`greedy-goal`: drives to the candidate nearest to the goal, then to the next one.

    Nearest means the lowest arrival cost: where slots have a price, a cheaper one may come before a nearer one. Among
    equals it is the one with the shortest drive.
    """

    name: ClassVar[str] = "greedy-goal"
    heuristic = GREEDY_GOAL


class GreedyDriveAgent(TargetAgent):
    """`greedy-drive`: drives to the nearest candidate, however far it is from the goal.

    Among equals it is the one with the lowest arrival cost.
    """

    name: ClassVar[str] = "greedy-drive"
    heuristic = GREEDY_DRIVE


class GreedyTotalAgent(TargetAgent):
    """`greedy-total`: drives to the candidate with the least total time to drive, walk and pay, and minds prices.

    The drive to a slot that it has not observed counts three times: the slot may be taken, and one that it knows to be
    free lies behind it.
    """

    name: ClassVar[str] = "greedy-total"
    heuristic = GREEDY_TOTAL


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
    heuristic = FIRST_FREE

    def __init__(self, problem: SearchProblem, within_m: float | None = None) -> None:
        self.within_m = within_m
        super().__init__(problem)
        least_m = self.problem.arrival_cost_s.min() * self.problem.v_walk
        require(
            within_m is None or within_m >= least_m,
            f"within_m is {within_m}, want at least {least_m:.1f}, the shortest walk of the lot",
        )


class UsualAgent(TargetAgent):
    """`usual`: drives to the place that is cheapest by its experience, the forecast, and on from there if it is full.

    A place is one side of a street between two junctions, or a garage. Its cost is the drive there, divided by the
    chance that it has a free slot, and the arrival cost (`planners.heuristics.streets`). A free slot that the driver
    passes is taken if the search would then end no later than planned.
    """

    name: ClassVar[str] = "usual"

    @cached_property
    def _tables(self) -> PolicyData:
        return street_tables([self.problem])

    def decide(self, observation: Observation, belief: SlotBelief, memory: GreedyState) -> int:
        states, vertex, target = belief.recent_state, int(observation["vertex"]), memory.target
        tables = self._tables
        tables.arrays["states"][:] = states
        if target == NO_SLOT or states[target] == OBSERVED_TAKEN:
            tables.arrays["p_occupied"][:], tables.arrays["forecast"][:] = belief.p_occupied, belief.forecast
            tables.arrays["last_states"][:] = belief.state
            memory.target, memory.n_moves, index_s = choose_place(
                tables.address, 0, 0, vertex, target, memory.moves, memory.n_moves
            )
            memory.expected_s = belief.time + index_s
        if memory.target != NO_SLOT and takes_slot(
            tables.address, 0, 0, vertex, memory.expected_s - belief.time
        ):
            return PARK
        return self._next_action(vertex, memory)

    def compiled_policy(self) -> CompiledPolicy:
        return POLICIES[self.name]


class RandomAgent(SearchAgent[np.random.Generator]):
    """`random`: chooses any available action, all with equal probability; waits at a dead end.

    The `seed`, the time of arrival and the entry determine the actions.
    """

    name: ClassVar[str] = "random"

    def __init__(self, problem: SearchProblem, seed: int = 0) -> None:
        super().__init__(problem)
        self.seed = seed

    def begin(self, observation: Observation, belief: SlotBelief) -> np.random.Generator:
        moment = int(np.float32(observation["time"][0]).view(np.uint32))
        return np.random.default_rng([self.seed, moment, int(observation["vertex"])])

    def decide(self, observation: Observation, belief: SlotBelief, memory: np.random.Generator) -> int:
        available = np.flatnonzero(observation["action_mask"])
        return int(memory.choice(available)) if available.size else self.wait(int(observation["vertex"]))
