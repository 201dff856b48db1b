"""Probability-aware parking of Hickert, Li, He and Wu (MIT): to the lot of the least expected time, 1 to 3 stops ahead.

    parkenv compare --agents "belief,examples.peers.mit:StopsAhead(stops=2),examples.peers.mit:Patient"

Source: "Probability-Aware Parking Selection", arXiv 2601.00521, IEEE Transactions on Intelligent Transportation Systems
2026, and the authors' code (github.com/chickert/Probability-Aware-Parking-Selection), of which this file has the rules,
not the lines. A lot j has a space with probability p_j and a walk w_j; the drive to it takes t_ij. From i, the last
stop that is foreseen costs t_ij / p_j + w_j, an earlier one t_ij + p_j w_j + (1 - p_j) times the least cost from j on,
and waiting at a lot for another chance takes 5 minutes. A driver does not know how probabilities will change.

What had to be guessed:

- The paper's lots are three garages or groups of pay stations each. Here they are the sides of streets between two
  junctions, or single slots with `lots=slots`; in its lot a driver heads for the slot of the least t / p + w.
- Probabilities are those of parkenv's belief: the forecast, and what the driver has seen on its way. The paper's come
  from an app. It decides at lots, this driver wherever it may turn.
- `Patient` waits at the slot with the shortest walk until it sees a free one from there. The paper's simulation ends
  such a wait after an hour; here the driver becomes impatient.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from examples.peers.to_a_slot import SURELY_TAKEN, SlotAgent
from parkenv.belief.slot_belief import SlotBelief
from parkenv.errors import require_number, require_one_of, require_whole
from parkenv.world.scenario import SearchProblem
from planners.heuristics.streets import streets_of

WAIT_S, PATIENCE_S = 300.0, 3600.0
_LEAST = 1e-9  # probability that a division can do with


class StopsAhead(SlotAgent[None]):
    """Drives to the lot of the least expected time, with what to do if it is full.

    Args:
        problem: the problem.
        stops: lots ahead that are considered, 1 to 3.
        lots: `streets`, sides of streets, or `slots`.
        wait_s: time for another chance at a full lot, s.
    """

    name: ClassVar[str] = "mit"

    def __init__(
        self, problem: SearchProblem, stops: int = 2, lots: str = "streets", wait_s: float = WAIT_S
    ) -> None:
        super().__init__(problem)
        require_whole("stops", stops, least=1, most=3)
        require_one_of("lots", lots, ("streets", "slots"))
        require_number("wait_s", wait_s, above=0.0)
        self.stops, self.wait_s = stops, wait_s
        self.slots = self.first = np.arange(self.n_slots)  # slots lot by lot, and where each lot begins
        if lots == "streets":
            streets = streets_of(self.problem.lot, np.asarray(self.problem.move_cost_s))
            self.slots, self.first = streets["slots"], streets["place_first"][:-1]
        self.last = np.append(self.first[1:], self.n_slots)
        sizes = self.last - self.first
        self.cost_s = np.add.reduceat(self.problem.finite_cost_s[self.slots], self.first) / sizes
        to_lot_s = np.minimum.reduceat(self.drive_s[np.ix_(self.slots, self.slots)], self.first, axis=1)
        self.between_s = np.add.reduceat(to_lot_s, self.first) / sizes[:, None]
        np.fill_diagonal(self.between_s, wait_s)

    def begin(self, observation: Any, belief: SlotBelief) -> None:
        """See `SearchAgent`; it has no memory."""
        del observation, belief

    def target(self, here: int, belief: SlotBelief, memory: None) -> int:
        """Return the slot to head for in the best lot."""
        del memory
        taken = np.where(np.isinf(self.problem.arrival_cost_s), 1.0, belief.p_occupied)[self.slots]
        drive_s = self.drive_s[here, self.slots]
        wait_s = np.where(taken > SURELY_TAKEN, self.wait_s, 0.0)
        p = np.maximum(1.0 - np.multiply.reduceat(taken, self.first), _LEAST)
        expected_s = self.expected_s(np.minimum.reduceat(drive_s + wait_s, self.first), p)
        lot = int(expected_s.argmin())
        inside = slice(self.first[lot], self.last[lot])
        slots = self.slots[inside]
        chance = np.maximum(1.0 - taken[inside], _LEAST)
        of_slot_s = (drive_s + wait_s)[inside] / chance + self.problem.finite_cost_s[slots]
        return int(slots[of_slot_s.argmin()])

    def expected_s(self, to_lot_s: Any, p: Any) -> Any:
        """Return the expected time, (n_lots,) s, of each lot as the next stop.

        Args:
            to_lot_s: (n_lots,) s, drive from the car to each lot.
            p: (n_lots,) probability of a space.
        """
        if self.stops == 1:
            return to_lot_s / p + self.cost_s
        onward_s = (self.between_s / p + self.cost_s).min(axis=1)
        for _ in range(self.stops - 2):
            onward_s = (self.between_s + p * self.cost_s + (1.0 - p) * onward_s).min(axis=1)
        return to_lot_s + p * self.cost_s + (1.0 - p) * onward_s


@dataclass
class Visits:
    """Memory of a driver without probabilities: its target, and since when slots seen taken count as visited, s."""

    target: int
    since_s: float = 0.0


class Impatient(SlotAgent[Visits]):
    """Drives to the slot with the shortest walk, and from slots that are taken to the nearest that it has not seen.

    Once it has seen all of them taken, it starts again with the others.
    """

    name: ClassVar[str] = "impatient"

    def begin(self, observation: Any, belief: SlotBelief) -> Visits:
        """Start for the slot with the shortest walk."""
        del observation, belief
        return Visits(int(self.problem.finite_cost_s.argmin()))

    def target(self, here: int, belief: SlotBelief, memory: Visits) -> int:
        """Return the target; another one if it was seen taken."""
        if self.visited(belief, memory)[memory.target]:
            if self.visited(belief, memory).all():
                memory.since_s = belief.time
            closed = self.visited(belief, memory) | (np.arange(self.n_slots) == memory.target)
            memory.target = int(np.where(closed, np.inf, self.drive_s[here, : self.n_slots]).argmin())
        return memory.target

    def visited(self, belief: SlotBelief, memory: Visits) -> Any:
        """Return the slots that count as visited, (n_slots,) bool."""
        seen = belief.observed_taken & (belief.observed_at >= memory.since_s)
        return seen | np.isinf(self.problem.arrival_cost_s)


class Patient(Impatient):
    """Drives to the slot with the shortest walk, and waits there until it sees a free one."""

    name: ClassVar[str] = "patient"

    def target(self, here: int, belief: SlotBelief, memory: Visits) -> int:
        """Return the nearest slot, or a free one in view from there."""
        if belief.time > PATIENCE_S:
            return super().target(here, belief, memory)
        slot = int(self.problem.finite_cost_s.argmin())
        free = np.flatnonzero(belief.observed_free & (belief.observed_at >= belief.time))
        if here == slot and len(free):
            memory.target = int(free[self.problem.finite_cost_s[free].argmin()])
        elif here == slot or belief.observed_taken[memory.target]:
            memory.target = slot
        return memory.target
