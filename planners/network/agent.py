"""`network`: an agent that scores the actions at hand with one small network, the same on every lot."""

import os
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.slot_belief import OBSERVED_FREE, UNOBSERVED, SlotBelief
from parkenv.compiled.arrays import FloatArray
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation
from planners.belief.agent import BeliefAgent, BeliefSearch, snapshot
from planners.belief.planning_graph import MOST_HYPOTHESES, BeliefSnapshot
from planners.neighborhood import MOST_VERTICES
from planners.network.features import (
    ACTION_COUNT,
    FAILURE_COSTS,
    PARKING,
    WAITING,
    Features,
    Situation,
    observe,
)
from planners.network.lookahead import Decision, Scratch
from planners.network.policy import SHIPPED, NetworkPolicy

# Penalty of an action, in time scales, for each visit of its end since something new was observed.
CIRCLING = 0.1

# Expected number of free slots among those that were not observed, below which `belief` drives.
HARDLY_ANY = 0.1


@dataclass
class NetworkSearch(BeliefSearch):
    previous: int = -1  # the vertex before, in the lot
    n_known: int = 0  # slots that were observed at the last decision

    def __post_init__(self) -> None:
        n = len(self.near.vertices)
        # (n_vertices,) float64, s since the search began, the last visit of each vertex of the part; -1 without one
        self.visited_at = np.full(n, -1.0)
        self.visits = np.zeros(n)  # number of visits since something new was observed
        self.by_cost = np.argsort(self.near.cost_s, kind="stable")  # slots by arrival cost
        self.scratch = Scratch.of(self.near.n_slots, MOST_HYPOTHESES)

    def copy(self) -> Self:
        other = super().copy()
        other.visited_at, other.visits = self.visited_at.copy(), self.visits.copy()
        return other


class NetworkAgent(BeliefAgent):
    """`network`: takes the action with the best score of a small neural network.

    **Observation.** For each available action (a move along an edge, parking, waiting): the expected time of a quick
    look-ahead (`planners.network.lookahead`), what comes into view, whether the car turns back; and tokens of the
    most relevant slots as reached by that action: belief, age of the observation, drive, arrival cost
    (`planners.network.features`). The belief is that of `belief` without doubt of single slots: it learns from
    observations how the day differs from its forecast.

    **Network.** The tokens of an action are pooled by attention; each action then sees the mean and the maximum over
    all actions. The score of an action is the network's output minus the time that the look-ahead expects. Times are
    relative, there are no coordinates, and actions have no order: the same weights serve lots of ten or two thousand
    slots, and turning the map changes nothing.

    **Limits.** It knows slots beyond the eight best ones only through the look-ahead. In a full lot it would drive in
    circles, or observe the last slot and so prove the lot full: where hardly any free slot is expected, `belief`
    drives. The network gives no reasons for its decisions.

    Args:
        problem: lot, goal, speeds and costs.
        weights: a file of weights, or its content; by default the packaged weights.
        most_vertices: a larger lot is searched in parts (`Neighborhoods`).

    Raises:
        InputError: the file is not a network, `most_vertices` is out of range, or no slot can be observed.
    """

    name: ClassVar[str] = "network"
    memory: ClassVar = NetworkSearch

    def __init__(
        self,
        problem: SearchProblem,
        weights: str | os.PathLike[str] | NetworkPolicy = SHIPPED,
        most_vertices: int = MOST_VERTICES,
    ) -> None:
        super().__init__(problem, most_vertices=most_vertices, doubt=0.0)  # as in its training
        self.policy = weights if isinstance(weights, NetworkPolicy) else NetworkPolicy.load(weights)
        self._failure_costs = np.array(FAILURE_COSTS)
        self._features = Features.empty()
        self.last_features: Features | None = None  # of the last decision; None if it needed none
        self.last_scores: NDArray[np.float64] | None = None  # (6,) of that decision
        # Copies: the lot's arrays are read-only, for which numba would compile every function again.
        self._neighbors, self._move_s = self.problem.lot.neighbors.copy(), self.problem.move_cost_s.copy()

    def decide(self, observation: Observation, belief: SlotBelief, memory: BeliefSearch) -> int:
        self.last_features = self.last_scores = None
        return super().decide(observation, belief, memory)

    def _follow_best_path(
        self, vertex: int, here: int, known: SlotBelief, memory: BeliefSearch
    ) -> int | None:
        assert isinstance(memory, NetworkSearch)
        belief, state = snapshot(here, known, memory), memory.state
        unobserved = belief.slots["p_free"][state == UNOBSERVED]
        if memory.near.whole and not (state == OBSERVED_FREE).any() and unobserved.sum() < HARDLY_ANY:
            memory.previous = vertex
            return super()._follow_best_path(vertex, here, known, memory)
        self.last_features = self._observed(vertex, here, known, belief, memory)
        self.last_scores = self.policy.scores(self.last_features) - self._circling(vertex, here, memory)
        memory.visited_at[here] = memory.time
        memory.visits[here] += 1.0
        memory.previous = vertex
        choice = int(np.argmax(self.last_scores))
        return self.wait(vertex) if choice == WAITING else choice

    def _observed(
        self, vertex: int, here: int, known: SlotBelief, belief: BeliefSnapshot, memory: NetworkSearch
    ) -> Features:
        """Return the network's observation; the next call overwrites it."""
        near, out = memory.near, self._features
        following = np.array(
            [near.index(end) if end >= 0 else -1 for end in self._neighbors[vertex].tolist()]
        )
        waits = (self._neighbors[vertex] < 0).any()
        now = Situation(
            here,
            near.index(memory.previous) if memory.previous >= 0 else -1,
            following,
            self._move_s[vertex],
            self.problem.wait_s if waits else np.inf,
            self.problem.failure_s,
            known.time,
            memory.visited_at,
            known.forecast.astype(np.float64),
            known.observed_at.astype(np.float64),
        )
        graph, nothing = self._planning_graph(memory), np.empty(0, np.int64)
        decision = Decision(memory.by_cost, nothing, np.inf, graph, belief, memory.scratch)
        observe(now, self._failure_costs, decision, out)
        return out

    def _circling(self, vertex: int, here: int, memory: NetworkSearch) -> FloatArray:
        """Return a penalty of each action, (6,), for visits of its end since something new was observed."""
        n_known = int((memory.state != UNOBSERVED).sum())
        if n_known != memory.n_known:
            memory.visits[:] = 0.0
            memory.n_known = n_known
        cost = np.zeros(ACTION_COUNT)
        for a, end in enumerate(self._neighbors[vertex].tolist()):
            if end >= 0 and (i := memory.near.index(end)) >= 0:
                cost[a] = CIRCLING * memory.visits[i]
        cost[[PARKING, WAITING]] = CIRCLING * memory.visits[here]
        return cost
