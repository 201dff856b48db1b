"""What an agent's search takes on average, exactly: every sighting that can come about, weighed by its chance."""

from __future__ import annotations

import copy
import itertools
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from parkenv.errors import InputError
from parkenv.world.lot import PARK
from parkenv.world.scenario import SearchProblem
from planners.agent import Agent

MOST_STEPS = 2000
"""Decisions after which a search is cut off and charged `give_up_s`, as comparisons do."""


def expected_time(agent: Agent, problem: SearchProblem, p_occupied: ArrayLike, vertex: int) -> float:
    """Mean total time, s, of an agent's search where slots last and the forecast is right.

    The rules are those of `parkenv/Search-v1` in a world in which each slot is taken with its probability,
    independently of the others, and nothing changes. The agent decides in every history of sightings that it can
    bring about, so this is for lots of about a dozen slots.

    Args:
        agent: whose memory can be copied.
        problem: lot, goal, speeds, costs and view range; slots are seen without error.
        p_occupied: (n_slots,) the forecast.
        vertex: where the search begins.

    Raises:
        InputError: looks that may err, or a forecast that is not one.

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
        raise InputError(f"p_occupied: want {n} probabilities, got shape {p.shape}")
    if not problem.sensor_model.perfect:
        raise InputError("expected_time wants slots that are seen without error")
    return _Histories(agent, problem, p).mean(vertex, np.zeros(n, np.bool_), p, 0.0, 0, None)


class _Histories:
    """The tree of what an agent can see."""

    def __init__(self, agent: Agent, problem: SearchProblem, forecast: NDArray[np.float64]) -> None:
        self.agent, self.problem, self.forecast = agent, problem, forecast
        self.masks = problem.action_masks

    def mean(
        self,
        vertex: int,
        seen: NDArray[np.bool_],
        p: NDArray[np.float64],
        elapsed: float,
        steps: int,
        memory: Any,
    ) -> float:
        """Expected s from here; the memory is this history's own."""
        problem = self.problem
        spent = 0.0
        while True:
            if steps >= MOST_STEPS:
                return spent + problem.give_up_s
            action, memory = self.agent.predict(self._observation(vertex, p, elapsed + spent), memory)
            chosen = int(action)
            steps += 1
            if chosen == PARK and vertex < problem.lot.n_slots:
                free = 1.0 - p[vertex]
                parked = free * (spent + problem.walk_s[vertex])
                if free == 1.0:
                    return float(parked)
                spent += problem.failure_s
                after = p.copy()
                after[vertex] = 1.0
                failed = seen.copy()
                failed[vertex] = True
                rest = self._looked(vertex, failed, after, elapsed + spent, steps, memory)
                return float(parked + (1.0 - free) * (spent + rest))
            if not self.masks[vertex, chosen]:
                spent += problem.wait_s
            else:
                spent += float(problem.move_s[vertex, chosen])
                vertex = int(problem.lot.neighbors[vertex, chosen])
            if not seen[self._in_view(vertex)].all():
                return spent + self._looked(vertex, seen, p, elapsed + spent, steps, memory)

    def _looked(
        self,
        vertex: int,
        seen: NDArray[np.bool_],
        p: NDArray[np.float64],
        elapsed: float,
        steps: int,
        memory: Any,
    ) -> float:
        """Expected s once the car has looked from a vertex."""
        in_view = self._in_view(vertex)
        new = in_view[~seen[in_view]]
        now_seen = seen.copy()
        now_seen[new] = True
        total = 0.0
        for outcome in itertools.product((0.0, 1.0), repeat=len(new)):
            taken = np.array(outcome)
            chance = float(np.prod(np.where(taken == 1.0, p[new], 1.0 - p[new])))
            if chance == 0.0:
                continue
            after = p.copy()
            after[new] = taken
            if now_seen.all() and (after == 1.0).all():
                total += chance * self.problem.give_up_s
            else:
                own = copy.deepcopy(memory)
                total += chance * self.mean(vertex, now_seen, after, elapsed, steps, own)
        return total

    def _in_view(self, vertex: int) -> NDArray[np.int64]:
        starts, slots = self.problem.slots_in_view
        return slots[starts[vertex] : starts[vertex + 1]]

    def _observation(self, vertex: int, p: NDArray[np.float64], elapsed: float) -> dict[str, Any]:
        return {
            "vertex": np.int64(vertex),
            "time": np.array([elapsed, elapsed], dtype=np.float32),
            "p_occupied": p.astype(np.float32),
            "action_mask": self.masks[vertex].copy(),
        }
