"""Lots of real places: maps and lists of slots that others made."""
