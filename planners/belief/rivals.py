"""`belief-rivals`: the planner in belief space, in a lot that other searching cars fill.

Rivals arrive at a rate that is known, or follows from the forecast. Each passes the free slots in the order of the
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

from parkenv.belief.slot_belief import SlotBelief
from parkenv.compiled.arrays import FloatArray
from parkenv.compiled.jit import compiled
from parkenv.errors import InputError
from parkenv.world.scenario import SearchProblem
from planners.belief.agent import BeliefAgent
from planners.neighborhood import MOST_VERTICES

PASSED = 3.0
"""Mean number of free slots that a rival passes, or drives on from to the next, before it takes one."""
CROWD = 2.5
"""Expected rate of rivals as a multiple of the usual rate of arrivals, where it is not known.

Underestimating rivals costs more than overestimating them: with too few, the car heads for the best slots with
everyone else and circles there; with too many, it stops early and the driver walks a little further.
"""


class BeliefRivalsAgent(BeliefAgent):
    """`belief-rivals`: `belief`, which expects that rivals take free slots, the best ones first.

    Where the rate of rivals is not known, it is taken to be `CROWD` times the rate at which cars usually arrive. In the
    long run that is the rate at which cars leave (Little's law), which follows from the forecast and its decay rates.
    It is not learned from the slots that are observed: those near the entry are free however many rivals want the best
    ones, and would soon prove that there are none. In a lot whose slots never change, according to the forecast, nobody
    arrives, and the agent is `belief`.

    Args:
        problem: lot, goal, speeds and costs.
        arrivals_per_hour: rivals an hour; None: not known, see above. With 0 the agent is `belief`, action for action.
        budget_ms: see `belief`.
        day: see `belief`.
        most_vertices: see `belief`.
        explore: see `belief`.

    Raises:
        InputError: see `belief`; `arrivals_per_hour` is negative or not finite.
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
        if arrivals_per_hour is not None and not 0.0 <= arrivals_per_hour < math.inf:
            raise InputError(f"arrivals_per_hour is {arrivals_per_hour}, want a finite number of at least 0")
        self.arrivals_per_hour = arrivals_per_hour
        lot = self.problem.lot
        drive_m = dijkstra(lot.drive_matrix(timed=True), indices=np.unique(lot.entry_vertices), min_only=True)
        rival_s = drive_m[: lot.n_slots] / self.problem.v_drive + self.problem.finite_cost_s
        self._order = np.argsort(rival_s, kind="stable")

    def _rival_rates(self, belief: SlotBelief) -> FloatArray:
        forecast = belief.forecast.astype(np.float64)
        leaving = belief.decay_rate.astype(np.float64) * (1.0 - forecast)
        per_s = CROWD * usual_arrivals(forecast, leaving)
        if self.arrivals_per_hour is not None:
            per_s = self.arrivals_per_hour / 3600.0
        return np.asarray(_take_rates(1.0 - forecast, leaving, self._order, per_s, PASSED))


def usual_arrivals(forecast: FloatArray, leaving: FloatArray) -> float:
    """Return how many cars per second arrive at a lot in the long run: as many as leave it (Little's law).

    Args:
        forecast: (n_slots,) P(taken).
        leaving: (n_slots,) 1/s, rate at which a taken slot becomes free.
    """
    return float(leaving @ forecast)


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
