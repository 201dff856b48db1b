"""`belief-rivals`: the planner in belief space, in a lot that other searching cars fill.

Rivals arrive at a rate that is known, or one of several hypotheses. Each passes the free slots in the order of the
total time from the entry to the goal, and takes each with the same probability. So the best slots are taken most of the
time, whatever the forecast says, and are gone soon where they are free; slots that are out of the way keep their
forecast.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from parkenv.belief.day_belief import DayBelief, RivalRates
from parkenv.belief.slot_belief import SlotBelief
from parkenv.errors import InputError
from parkenv.world.scenario import SearchProblem
from planners.belief.agent import BeliefAgent
from planners.neighborhood import MOST_VERTICES, Neighborhood
from sim_sensors.compilation import compiled

FloatArray = NDArray[np.float64]

PASSED = 3.0
"""Mean number of free slots that a rival passes, or drives on from to the next, before it takes one."""
RATES = {0.0: 0.5, 60.0: 0.125, 120.0: 0.125, 240.0: 0.125, 480.0: 0.125}
"""Rivals an hour -> prior probability, where the rate is not known."""


class BeliefRivalsAgent(BeliefAgent):
    """`belief-rivals`: `belief`, which expects that rivals take free slots, the best ones first.

    Beside how the day differs from its forecast, the agent learns from its observations how many rivals arrive: slots
    near the entry that are taken against the forecast, and slots that were observed free and then taken, speak for
    many. Rivals stay as long as the forecast's cars do. In a lot whose slots never change, according to the forecast,
    nobody arrives, and the agent is `belief`.

    Args:
        problem: lot, goal, speeds and costs.
        arrivals_per_hour: rivals an hour; None: not known. With 0 the agent is `belief`, action for action.
        budget_ms: as of `belief`.
        day: as of `belief`.
        most_vertices: as of `belief`.
        explore: as of `belief`.

    Raises:
        InputError: as of `belief`; `arrivals_per_hour` is negative or not finite.
    """

    name: ClassVar[str] = "belief-rivals"

    def __init__(
        self,
        problem: SearchProblem,
        arrivals_per_hour: float | None = None,
        budget_ms: float = 1.0,
        day: bool = True,
        most_vertices: int = MOST_VERTICES,
        explore: float = 0.0,
    ) -> None:
        super().__init__(problem, budget_ms, day, most_vertices, explore)
        if arrivals_per_hour is None:
            rates = RATES
        elif 0.0 <= arrivals_per_hour < math.inf:
            rates = {float(arrivals_per_hour): 1.0}
        else:
            raise InputError(f"arrivals_per_hour is {arrivals_per_hour}, want a finite number of at least 0")
        self.arrivals_per_hour = arrivals_per_hour
        self._per_s = np.array(list(rates)) / 3600.0
        self._rate_weight = np.array(list(rates.values()))
        lot = self.problem.lot
        drive_m = dijkstra(lot.drive_matrix(), indices=np.unique(lot.entry_vertices), min_only=True)
        rival_s = drive_m[: lot.n_slots] / self.problem.v_drive + self.problem.arrival_cost_s
        self._order = np.argsort(rival_s, kind="stable")

    def _day_belief(self, near: Neighborhood, belief: SlotBelief) -> DayBelief:
        forecast, decay_rate = belief.forecast.astype(np.float64), belief.decay_rate.astype(np.float64)
        taken_per_s = [
            _take_rates(1.0 - forecast, decay_rate * (1.0 - forecast), self._order, per_s, PASSED)
            for per_s in self._per_s
        ]
        rivals = RivalRates(np.array(taken_per_s)[:, near.slots], self._rate_weight)
        return DayBelief(belief.take(near.slots), self._nearness[near.slots], not self._day, rivals)


@compiled(error_model="numpy")
def _take_rates(
    p_free: FloatArray, leaving: FloatArray, order: NDArray[np.int64], per_s: float, passed: float
) -> FloatArray:
    """Return the rates at which rivals take each slot while it is free, (n_slots,) 1/s.

    The rates are those of the equilibrium in which a slot becomes free at the forecast rate: then rivals find parking
    at the rate at which they arrive, unless the lot is full.

    Args:
        p_free: (n_slots,) forecast.
        leaving: (n_slots,) 1/s, rate at which a taken slot becomes free; where it is 0, nothing changes.
        order: (n_slots,) slots, best first.
        per_s: rivals per second.
        passed: mean number of free slots that a rival passes.
    """
    rates, n_better = np.zeros(len(p_free)), 0.0
    for s in order:
        if leaving[s] > 0.0:
            rates[s] = per_s * math.exp(-n_better / passed) / passed
            n_better += p_free[s] / (1.0 + rates[s] * p_free[s] / leaving[s])
        else:
            n_better += p_free[s]
    return rates
