"""`belief-rivals`: the planner in belief space, in a lot that other searching cars fill.

**Herding.** Drivers with the same knowledge and the same rule make the same tour, one behind the other: each finds what
the car ahead has left, and nobody sees slots that become free elsewhere. So each driver draws numbers of its own from
its time of arrival: a taste for slots that are nearly as good, and the number of rivals that it expects.

**The number of rivals** is given, or inferred from the cars that the driver meets. Slots do not reveal it: if all
drivers believe that nobody else is searching, the slots behind the entry stay free and confirm it.

**Model of rivals.** A rival passes the free slots in the order of the total time from the entry to the goal, and takes
each with the same probability. So the best slots are expected to be taken, whatever the forecast says, and free ones
there to be gone soon; slots far from the goal keep their forecast.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from parkenv.belief.slot_belief import SlotBelief
from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled
from parkenv.errors import require_number
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation
from planners.belief.agent import BeliefAgent, BeliefSearch, Crowd
from planners.belief.planning_graph import PlanningGraph
from planners.neighborhood import MOST_VERTICES

PASSED = 3.0
"""Mean number of free slots that a rival passes, or drives on from to the next, before it takes one."""
EXPECTS_RIVALS_S = 90.0
"""s of search for which a driver expects rivals beside the usual cars.

A driver that expects rivals leaves the best slots to them. If all drivers do so in a full lot, nobody finds the free
slots there.
"""
MET_S = 20.0
"""A driver that has met n cars expects n / `MET_S` rivals a second: of 160 an hour, 39 % meet one within 15 s."""
ROOM = 2.0
"""A driver expects all rivals if their number is at least this many times what the slots free by forecast can take.

Of fewer rivals it expects a proportionally smaller part: with room for all, leaving the best slots to others helps
nobody. With 3, 20 days on `campus` and on a real place at four demands change by -2.3 to +1.3 s, 0.0 s in the mean.
"""
TASTE_S, TASTE_M = 8.0, 40.0
"""A driver's taste: s by which it finds a place better or worse than it is at most; m from one best place to the next.

With 16 s, cars on `campus` and Dragon Lake take as long as with 8.
"""


class BeliefRivalsAgent(BeliefAgent):
    """`belief-rivals`: `belief`, which expects that rivals take free slots, the best ones first.

    A driver expects 0 to 2 times as many rivals as arrive (uniform): some head for the best slots, others stop soon.
    After `EXPECTS_RIVALS_S` of search it expects none.

    Args:
        problem: lot, goal, speeds and costs.
        arrivals_per_hour: rivals an hour; None: not known, then the driver infers them from the other cars in view, if
            cars are observed (`sees_cars` of `parkenv.engine.fleet.Fleet`), else it has only its taste. With 0 the
            agent is `belief`, action for action.
        budget_ms, day, most_vertices: see `belief`.
    """

    name: ClassVar[str] = "belief-rivals"

    def __init__(
        self,
        problem: SearchProblem,
        arrivals_per_hour: float | None = None,
        budget_ms: float = 1.0,
        day: bool = True,
        most_vertices: int = MOST_VERTICES,
    ) -> None:
        super().__init__(problem, budget_ms, day, most_vertices)
        if arrivals_per_hour is not None:
            require_number("arrivals_per_hour", arrivals_per_hour, least=0.0)
        self.arrivals_per_hour = arrivals_per_hour
        lot = self.problem.lot
        drive_m = dijkstra(lot.drive_matrix(timed=True), indices=np.unique(lot.entry_vertices), min_only=True)
        rival_s = drive_m[: lot.n_slots] / self.problem.v_drive + self.problem.finite_cost_s
        self._order = np.argsort(rival_s, kind="stable")

    def _planning_graph(self, memory: BeliefSearch) -> PlanningGraph:
        graph = super()._planning_graph(memory)
        if self.arrivals_per_hour == 0.0:
            return graph
        # A wave over the lot, of random direction and phase.
        _, *angles = 2.0 * np.pi * own_numbers(memory.crowd.arrival_s)
        heading, phase = angles
        along_m = self.problem.lot.vertex_xy[memory.near.slots] @ [math.cos(heading), math.sin(heading)]
        taste_s = TASTE_S * np.cos(2.0 * np.pi / TASTE_M * along_m + phase)
        return graph._replace(cost_s=graph.cost_s + taste_s)

    def decide(self, observation: Observation, belief: SlotBelief, memory: BeliefSearch) -> int:
        """Decide as `belief`; when another car is met, and after a long search, first infer the day anew."""
        crowd = memory.crowd.after(observation)
        learns = self.arrivals_per_hour is None and crowd.met != memory.crowd.met
        memory.crowd = crowd
        if learns or memory.time <= EXPECTS_RIVALS_S < belief.time:
            memory.day = self._day_belief(memory.near, belief, crowd)
            for observations in memory.past:
                memory.day.update(observations.take(memory.near.slots))
        if memory.near.whole:
            memory.past.append(belief.observations)
        return super().decide(observation, belief, memory)

    def _rival_rates(self, belief: SlotBelief, crowd: Crowd) -> FloatArray:
        forecast = belief.forecast.astype(np.float64)
        leaving = belief.decay_rate.astype(np.float64) * (1.0 - forecast)
        if belief.time > EXPECTS_RIVALS_S:
            per_s = 0.0
        elif self.arrivals_per_hour is not None:
            per_s = self.arrivals_per_hour / 3600.0
        else:
            per_s = crowd.met / MET_S
        per_s *= min(1.0, per_s / max(ROOM * float((1.0 - forecast) @ leaving), 1e-12))
        number = 2.0 * own_numbers(crowd.arrival_s)[0]
        return np.asarray(_take_rates(1.0 - forecast, leaving, self._order, number * per_s, PASSED))


def own_numbers(arrival_s: float) -> FloatArray:
    """Return three random numbers from 0 to 1 of the driver that arrives at a time, s since Monday 00:00, (3,)."""
    return np.random.default_rng(int(64.0 * arrival_s)).random(3)


@compiled(error_model="numpy")
def _take_rates(
    p_free: FloatArray, leaving: FloatArray, order: NDArray[np.int64], per_s: float, passed: float
) -> FloatArray:
    """Return the rates at which rivals take each slot while it is free, (n_slots,) 1/s.

    In equilibrium they find parking at the rate at which they arrive, unless the lot is full. Slots that nobody leaves,
    with `leaving` 0 (n_slots,) 1/s, do not change. `order` has the best slots first; rivals pass `passed` free ones.
    """
    rates, n_better = np.zeros(len(p_free)), 0.0
    for s in order:
        if leaving[s] > 0.0:
            rates[s] = per_s * math.exp(-n_better / passed) / passed
            n_better += p_free[s] / (1.0 + rates[s] * p_free[s] / leaving[s])
        else:
            n_better += p_free[s]
    return rates
