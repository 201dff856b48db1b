"""Commutes: drivers who come day after day, with a map that learns."""
