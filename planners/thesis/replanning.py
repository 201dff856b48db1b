"""The thesis's agents: plan with the MDP, observe, update the belief, replan (T §3.4.4)."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from parkenv.belief.day_belief import DayBelief
from parkenv.belief.slot_belief import SlotBelief
from parkenv.compiled.jit import compiled
from parkenv.errors import require, require_one_of
from parkenv.world.lot import PARK
from parkenv.world.occupancy.day_error import nearness
from parkenv.world.scenario import SearchProblem
from planners.agent import Observation, SearchAgent
from planners.thesis.label_setting import (
    Labels,
    StoppingGraph,
    best_move,
    best_moves,
    by_policy_iteration,
    repair,
    set_labels,
)
from planners.thesis.mdp import ParkingMDP

RELEVANT_CHANGE = 0.01  # replan once a probability differs by more than this from that of the plan
# How plans are made: exactly in near-linear time, or as in the thesis. They lead to the same actions.
SOLVERS = ("label_setting", "policy_iteration")
MOST_HOPS = 400  # maximum number of vertices of a plan preview


@dataclass
class Plan:
    graph: StoppingGraph  # the stopping problem
    labels: Labels  # cost and move of each vertex, and the probabilities of the plan
    day: DayBelief | None = None  # belief about the day, for an agent that learns it
    replans: int = 0  # number of times that the agent has replanned in this episode

    @property
    def policy(self) -> NDArray[np.int64]:
        """The action for each vertex, (n_vertices,) int64; computed when it is read."""
        moves: NDArray[np.int64] = best_moves(self.graph, self.labels.p_free, self.labels.cost)
        return moves


class StaticAgent(SearchAgent[Plan]):
    """`mdp-static`: plans once with the forecast and follows that plan, whatever it observes.

    If its slot turns out to be taken, it repeats the attempt, since in the thesis's model the next one is as likely to
    succeed as the first; T §3.4.4 introduces replanning for that reason.

    Args:
        problem: lot, goal, speeds and costs.
        failure_s: s, the planner's cost of a failed attempt; a high cost makes it cautious. None: the actual cost
            (`problem.failure_s`).
        gamma: discount per decision. None: 0.9999, or more where edges are short (`discount`).
        solver: one of `SOLVERS`.
    """

    name: ClassVar[str] = "mdp-static"

    def __init__(
        self,
        problem: SearchProblem,
        failure_s: float | None = None,
        gamma: float | None = None,
        solver: str = "label_setting",
    ) -> None:
        super().__init__(problem)
        require_one_of("solver", solver, SOLVERS)
        require(
            solver != "policy_iteration" or gamma != 1.0,
            f"gamma is {gamma}, want below 1 for the solver policy_iteration",
        )
        self.failure_s = problem.failure_s if failure_s is None else failure_s
        self.solver = solver
        nothing_free = np.ones(problem.lot.n_slots)
        self._mdp = ParkingMDP.from_belief(self.problem, nothing_free, failure_s=self.failure_s, gamma=gamma)
        self.gamma = gamma = self._mdp.gamma
        self._graph = StoppingGraph.of(self._mdp)
        least_s = min(float(self._graph.in_s.min(initial=np.inf)), problem.wait_s, self.failure_s)
        self._suspect_s = least_s / (1.0 - gamma) if gamma < 1.0 else np.inf

    def solve(self, p_occupied: NDArray[np.floating]) -> Labels:
        """Make the optimal plan for a belief, (n_slots,) P(taken)."""
        p_free = np.zeros(self._mdp.n_states)
        np.subtract(1.0, p_occupied, out=p_free[: len(p_occupied)], dtype=np.float64)
        if self.solver == "policy_iteration":
            labels, _ = by_policy_iteration(replace(self._mdp, p_free=p_free))
        else:
            labels = self._solved(set_labels(self._graph, p_free))
        self._check_discount(labels, float(labels.cost.max()))
        return labels

    def expected_time(self, p_occupied: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the expected time, (n_vertices,) s, of a search from each vertex according to the model."""
        return self._mdp.expected_time(-self.solve(p_occupied).cost)

    def begin(self, observation: Observation, belief: SlotBelief) -> Plan:
        return Plan(self._graph, self.solve(belief.p_occupied))

    def decide(self, observation: Observation, belief: SlotBelief, memory: Plan) -> int:
        labels = memory.labels
        return int(best_move(self._graph, labels.p_free, labels.cost, int(observation["vertex"])))

    def plan_preview(self, observation: Observation, action: int, memory: Plan) -> tuple[int, ...]:
        labels, vertex = memory.labels, int(observation["vertex"])
        path: list[int] = []
        while len(path) < MOST_HOPS and action != PARK:
            vertex = int(self.problem.lot.neighbors[vertex, action])
            if vertex < 0 or vertex in path or vertex == observation["vertex"]:
                break
            path.append(vertex)
            action = best_move(self._graph, labels.p_free, labels.cost, vertex)
        return tuple(path)

    def _solved(self, labels: Labels) -> Labels:
        """Return the plan; solve it by policy iteration if label setting did not terminate because circling pays."""
        if labels.settled:
            return labels
        return by_policy_iteration(replace(self._mdp, p_free=labels.p_free), labels)[0]

    def _check_discount(self, labels: Labels, cost_s: float) -> None:
        if cost_s >= self._suspect_s:
            replace(self._mdp, p_free=labels.p_free).check_discount(-labels.cost)


class ReplanningAgent(StaticAgent):
    """`mdp`: the thesis's planner. It replans after every observation that changes a probability.

    A change is relevant from `RELEVANT_CHANGE` on, or if an observation makes a slot certain; accumulated decay counts
    as well. The plan is repaired where it is affected, not made from scratch.

    It searches until it has parked or the lot is proven full. If no reachable slot can be free, waiting is optimal in
    the model, and the agent waits.

    Args:
        problem: lot, goal, speeds and costs.
        failure_s: s, the planner's cost of a failed attempt. None: the actual cost (`problem.failure_s`).
        gamma: discount per decision. None: 0.9999, or more where edges are short (`discount`).
        solver: one of `SOLVERS`.
        day: whether to plan with the belief of `belief`: the observations of some slots tell how the day differs from
            its forecast, and so change P(taken) of the others (`DayBelief`).
    """

    name: ClassVar[str] = "mdp"

    def __init__(
        self,
        problem: SearchProblem,
        failure_s: float | None = None,
        gamma: float | None = None,
        solver: str = "label_setting",
        day: bool = False,
    ) -> None:
        super().__init__(problem, failure_s, gamma, solver)
        self._nearness = nearness(self.problem.walk_s) if day else None

    def begin(self, observation: Observation, belief: SlotBelief) -> Plan:
        plan = super().begin(observation, belief)
        if self._nearness is not None:
            plan.day = DayBelief(belief, self._nearness)
        return plan

    def decide(self, observation: Observation, belief: SlotBelief, memory: Plan) -> int:
        labels, p_occupied = memory.labels, belief.p_occupied
        if memory.day is not None:
            memory.day.update(belief.observations)
            p_occupied = memory.day.p_occupied(belief.time)
        slots, p_free = _changed_slots(p_occupied, labels.p_free, RELEVANT_CHANGE)
        if len(slots):
            if self.solver == "policy_iteration":
                labels.p_free[slots] = p_free
                labels, _ = by_policy_iteration(replace(self._mdp, p_free=labels.p_free), labels)
            else:
                repair(self._graph, labels, slots, p_free)
                labels = self._solved(labels)
            memory.labels = labels
            memory.replans += 1
            self._check_discount(labels, float(labels.cost[observation["vertex"]]))
        return super().decide(observation, belief, memory)


# Slots compared at a time: a plain loop that finds most blocks unchanged is bound by memory alone.
_BLOCK = 1024


@compiled
def _changed_slots(
    p_occupied: NDArray[np.floating], planned: NDArray[np.float64], relevant: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the slots whose probability differs from the plan, and their P(free), if any is relevant; else none.

    What makes a slot certain is always relevant: else the agent would keep attempting one that it has found taken.
    """
    n = len(p_occupied)
    blocks, n_blocks, n_changed = np.empty(n // _BLOCK + 1, dtype=np.int64), 0, 0
    for start in range(0, n, _BLOCK):
        now, before, n_here = p_occupied[start : start + _BLOCK], planned[start : start + _BLOCK], 0
        for k in range(len(now)):
            n_here += 1.0 - np.float64(now[k]) != before[k]
        if n_here:
            blocks[n_blocks] = start
            n_blocks, n_changed = n_blocks + 1, n_changed + n_here
    slots, p_free = np.empty(n_changed, dtype=np.int64), np.empty(n_changed)
    relevant_change, i = False, 0
    for start in blocks[:n_blocks]:
        for s in range(start, min(start + _BLOCK, n)):
            p = 1.0 - np.float64(p_occupied[s])
            if p != planned[s]:
                slots[i], p_free[i] = s, p
                relevant_change |= abs(p - planned[s]) > relevant or p == 0.0 or p == 1.0
                i += 1
    return (slots, p_free) if relevant_change else (slots[:0], p_free[:0])
