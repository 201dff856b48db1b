"""Heuristic baselines: how people search, from their observations and without a forecast."""

from planners.heuristics.policies import POLICIES

__all__ = ["POLICIES"]
