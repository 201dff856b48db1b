"""Planners and heuristic baselines: from the belief about a lot's slots to an action.

They know the lot and the belief. Only the oracle knows the hidden occupancy. Each name is loaded on first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from planners.agent import Agent, SearchAgent, make_agent
    from planners.names import AGENT_NAMES
    from planners.thesis.label_setting import label_setting
    from planners.thesis.mdp import CirclingWarning, ParkingMDP
    from planners.thesis.policy_iteration import Solution, policy_iteration

_MODULES = {
    "AGENT_NAMES": "names", "Agent": "agent", "CirclingWarning": "thesis.mdp", "ParkingMDP": "thesis.mdp",
    "SearchAgent": "agent", "Solution": "thesis.policy_iteration", "label_setting": "thesis.label_setting",
    "make_agent": "agent", "policy_iteration": "thesis.policy_iteration",
}  # fmt: skip
__all__ = [
    "AGENT_NAMES", "Agent", "CirclingWarning", "ParkingMDP", "SearchAgent", "Solution", "label_setting", "make_agent",
    "policy_iteration",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(import_module(f"planners.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
