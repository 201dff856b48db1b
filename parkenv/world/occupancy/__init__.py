"""Occupancy of slots over time."""
