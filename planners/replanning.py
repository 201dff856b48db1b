"""The thesis's agents: plan by the MDP, look, update, plan again (T §3.4.4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from parkenv.scenario import SearchProblem
from planners.agent import Observation, SearchAgent
from planners.mdp import ParkingMDP
from planners.policy_iteration import Solution, policy_iteration

RELEVANT_CHANGE = 0.01
"""A probability that moved less than this since the last plan is the same one, grown a little older."""


@dataclass
class Plan:
    """What a planning agent remembers.

    Attributes:
        policy: (n_vertices,) int64, the action for each vertex.
        p_occupied: (n_slots,) float32, the belief that it was made for.
        replans: how often it has been made anew since the episode began.
    """

    policy: NDArray[np.int64]
    p_occupied: NDArray[np.float32]
    replans: int = 0


class StaticAgent(SearchAgent[Plan]):
    """`mdp-static`: plans once on the forecast and follows that plan, whatever it sees.

    Where its slot turns out taken it tries again, since in the thesis's model the next try is as likely
    to succeed as the first; T §3.4.4 introduces re-planning for that reason.

    Args:
        problem: lot, goal, speeds and costs.
        failure_s: cost of a failed try as the planner weighs it, s; the problem's own where None.
        gamma: discount a decision.
    """

    name: ClassVar[str] = "mdp-static"

    def __init__(self, problem: SearchProblem, failure_s: float | None = None, gamma: float = 0.9999) -> None:
        super().__init__(problem)
        self.failure_s = problem.failure_s if failure_s is None else failure_s
        self.gamma = gamma

    def solve(self, p_occupied: NDArray[np.floating], policy: NDArray[np.int64] | None = None) -> Solution:
        """The optimal policy for a belief, (n_slots,), found from `policy` on where one is given."""
        mdp = ParkingMDP.from_belief(self.problem, p_occupied, failure_s=self.failure_s, gamma=self.gamma)
        solution = policy_iteration(mdp, policy)
        mdp.check_discount(solution.values)
        return solution

    def expected_time(self, p_occupied: NDArray[np.floating]) -> NDArray[np.float64]:
        """What the model expects a search from each vertex to take, (n_vertices,) s."""
        mdp = ParkingMDP.from_belief(self.problem, p_occupied, failure_s=self.failure_s, gamma=self.gamma)
        return mdp.expected_time(policy_iteration(mdp).values)

    def begin(self, observation: Observation) -> Plan:
        """Plan on the forecast."""
        p_occupied = np.array(observation["p_occupied"])
        return Plan(self.solve(p_occupied).policy, p_occupied)

    def decide(self, observation: Observation, memory: Plan) -> int:
        """What the plan says for this vertex."""
        return int(memory.policy[observation["vertex"]])


class ReplanningAgent(StaticAgent):
    """`mdp`: the thesis's planner. It plans again after every sighting that changes a probability.

    A change counts from `RELEVANT_CHANGE` on, or where a look makes a slot certain; ageing that adds up to as
    much counts, too.

    It goes on until it has parked or the environment declares the lot proven full. Where nothing that it
    can reach may be free, the model's best is to wait, and so does the agent.
    """

    name: ClassVar[str] = "mdp"

    def decide(self, observation: Observation, memory: Plan) -> int:
        """Plan again if the belief has changed, starting from the last plan; then follow the plan."""
        p_occupied = observation["p_occupied"]
        moved = np.abs(p_occupied - memory.p_occupied)
        # A look that settles a slot counts however likely it was: else a nearly hopeless slot, found
        # taken, would go on being tried.
        settled = (moved > 0.0) & ((p_occupied == 0.0) | (p_occupied == 1.0))
        if moved.max() > RELEVANT_CHANGE or settled.any():
            memory.policy = self.solve(p_occupied, memory.policy).policy
            memory.p_occupied = np.array(p_occupied)
            memory.replans += 1
        return int(memory.policy[observation["vertex"]])
