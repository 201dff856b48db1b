"""The thesis's planner: the parking MDP, its solvers, and the agents that replan with it."""
