"""Reinforcement learning: training environments, algorithms, behaviour cloning."""
