"""Occupancy maps from survey drives past all slots (T §3.3)."""
