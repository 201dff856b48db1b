"""Resource routing of Strauß, Rottkamp, Schmoll and Schubert (LMU Munich): bays are Markov chains, an MDP is replanned.

    parkenv compare --scenario campus --agents "belief,examples.peers.lmu:ReplannedMDP"

Source: "Efficient Parking Search using Shared Fleet Data", arXiv 2404.10646, and "Dynamic Resource Routing using
Real-Time Dynamic Programming", IJCAI 2018, by two of the authors. We had the abstracts and a review, not the whole
texts. Every bay is a two-state Markov chain in continuous time: taken at the rate lambda, left at the rate mu. If
P(taken) is p now, it is p* + (p - p*) exp(-(lambda + mu) t) after t seconds, with p* = lambda / (lambda + mu). The
state of an MDP is the place of the car and the states of the bays; a driver plans anew after each news.

What had to be guessed:

- In Melbourne sensors tell the state of every bay. Here a driver knows the forecast, p* and lambda + mu, and what it
  has seen itself (`parkenv fleet --knows full` tells it everything).
- The exact MDP grows as two to the power of the bays. This one has `bays` of them, those of the least
  drive / P(free) + walk; its state is the bay where the car is, and the set of those that it has found taken. It is
  solved exactly.
- P(free) at a later stop is that at the time of a direct drive; a bay that was found taken stays so while the plan
  lasts, unless the driver waits for it, 1 / mu on average.

As a fleet, with reservations and adapted probabilities: `examples/peers/lmu_fleet.py`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any, ClassVar

import numpy as np

from examples.peers.to_a_slot import SURELY_TAKEN, SlotAgent
from parkenv.belief.slot_belief import SlotBelief
from parkenv.errors import require_whole
from parkenv.world.scenario import SearchProblem

_LEAST = 1e-9  # probability, or rate in 1/s, that a division can do with


@dataclass
class Route:
    """Memory of an episode: the bays of the plan in their order, and the chance that each is still free on arrival."""

    bays: list[int] = field(default_factory=list)
    p_free: list[float] = field(default_factory=list)
    arrival_s: list[float] = field(default_factory=list)  # s since the search began


class ReplannedMDP(SlotAgent[Route]):
    """Drives to the first bay of the best order of bays; plans anew whenever it has seen something.

    Args:
        problem: the problem.
        bays: number of bays of a plan, 1 to 12; each more doubles its time.
    """

    name: ClassVar[str] = "lmu"

    def __init__(self, problem: SearchProblem, bays: int = 8) -> None:
        super().__init__(problem)
        require_whole("bays", bays, least=1, most=12)
        self.n_bays = min(bays, self.n_slots)
        self.stages = {n: list(sets_of(n)) for n in range(1, self.n_bays + 1)}  # by the number of bays

    def begin(self, observation: Any, belief: SlotBelief) -> Route:
        """Start without a plan."""
        del observation, belief
        return Route()

    def target(self, here: int, belief: SlotBelief, memory: Route) -> int:
        """Return the first bay of the plan, a new one after news."""
        if not memory.bays or len(belief.observations.slots) or here == memory.bays[0]:
            self.plan(here, belief, memory)
        return memory.bays[0]

    def p_free(self, belief: SlotBelief, after_s: Any) -> Any:
        """Return P(free), (n_slots,), of each bay after `after_s`, (n_slots,) s, by its Markov chain."""
        settled = 1.0 - np.exp(-np.float64(belief.decay_rate) * np.minimum(after_s, 1e9))
        p_taken = belief.p_occupied + (belief.forecast - belief.p_occupied) * settled
        return np.where(np.isinf(self.problem.arrival_cost_s), 0.0, 1.0 - p_taken)

    def plan(self, here: int, belief: SlotBelief, route: Route) -> None:
        """Solve the MDP of the most promising bays, and write the order of bays that it prefers into `route`."""
        drive_s, cost_s = self.drive_s[here, : self.n_slots], self.problem.finite_cost_s
        p_free = self.p_free(belief, drive_s)
        index_s = drive_s / np.maximum(p_free, _LEAST) + cost_s
        leave_rate = np.float64(belief.decay_rate) * (1.0 - belief.forecast)
        wait_s = np.minimum(1.0 / np.maximum(leave_rate, _LEAST), self.problem.give_up_s) + cost_s
        # Where the car stands before a bay that it takes for taken, it tries another one.
        index_s[p_free <= 1.0 - SURELY_TAKEN] = np.inf
        bays = np.argpartition(index_s, self.n_bays - 1)[: self.n_bays]
        bays = bays[np.isfinite(index_s[bays])]
        if not len(bays):
            route.bays, route.p_free, route.arrival_s = [int((drive_s + wait_s).argmin())], [0.0], [np.inf]
            return
        between_s, p = self.drive_s[np.ix_(bays, bays)], p_free[bays]
        after_s = best_times(self.stages[len(bays)], between_s, p, cost_s[bays], wait_s[bays])
        # Follow the plan from here, bay by bay, as if each was taken.
        route.bays, route.p_free, route.arrival_s = [], [], []
        taken, to_s, time = 0, drive_s[bays], belief.time
        for _ in bays:
            numbers = np.arange(len(bays))
            total_s = to_s + p * cost_s[bays] + (1.0 - p) * after_s[taken | 1 << numbers, numbers]
            total_s[(taken >> numbers & 1) == 1] = np.inf
            j = int(total_s.argmin())
            time, to_s, taken = time + float(to_s[j]), between_s[j], taken | 1 << j
            route.bays.append(int(bays[j]))
            route.p_free.append(float(p[j]))
            route.arrival_s.append(time)


def sets_of(n: int) -> Iterable[Any]:
    """Yield the sets of n bays as bits of numbers, (k,) int64, all of one size at once, the largest first."""
    for size in range(n, 0, -1):
        yield np.array([sum(1 << j for j in chosen) for chosen in combinations(range(n), size)])


def best_times(stages: list[Any], between_s: Any, p: Any, cost_s: Any, wait_s: Any) -> Any:
    """Return the expected time to go, (2^n, n) s, from each bay while a set of bays, it among them, was found taken.

    Args:
        stages: sets of bays, the largest first, as `sets_of` yields them.
        between_s: (n, n) s, drive from bay to bay.
        p: (n,) probability that a bay is free.
        cost_s: (n,) s, cost of arriving in a bay.
        wait_s: (n,) s, expected time to wait until a bay is free, and to arrive in it.

    Examples:
        Bay 1 is surely free: from bay 0 it takes 5 s to drive there and 10 s to arrive.

        >>> between_s = np.array([[0.0, 5.0], [5.0, 0.0]])
        >>> times_s = best_times(list(sets_of(2)), between_s, np.array([0.0, 1.0]), np.full(2, 10.0), np.full(2, 99.0))
        >>> float(times_s[0b01, 0])
        15.0
    """
    n = len(p)
    after_s = np.broadcast_to(wait_s, (1 << n, n)).copy()
    bits = 1 << np.arange(n)
    for sets in stages[1:]:
        # What trying bay j costs from its arrival on; nothing is tried twice.
        try_s = p * cost_s + (1.0 - p) * after_s[sets[:, None] | bits, np.arange(n)]
        try_s[(sets[:, None] & bits) != 0] = np.inf
        after_s[sets] = np.minimum(wait_s, (between_s + try_s[:, None, :]).min(axis=2))
    return after_s
