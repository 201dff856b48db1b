"""Data sets of recorded searches, for offline reinforcement learning."""
