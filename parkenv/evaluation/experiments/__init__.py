"""Comparisons of agents: specification, execution, results."""
