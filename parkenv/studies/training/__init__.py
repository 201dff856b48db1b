"""Reinforcement learning: specification, configs and trainings."""
