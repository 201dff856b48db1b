"""Names of the agents that come with the package, without the modules behind them."""

from __future__ import annotations

AGENTS: dict[str, tuple[str, str]] = {
    "mdp": ("planners.thesis.replanning", "ReplanningAgent"),
    "mdp-static": ("planners.thesis.replanning", "StaticAgent"),
    "greedy-goal": ("planners.greedy", "GreedyGoalAgent"),
    "greedy-drive": ("planners.greedy", "GreedyDriveAgent"),
    "first-free": ("planners.greedy", "FirstFreeAgent"),
    "random": ("planners.greedy", "RandomAgent"),
    "oracle": ("planners.bounds.oracle", "OracleAgent"),
    "belief": ("planners.belief.agent", "BeliefAgent"),
    "mdp-tuned": ("planners.thesis.tuning", "TunedAgent"),
    "exact": ("planners.bounds.exact", "ExactAgent"),
}
"""Module and class of each agent; modules are imported when an agent is made."""
SMALL_LOTS_ONLY = ("exact",)
"""Agents for small lots and sensors without errors only."""
AGENT_NAMES = tuple(name for name in AGENTS if name not in SMALL_LOTS_ONLY)
"""Agents for all lots."""
