"""Where an agent means to drive, read off what it remembers, for pictures."""

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
"""Vertices ahead that a plan is followed."""
FORESEEN_S = 60.0
"""s ahead that the plan of `belief` is followed."""


class Intentions:
    """Reads plans.

    What a plan is differs: planners after the thesis have a policy, which is followed to the slot that it says to park
    in; strategies and the oracle drive to a slot; `belief` drives a path as long as all that it comes to see is taken,
    so it is asked where it would go if that were so. Others have no plan that could be shown.

    Args:
        problem: what the agent plans on.
        agent: any.
    """

    def __init__(self, problem: SearchProblem, agent: Any) -> None:
        self._problem, self._agent = problem, agent
        self._routes = DriveRoutes(problem)

    def ahead(self, observation: Observation, vertex: int, action: int, memory: Any) -> list[int]:
        """The vertices that the agent means to come to after this one, in order; none where it has no plan.

        Args:
            observation: that it has just decided on.
            vertex: where it is.
            action: what it decided.
            memory: what it remembers.
        """
        if action == PARK:
            return []
        if isinstance(memory, Search):
            return self._while_all_is_taken(observation, vertex, action, memory)
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

    def _while_all_is_taken(
        self, observation: Observation, vertex: int, action: int, memory: Search
    ) -> list[int]:
        assert isinstance(self._agent, BeliefAgent)
        # What is known of the lot does not change; what is remembered of the search does.
        imagined = copy.deepcopy(memory, {id(memory.near): memory.near})
        problem, path, passed = self._problem, [], {vertex}
        p, time = np.array(observation["p_occupied"]), np.array(observation["time"])
        starts, slots = problem.slots_in_view
        begun = float(time[1])
        while action != PARK:
            following = int(problem.lot.neighbors[vertex, action])
            if following < 0 or following in passed or time[1] - begun > FORESEEN_S:
                break
            time = time + problem.move_s[vertex, action]
            vertex = following
            passed.add(vertex)
            path.append(vertex)
            shown = slots[starts[vertex] : starts[vertex + 1]]
            # Slots that it knows to be free stay so.
            p[shown[p[shown] >= imagined.forecast[shown]]] = 1.0
            action = self._agent.decide({"vertex": vertex, "time": time, "p_occupied": p}, imagined)
        return path
