"""Where an agent intends to drive next, read from its memory, for replays."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from parkenv.world.lot import PARK
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation
from planners.belief.agent import BeliefAgent, Search
from planners.routes import DriveRoutes
from planners.thesis.tuning import TunedPlan

MOST_HOPS = 400
"""Vertices ahead to which a policy is followed."""
HORIZON_S = 60.0
"""s ahead that the plan of `belief` is followed."""


class PlanPreview:
    """Reads an agent's plan.

    Plans differ: the thesis's planners have a policy, which is followed to the slot where it parks; heuristic baselines
    and the oracle drive to a slot; `belief` follows a path while all slots that come into view are taken, so it is
    asked where it would go in that case. Other agents have no plan to show.

    Args:
        problem: the agent's planning problem.
        agent: any agent.
    """

    def __init__(self, problem: SearchProblem, agent: Any) -> None:
        self._problem, self._agent = problem, agent
        self._routes = DriveRoutes(problem)

    def ahead(self, observation: Observation, action: int, memory: Any) -> list[int]:
        """Return the vertices that the agent intends to visit next, in order; none without a plan.

        Args:
            observation: what the agent has just decided on.
            action: what it decided.
            memory: its memory after the decision.
        """
        # A learned agent's local observation names no vertex, and there is no plan behind it.
        if action == PARK or "vertex" not in observation:
            return []
        vertex = int(observation["vertex"])
        if isinstance(memory, Search):
            return self._while_all_are_taken(observation, vertex, action, memory)
        gate = memory.gate if isinstance(memory, TunedPlan) else -1
        target = gate if gate >= 0 else getattr(memory, "target", getattr(memory, "slot", -1))
        policy = getattr(memory, "policy", None)
        if policy is not None and gate < 0:
            return self._along(policy, vertex)
        if isinstance(target, (int, np.integer)) and target >= 0 and self._leads(vertex, int(target)):
            return [v for _, v in self._routes.way(vertex, int(target))]
        return []

    def _along(self, policy: NDArray[np.int64], vertex: int) -> list[int]:
        path: list[int] = []
        passed = {vertex}
        while len(path) < MOST_HOPS and policy[vertex] != PARK:
            vertex = int(self._problem.lot.neighbors[vertex, policy[vertex]])
            if vertex < 0 or vertex in passed:
                break
            passed.add(vertex)
            path.append(vertex)
        return path

    def _leads(self, vertex: int, target: int) -> bool:
        return bool(np.isfinite(self._routes.seconds_from(vertex)[target]))

    def _while_all_are_taken(
        self, observation: Observation, vertex: int, action: int, memory: Search
    ) -> list[int]:
        assert isinstance(self._agent, BeliefAgent)
        # The neighbourhood does not change during a search; the rest of the memory does.
        imagined = copy.deepcopy(memory, {id(memory.near): memory.near})
        problem, path, passed = self._problem, [], {vertex}
        p, time = np.array(observation["p_occupied"]), np.array(observation["time"])
        starts, slots = problem.slots_in_view
        begun = float(time[1])
        while action != PARK:
            following = int(problem.lot.neighbors[vertex, action])
            if following < 0 or following in passed or time[1] - begun > HORIZON_S:
                break
            time = time + problem.move_s[vertex, action]
            vertex = following
            passed.add(vertex)
            path.append(vertex)
            shown = slots[starts[vertex] : starts[vertex + 1]]
            # Slots that were observed free stay free.
            p[shown[p[shown] >= imagined.forecast[shown]]] = 1.0
            action = self._agent.decide({"vertex": vertex, "time": time, "p_occupied": p}, imagined)
        return path
