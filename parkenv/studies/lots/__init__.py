"""Lots under examination: whether cars can drive and park there, a census, and imports of towns."""
