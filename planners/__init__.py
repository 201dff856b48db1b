"""Planners and heuristic baselines: from the belief about a lot's slots to an action.

They know the lot and the belief. Only the oracle knows the hidden occupancy.
"""

from planners.agent import AGENT_NAMES, Agent, SearchAgent, make_agent
from planners.thesis.label_setting import label_setting
from planners.thesis.mdp import CirclingWarning, ParkingMDP
from planners.thesis.policy_iteration import Solution, policy_iteration
from planners.thesis.value_iteration import value_iteration

__all__ = [
    "AGENT_NAMES",
    "Agent",
    "CirclingWarning",
    "ParkingMDP",
    "SearchAgent",
    "Solution",
    "label_setting",
    "make_agent",
    "policy_iteration",
    "value_iteration",
]
