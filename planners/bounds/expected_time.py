"""The exact expected time of an agent's search, over all possible observations."""

from __future__ import annotations

import copy
import itertools
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from parkenv.belief.slot_belief import SlotBelief
from parkenv.compiled.arrays import FloatArray
from parkenv.errors import InputError
from parkenv.world.lot import PARK
from parkenv.world.occupancy.day_error import EXACT, DayError
from parkenv.world.scenario import SearchProblem
from planners.agent import Agent
from planners.bounds.days import Days

MOST_STEPS = 2000  # decisions after which a search is truncated at a cost of `give_up_s`, as in comparisons


def expected_time(
    agent: Agent, problem: SearchProblem, p_occupied: ArrayLike, vertex: int, day_error: DayError = EXACT
) -> float:
    """Return the mean total time, s, of an agent's search where slots do not change and days differ as forecast.

    The rules are those of `parkenv/Search-v2`. Given the day, each slot is taken with a probability of its own,
    independently of the others, and does not change. Every possible history of observations is enumerated, so lots can
    have about a dozen slots.

    Args:
        agent: an agent whose memory can be copied.
        problem: lot, goal, speeds, costs and view range; the sensor must not err.
        p_occupied: (n_slots,) the forecast.
        vertex: where the search begins.
        day_error: how far days differ from the forecast.

    Raises:
        InputError: a sensor that errs, or an invalid forecast.

    Examples:
        >>> from parkenv.lots import packaged_lot
        >>> from planners import make_agent
        >>> from planners.bounds.exact import ExactSolution
        >>> problem = SearchProblem(lot=packaged_lot("mini"), give_up_s=300.0)
        >>> entry, forecast = int(problem.lot.entry_vertices[0]), np.full(10, 0.7)
        >>> best = ExactSolution(problem, forecast, entry).expected_s
        >>> theirs = expected_time(make_agent("greedy-goal", problem), problem, forecast, entry)
        >>> bool(best < theirs < 2.0 * best)
        True
    """
    n = problem.lot.n_slots
    p = np.asarray(p_occupied, dtype=np.float64)
    if p.shape != (n,) or not ((p >= 0.0) & (p <= 1.0)).all():
        raise InputError(f"p_occupied has shape {p.shape}, want {n} probabilities")
    if not problem.sensor_model.perfect:
        raise InputError("expected_time requires a sensor model without errors")
    days = Days.of(p, problem.walk_s, day_error)
    belief = SlotBelief.of_forecast(p, np.zeros(n), (day_error.level, day_error.slope))
    return _Histories(agent, problem, days.p_free).mean(vertex, belief, days.chance, 0, None)


class _Histories:
    """The tree of all histories of observations."""

    def __init__(self, agent: Agent, problem: SearchProblem, p_free: FloatArray) -> None:
        self.agent, self.problem, self.p_free = agent, problem, p_free
        self.masks = problem.action_masks

    def mean(self, vertex: int, belief: SlotBelief, day: FloatArray, steps: int, memory: Any) -> float:
        """Return the expected time, s, from here.

        Args:
            vertex: where the car is.
            belief: the agent's belief, with the time.
            day: (k,) float64, probability of each day after this history.
            steps: decisions so far.
            memory: the agent's memory of this history.
        """
        problem, begun = self.problem, belief.time
        while True:
            if steps >= MOST_STEPS:
                return belief.time - begun + problem.give_up_s
            action, memory = self.agent.predict(self._observation(vertex, belief), memory)
            chosen = int(action)
            steps += 1
            if chosen == PARK and vertex < problem.lot.n_slots:
                known = belief.observed[vertex]
                p_free = float(belief.observed_free[vertex]) if known else float(day @ self.p_free[vertex])
                parked_s = belief.time - begun + problem.arrival_cost_s[vertex]
                if p_free == 1.0:
                    return float(parked_s)
                failed = belief.decay(problem.failure_s).update([vertex], [True])
                then = day if known else day * (1.0 - self.p_free[vertex]) / (1.0 - p_free)
                failed_s = failed.time - begun + self._observe(vertex, failed, then, steps, memory)
                return float(p_free * parked_s + (1.0 - p_free) * failed_s)
            if not self.masks[vertex, chosen]:
                belief = belief.decay(problem.wait_s)
            else:
                belief = belief.decay(float(problem.move_s[vertex, chosen]))
                vertex = int(problem.lot.neighbors[vertex, chosen])
            if not belief.observed[self.problem.in_view(vertex)].all():
                return belief.time - begun + self._observe(vertex, belief, day, steps, memory)

    def _observe(self, vertex: int, belief: SlotBelief, day: FloatArray, steps: int, memory: Any) -> float:
        """Return the expected time, s, from the moment of an observation at a vertex."""
        in_view = self.problem.in_view(vertex)
        new = in_view[~belief.observed[in_view]]
        total = 0.0
        for outcome in itertools.product((False, True), repeat=len(new)):
            taken = np.array(outcome, dtype=np.bool_)
            then = day * np.where(taken[:, None], 1.0 - self.p_free[new], self.p_free[new]).prod(axis=0)
            chance = float(then.sum())
            if chance == 0.0:
                continue
            after = belief.update(new, taken)
            if after.observed_taken.all():
                total += chance * self.problem.give_up_s
            else:
                total += chance * self.mean(vertex, after, then / chance, steps, copy.deepcopy(memory))
        return total

    def _observation(self, vertex: int, belief: SlotBelief) -> dict[str, Any]:
        return {
            "vertex": np.int64(vertex),
            "time": np.array([belief.time, belief.time], dtype=np.float32),
            "action_mask": self.masks[vertex].copy(),
            **belief.to_observation(),
        }
