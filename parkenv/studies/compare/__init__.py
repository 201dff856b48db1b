"""Comparisons of agents, the benchmark, commutes and the demo."""
