"""What the peers of papers have in common: they choose a slot, and drive there by the shortest way."""

from __future__ import annotations

from abc import abstractmethod
from typing import TypeVar

import numpy as np
from scipy.sparse.csgraph import dijkstra

from parkenv.belief.slot_belief import SlotBelief
from parkenv.world.lot import PARK
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation, SearchAgent

Memory = TypeVar("Memory")
SURELY_TAKEN = 0.999  # P(taken) from which on a driver waits at a slot, and does not try to park in it


class SlotAgent(SearchAgent[Memory]):
    """Base class: `target` chooses a slot at every decision."""

    def __init__(self, problem: SearchProblem) -> None:
        super().__init__(problem)
        # (n_vertices, n_vertices) s, drive from each vertex to each other.
        self.drive_s = dijkstra(self.problem.lot.drive_matrix(timed=True)) / self.problem.v_drive
        self.n_slots = self.problem.lot.n_slots

    @abstractmethod
    def target(self, here: int, belief: SlotBelief, memory: Memory) -> int:
        """Return the slot to drive to from the vertex `here`."""

    def decide(self, observation: Observation, belief: SlotBelief, memory: Memory) -> int:
        """Park in the slot, wait if it is known to be taken, or make the next move towards it."""
        here = int(observation["vertex"])
        slot = self.target(here, belief, memory)
        if slot == here:
            may_park = observation["action_mask"][PARK] and belief.p_occupied[here] < SURELY_TAKEN
            return PARK if may_park else self.wait(here)
        to, moves = self.problem.lot.neighbors[here], np.flatnonzero(observation["action_mask"][:PARK])
        if not len(moves):
            return self.wait(here)
        return int(moves[np.argmin(self.problem.move_s[here, moves] + self.drive_s[to[moves], slot])])
