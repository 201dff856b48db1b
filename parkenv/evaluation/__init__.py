"""Evaluation of agents: episodes, statistics, result folders and figures."""
